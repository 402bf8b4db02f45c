"""`gbid lpv`: surfaces over pressure and speed through the fits of a campaign."""

from __future__ import annotations

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, ExperimentPath, Overwrite, Results


def lpv(
    experiment: ExperimentPath,
    results: Results = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Draw surfaces over pressure and speed through the fits; how far recordings lie off them."""
    with guarded(as_json, debug):
        from gbid.cli.ending import finish, outcome_rows
        from gbid.cli.printing import print_json, print_tables
        from gbid.cli.progress import reporting
        from gbid.errors import UsageError
        from gbid.experiment.load import load_experiment
        from gbid.experiment.run.job import Job
        from gbid.experiment.stages.lpv.stage import draw_surfaces, made_surfaces
        from gbid.report.tables.lpv_tables import lpv_documents, lpv_table

        loaded = load_experiment(experiment, results)
        if loaded.spec.lpv is None:
            raise UsageError(f"{experiment}: no section 'lpv', so there is nothing to do; add one")
        with reporting() as reporter:
            job = Job(loaded, overwrite, reporter)
            outcomes = draw_surfaces(job)
        documents = lpv_documents(loaded, outcomes, made_surfaces(outcomes))
        if as_json:
            print_json({"lpv": documents, "outcomes": outcome_rows(outcomes)})
        else:
            print_tables(*map(lpv_table, documents))
        finish(outcomes)
