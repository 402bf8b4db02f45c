"""`gbid batch`: recordings, prefilter and fits of a campaign on all processors, with the table of the fits."""

from __future__ import annotations

from typing import Annotated

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


def batch(
    experiment: ExperimentPath,
    engine: Engine = "auto",
    workers: Workers = None,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", metavar="tcp://HOST:PORT", help="Run on this Dask scheduler.")
    ] = None,
    shard: Annotated[
        str | None, typer.Option("--shard", metavar="I/N", help="Run part I of N only, as a job of an array.")
    ] = None,
    retry: Retry = False,
    collect: Annotated[bool, typer.Option("--collect", help="Run nothing; make the table of existing fits.")] = False,
    results: Results = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Make, prefilter and fit all recordings on all processors; run it again to go on where it stopped."""
    with guarded(as_json, debug):
        from gbid.campaign.collect import collect as make_table
        from gbid.campaign.run import run_campaign, working
        from gbid.campaign.shard import read_shard
        from gbid.cli.documents import campaign_document
        from gbid.cli.dry_run import print_plan
        from gbid.cli.ending import finish, outcome_rows
        from gbid.cli.manner import Manner
        from gbid.cli.printing import print_json, print_tables
        from gbid.cli.progress import reporting
        from gbid.errors import UsageError
        from gbid.experiment.load import load_experiment
        from gbid.experiment.stages import registry
        from gbid.report.tables.campaign_tables import campaign_tables

        part = read_shard(shard) if shard is not None else None
        if collect and (part is not None or retry or scheduler is not None or workers is not None or engine != "auto"):
            raise UsageError("--collect runs nothing; leave --shard, --retry, --engine, --workers and --scheduler out")
        loaded = load_experiment(experiment, results)
        if not loaded.spec.fits:
            raise UsageError(f"{experiment}: no section 'fits'; add one")
        if dry_run:
            early = [stage for stage in registry.STAGES if stage.early]
            print_plan(loaded, early, as_json, overwrite=overwrite, retry=retry)
            return
        with (
            reporting(quiet, verbose) as reporter,
            working(
                loaded,
                overwrite=overwrite,
                retry=retry,
                reporter=reporter,
                engine="serial" if collect else engine,
                workers=workers,
                scheduler=scheduler,
                shared=part is not None,
            ) as job,
        ):
            outcomes = [] if collect else run_campaign(job, part)
            table = None
            if part is None:
                table, made = make_table(job)
                outcomes += made
        document = campaign_document(loaded, outcomes, table)
        if as_json:
            print_json({**document, "outcomes": outcome_rows(outcomes)})
        else:
            print_tables(*campaign_tables(document))
            typer.echo("\n".join([*(f"table: {path}" for path in document["table"]), f"results: {loaded.results}"]))
        finish(outcomes, advice=Manner("batch", quiet=quiet).advice(loaded) if part is None else "")
