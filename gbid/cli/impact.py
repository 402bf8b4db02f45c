"""`gbid impact`: hammer impacts on the rig, open and closed loop, beside what the model expects."""

from __future__ import annotations

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, Engine, ExperimentPath, Overwrite, Results, Retry, Workers


def impact(
    experiment: ExperimentPath,
    results: Results = None,
    overwrite: Overwrite = False,
    engine: Engine = "auto",
    workers: Workers = None,
    retry: Retry = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Hit the rig with a hammer, open and closed loop: modes obtained beside those expected, force scaling, fit."""
    with guarded(as_json, debug):
        from gbid.campaign.run import working
        from gbid.cli.documents import impact_documents
        from gbid.cli.ending import finish, outcome_rows
        from gbid.cli.printing import print_json, print_tables
        from gbid.cli.progress import reporting
        from gbid.experiment.load import load_experiment
        from gbid.experiment.stages.impact.plan import impacts_section
        from gbid.experiment.stages.impact.stage import run_impacts
        from gbid.report.tables.impact_tables import impact_tables

        loaded = load_experiment(experiment, results)
        impacts_section(loaded)
        with (
            reporting() as reporter,
            working(loaded, overwrite=overwrite, retry=retry, reporter=reporter, engine=engine, workers=workers) as job,
        ):
            outcomes = run_impacts(job)
        documents = impact_documents(job, outcomes)
        if as_json:
            print_json({"impacts": documents, "outcomes": outcome_rows(outcomes)})
        else:
            print_tables(*impact_tables(documents))
        finish(outcomes)
