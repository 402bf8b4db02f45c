"""`gbid fit`: prefilter, then fit."""

from __future__ import annotations

from typing import Annotated

import typer

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, Engine, ExperimentPath, Overwrite, Results, Retry, Workers


def fit(
    experiment: ExperimentPath,
    only: Annotated[str | None, typer.Option("--only", metavar="FIT", help="Run this one of the fits.")] = None,
    results: Results = None,
    overwrite: Overwrite = False,
    engine: Engine = "auto",
    workers: Workers = None,
    retry: Retry = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Prefilter the recordings, if the YAML says so, and run the fits."""
    with guarded(as_json, debug):
        from gbid.campaign.run import working
        from gbid.cli.documents import fit_documents, prefilter_documents
        from gbid.cli.ending import finish, outcome_rows
        from gbid.cli.printing import print_json, print_tables
        from gbid.cli.progress import reporting
        from gbid.errors import UsageError
        from gbid.experiment.load import load_experiment
        from gbid.experiment.problems import nearest
        from gbid.experiment.stages.fit.stage import run_fits
        from gbid.experiment.stages.prefilter.stage import prefilter_recordings
        from gbid.report.tables.fit_tables import fit_tables
        from gbid.report.tables.recording_tables import prefilter_table

        loaded = load_experiment(experiment, results)
        if not loaded.spec.fits:
            raise UsageError(f"{experiment}: no section 'fits', so there is nothing to do; add one")
        if only is not None and only not in loaded.spec.fits:
            raise UsageError(f"--only {only}: no such fit; {nearest(only, loaded.spec.fits)}")
        with (
            reporting() as reporter,
            working(loaded, overwrite=overwrite, retry=retry, reporter=reporter, engine=engine, workers=workers) as job,
        ):
            outcomes = [*prefilter_recordings(job), *run_fits(job, only)]
        documents, filtered = fit_documents(job, outcomes), prefilter_documents(outcomes)
        if as_json:
            print_json({"prefilter": filtered, "fits": documents, "outcomes": outcome_rows(outcomes)})
        else:
            if filtered:
                print_tables(prefilter_table(filtered))
            for document in documents:
                print_tables(*fit_tables(f"{document['fit']}, {document['model']}", document))
        finish(outcomes)
