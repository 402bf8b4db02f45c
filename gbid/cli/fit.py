"""`gbid fit`: prefilter and fits."""

from __future__ import annotations

from typing import Annotated, Any

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
        from gbid.cli.stages import opened, print_outcomes
        from gbid.errors import UsageError
        from gbid.experiment.problems import nearest
        from gbid.experiment.run.perform import run_tasks
        from gbid.experiment.run.stage import run_stage
        from gbid.experiment.stages.fit.stage import FIT, fit_tasks
        from gbid.experiment.stages.prefilter.stage import PREFILTER

        options: dict[str, Any] = {"overwrite": overwrite, "engine": engine, "workers": workers, "retry": retry}
        with opened(experiment, [FIT.section], results, **options) as job:
            fits = job.experiment.spec.fits
            if only is not None and only not in fits:
                raise UsageError(f"--only {only}: no such fit; {nearest(only, fits)}")
            outcomes = [*run_stage(job, PREFILTER), *run_tasks(job, fit_tasks(job, only))]
        print_outcomes(job, [PREFILTER, FIT], outcomes, as_json)
