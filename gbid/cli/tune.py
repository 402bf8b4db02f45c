"""`gbid tune`: gains with the most damping within limits, beside the published controller."""

from __future__ import annotations

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, ExperimentPath, Overwrite, Results, Retry


def tune(
    experiment: ExperimentPath,
    results: Results = None,
    overwrite: Overwrite = False,
    retry: Retry = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Tune controllers: the gains with the most damping within limits, beside the published ones."""
    with guarded(as_json, debug):
        from gbid.cli.ending import finish, outcome_rows
        from gbid.cli.printing import print_json, print_tables
        from gbid.cli.progress import reporting
        from gbid.errors import UsageError
        from gbid.experiment.load import load_experiment
        from gbid.experiment.run.job import Job
        from gbid.experiment.stages.tune.stage import made_designs, run_tuning
        from gbid.report.tables.tuning_tables import tuning_documents, tuning_tables

        loaded = load_experiment(experiment, results)
        if not loaded.spec.controller:
            raise UsageError(f"{experiment}: no section 'controller', so there is nothing to do; add one")
        with reporting() as reporter:
            outcomes = run_tuning(Job(loaded, overwrite, reporter, retry=retry))
        documents = tuning_documents(outcomes, made_designs(outcomes))
        if as_json:
            print_json({"tuning": documents, "outcomes": outcome_rows(outcomes)})
        else:
            print_tables(*tuning_tables(documents))
        finish(outcomes)
