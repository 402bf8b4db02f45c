"""`gbid static`: staircases to static gains, hysteresis and creep."""

from __future__ import annotations

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, ExperimentPath, Overwrite, Results


def static(
    experiment: ExperimentPath,
    results: Results = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Characterise staircases: static gains of the bearing, hysteresis and creep of the piezos."""
    with guarded(as_json, debug):
        from gbid.cli.documents import static_documents
        from gbid.cli.ending import finish, outcome_rows
        from gbid.cli.printing import print_json, print_tables
        from gbid.cli.progress import reporting
        from gbid.errors import UsageError
        from gbid.experiment.load import load_experiment
        from gbid.experiment.run.job import Job
        from gbid.experiment.stages.static.stage import run_static
        from gbid.report.tables.static_tables import static_table

        loaded = load_experiment(experiment, results)
        if not loaded.spec.static:
            raise UsageError(f"{experiment}: no section 'static', so there is nothing to do; add one")
        with reporting() as reporter:
            job = Job(loaded, overwrite, reporter)
            outcomes = run_static(job)
        documents = static_documents(job, outcomes)
        if as_json:
            print_json({"static": documents, "outcomes": outcome_rows(outcomes)})
        else:
            print_tables(*map(static_table, documents))
        finish(outcomes)
