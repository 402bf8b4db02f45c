"""Verbs that run stages and print their results: `gbid run`, `fit`, `batch`, and those of a section, as `gbid tune`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import typer

from gbid.cli.options import CommonOptions, ExperimentPath, with_options

OR_RUN = ", or use `gbid run`"
"""What a verb that makes recordings advises when the YAML has no such section."""


def of_stages(name: str, help: str, *stages: str, hint: str = "") -> Callable[..., None]:
    """Return the verb that runs stages and prints their results.

    Parameters
    ----------
    name, help : str
        Name and help text of the verb.
    *stages : str
        Names of the stages; by default that of the verb.
    hint : str
        Further advice when the YAML has none of the sections.
    """

    def verb(experiment: ExperimentPath, options: CommonOptions) -> None:
        from gbid.cli.stages import run_stages

        run_stages(name, experiment, options, stages or (name,), hint)

    verb.__doc__ = help
    return with_options()(verb)


@with_options()
def fit(
    experiment: ExperimentPath,
    options: CommonOptions,
    only: Annotated[str | None, typer.Option("--only", metavar="FIT", help="Run this one of the fits.")] = None,
) -> None:
    """Prefilter the recordings, if the YAML says so, and run the fits."""
    from gbid.cli.stages import run_stages

    run_stages("fit", experiment, options, ("prefilter", "fit"), only=only)


@with_options()
def batch(
    experiment: ExperimentPath,
    options: CommonOptions,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", metavar="tcp://HOST:PORT", help="Run on this Dask scheduler.")
    ] = None,
    shard: Annotated[
        str | None, typer.Option("--shard", metavar="I/N", help="Run part I of N only, as a job of an array.")
    ] = None,
    collect: Annotated[bool, typer.Option("--collect", help="Run nothing; make the table of existing fits.")] = False,
) -> None:
    """Make, prefilter and fit all recordings on all processors; run it again to go on where it stopped."""
    from dataclasses import replace

    from gbid.cli.printing import print_json, print_tables
    from gbid.cli.stages import check_sections, finish, next_step, opened, outcome_rows, print_plan
    from gbid.core.errors import UsageError
    from gbid.experiment.campaign import collect as make_table
    from gbid.experiment.campaign import read_shard, run_campaign
    from gbid.experiment.stages import registry
    from gbid.report.fit_tables import campaign_document, campaign_tables

    part = read_shard(shard) if shard is not None else None
    asks_for_work = options.retry or options.workers is not None or options.engine != "auto"
    if collect and (asks_for_work or part is not None or scheduler is not None):
        raise UsageError("--collect runs nothing; leave --shard, --retry, --engine, --workers and --scheduler out")
    loaded = options.load(experiment)
    check_sections(loaded, ["fits"])
    if options.dry_run:
        print_plan(loaded, [stage for stage in registry.STAGES if stage.early], options)
        return
    options = replace(options, engine="serial") if collect else options
    with opened(loaded, options, scheduler=scheduler, shared=part is not None) as job:
        outcomes = [] if collect else run_campaign(job, part)
        table = None
        if part is None:
            table, made = make_table(job)
            outcomes += made
    document = campaign_document(loaded, outcomes, table)
    if options.as_json:
        print_json({**document, "outcomes": outcome_rows(outcomes)})
    else:
        print_tables(*campaign_tables(document))
        typer.echo("\n".join([*(f"table: {path}" for path in document["table"]), f"results: {loaded.results}"]))
    finish(outcomes, advice="" if options.quiet or part is not None else next_step(loaded, "batch"))


@with_options()
def run(experiment: ExperimentPath, options: CommonOptions) -> None:
    """Run all stages that an experiment names, from recordings to the report; current results are kept."""
    from gbid.cli.printing import print_json, print_tables
    from gbid.cli.progress import MANY
    from gbid.cli.stages import finish, next_step, opened, outcome_rows, print_plan
    from gbid.experiment.campaign import collect, run_campaign
    from gbid.experiment.run import run_stage
    from gbid.experiment.stages import registry
    from gbid.experiment.stages.fit import FIT
    from gbid.report.fit_tables import campaign_document, campaign_tables
    from gbid.report.pictures import draw_figures
    from gbid.report.views import view_of
    from gbid.report.write import write_report

    loaded = options.load(experiment)
    if options.dry_run:
        print_plan(loaded, [stage for stage in registry.STAGES if stage.in_run(loaded)], options)
        return
    with opened(loaded, options) as job:
        outcomes = run_campaign(job)
        table, collected = collect(job) if loaded.spec.fits else (None, [])
        outcomes += collected
        for stage in registry.STAGES:
            outcomes += () if stage.early or not stage.in_run(loaded) else run_stage(job, stage)
        drawn = draw_figures(job)
        written = write_report(job)
    outcomes += [*drawn, written]
    shown = [stage for stage in registry.STAGES if stage.name not in ("rig", "import", "figure")]
    document: dict[str, Any] = {"experiment": loaded.spec.name, "results": str(loaded.results)}
    for stage in shown:
        document |= view_of(stage).document(job, outcomes)
    figures = [str(outcome.path) for outcome in drawn if outcome.state != "failed"]
    page = None if written.state == "failed" else str(written.path)
    if options.as_json:
        print_json({**document, "figures": figures, "report": page, "outcomes": outcome_rows(outcomes)})
    else:
        for stage in shown:
            if stage is FIT and len(document["fits"]) > MANY:
                print_tables(*campaign_tables(campaign_document(loaded, outcomes, table)))
            else:
                print_tables(*view_of(stage).tables(document))
        report = [f"report: {page}"] if page else []
        typer.echo("\n".join([*(f"figure: {path}" for path in figures), f"results: {loaded.results}", *report]))
    finish(outcomes, document["crossval"], "" if options.quiet else next_step(loaded, "run"))
