"""`gbid fit`: prefilter and fits."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from gbid.cli.guard import guarded
from gbid.cli.options import (
    AsJson,
    Debug,
    DryRun,
    Engine,
    ExperimentPath,
    Overwrite,
    Quiet,
    Results,
    Retry,
    Verbose,
    Workers,
)


def fit(
    experiment: ExperimentPath,
    only: Annotated[str | None, typer.Option("--only", metavar="FIT", help="Run this one of the fits.")] = None,
    results: Results = None,
    overwrite: Overwrite = False,
    engine: Engine = "auto",
    workers: Workers = None,
    retry: Retry = False,
    dry_run: DryRun = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Prefilter the recordings, if the YAML says so, and run the fits."""
    with guarded(as_json, debug):
        from gbid.cli.dry_run import print_plan
        from gbid.cli.manner import Manner
        from gbid.cli.stages import opened, print_outcomes
        from gbid.errors import UsageError
        from gbid.experiment.load import load_experiment
        from gbid.experiment.problems import nearest
        from gbid.experiment.run.perform import run_tasks
        from gbid.experiment.run.stage import run_stage
        from gbid.experiment.stages.fit.stage import FIT, fit_tasks
        from gbid.experiment.stages.prefilter.stage import PREFILTER

        loaded, how = load_experiment(experiment, results), Manner("fit", as_json, quiet, verbose, dry_run)
        if only is not None and loaded.spec.fits and only not in loaded.spec.fits:
            raise UsageError(f"--only {only}: no such fit; {nearest(only, loaded.spec.fits)}")
        if dry_run:
            print_plan(loaded, [PREFILTER, FIT], as_json, overwrite=overwrite, retry=retry)
            return
        options: dict[str, Any] = {"overwrite": overwrite, "engine": engine, "workers": workers, "retry": retry}
        with opened(loaded, [FIT.section], how, **options) as job:
            outcomes = [*run_stage(job, PREFILTER), *run_tasks(job, fit_tasks(job, only))]
        print_outcomes(job, [PREFILTER, FIT], outcomes, how)
