"""`gbid crossval`: models on recordings that they were not fitted to."""

from __future__ import annotations

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, ExperimentPath, Overwrite, Results


def crossval(
    experiment: ExperimentPath,
    results: Results = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Validate the fitted models and choose the nominal actuator; exit code 5 when a minimum fit is missed."""
    with guarded(as_json, debug):
        from gbid.cli.documents import crossval_documents, summary_documents
        from gbid.cli.ending import finish, outcome_rows
        from gbid.cli.printing import print_crossval, print_json, print_tables
        from gbid.cli.progress import reporting
        from gbid.errors import UsageError
        from gbid.experiment.load import load_experiment
        from gbid.experiment.run.job import Job
        from gbid.experiment.stages.crossval.stage import run_crossval
        from gbid.experiment.stages.nominal.stage import choose_nominal
        from gbid.report.tables.validation_tables import nominal_document, nominal_table

        loaded = load_experiment(experiment, results)
        if not loaded.spec.crossval and loaded.spec.nominal is None:
            raise UsageError(f"{experiment}: no section 'crossval' or 'nominal', so there is nothing to do; add one")
        with reporting() as reporter:
            job = Job(loaded, overwrite, reporter)
            made, rows = run_crossval(job)
            chosen, nominal = choose_nominal(job)
        outcomes = [*made, *chosen]
        documents, summaries = crossval_documents(rows), summary_documents(made)
        central = nominal_document(chosen[0].item, nominal, chosen[0].path) if nominal else None
        if as_json:
            document = {"crossval": documents, "crossval_summary": summaries, "nominal": central}
            print_json({**document, "outcomes": outcome_rows(outcomes)})
        else:
            print_crossval(documents, summaries)
            if central:
                print_tables(nominal_table(central))
        finish(outcomes, rows)
