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
    """Validate the fitted models; exit code 5 when a minimum fit is missed."""
    with guarded(as_json, debug):
        from gbid.cli.documents import crossval_documents
        from gbid.cli.ending import finish, outcome_rows
        from gbid.cli.printing import print_crossval, print_json
        from gbid.cli.progress import reporting
        from gbid.errors import UsageError
        from gbid.experiment.load import load_experiment
        from gbid.experiment.stages import Job, run_crossval

        loaded = load_experiment(experiment, results)
        if not loaded.spec.crossval:
            raise UsageError(f"{experiment}: no section 'crossval', so there is nothing to do")
        with reporting() as reporter:
            outcomes, rows = run_crossval(Job(loaded, overwrite, reporter))
        documents = crossval_documents(rows)
        if as_json:
            print_json({"crossval": documents, "outcomes": outcome_rows(outcomes)})
        elif documents:
            print_crossval(documents)
        finish(outcomes, rows)
