"""Verbs that run the stages of one section and print their results: `gbid rig`, `gbid tune` and so on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import typer

from gbid.cli.guard import guarded
from gbid.cli.options import (
    CONTROL,
    DATA,
    IDENTIFY,
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


@dataclass(frozen=True)
class StageVerb:
    """Verb that runs stages.

    Attributes
    ----------
    name, group, help : str
        Name, group in the overview, and help text.
    stages : tuple of str
        Names of the stages.
    examples : tuple of str
        Command lines.
    hint : str
        Further advice when the YAML has none of the sections.
    """

    name: str
    group: str
    help: str
    stages: tuple[str, ...]
    examples: tuple[str, ...]
    hint: str = ""


OR_RUN = ", or use `gbid run`"
"""What a verb that makes recordings advises when the YAML has no such section."""

STAGE_VERBS = (
    StageVerb(
        "rig",
        DATA,
        "Make the recordings of the rig section, after the designs that close their loops.",
        ("loop", "rig"),
        ("gbid rig rig1/experiment.yaml --overwrite",),
        OR_RUN,
    ),
    StageVerb(
        "static",
        IDENTIFY,
        "Characterise staircases: static gains of the bearing, hysteresis and creep of the piezos.",
        ("static",),
        ("gbid static rig1/experiment.yaml --json",),
    ),
    StageVerb(
        "lpv",
        IDENTIFY,
        "Fit surfaces over pressure and speed to the fits, and show the deviations of the recordings.",
        ("lpv",),
        ("gbid lpv rig1/experiment.yaml", "gbid lpv rig1/experiment.yaml --json"),
    ),
    StageVerb(
        "crossval",
        IDENTIFY,
        "Validate the fitted models and choose the nominal actuator; exit code 5 when a minimum fit is missed.",
        ("crossval", "nominal"),
        ("gbid crossval rig1/experiment.yaml",),
    ),
    StageVerb(
        "excite",
        IDENTIFY,
        "Design the excitation of the next recordings from the fits: a CSV file for the signal generator.",
        ("excite",),
        ("gbid excite rig1/experiment.yaml", "gbid excite rig1/experiment.yaml --json"),
    ),
    StageVerb(
        "tune",
        CONTROL,
        "Tune controllers: the gains with the most damping within limits, compared with the published ones.",
        ("tune",),
        ("gbid tune rig1/experiment.yaml", "gbid tune rig1/experiment.yaml --json > designs.json"),
    ),
    StageVerb(
        "impact",
        CONTROL,
        "Hit the rig with a hammer, open and closed loop: identified and expected modes, force scaling, fit.",
        ("impact",),
        ("gbid impact rig1/experiment.yaml", "gbid impact rig1/experiment.yaml --json > impacts.json"),
    ),
    StageVerb(
        "cycle",
        CONTROL,
        "Record with the tuned controller in the loop, fit and tune again, and measure each round by impacts.",
        ("cycle",),
        ("gbid cycle rig1/experiment.yaml", "gbid cycle rig1/experiment.yaml --json > cycle.json"),
    ),
)


def command_of(verb: StageVerb) -> Callable[..., None]:
    """Return the function of a verb for typer."""

    def command(
        experiment: ExperimentPath,
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
        with guarded(as_json, debug):
            from gbid.cli.stages import Manner, run_stages

            run_stages(
                verb.stages,
                experiment,
                results,
                Manner(verb.name, as_json, quiet, verbose, dry_run),
                verb.hint,
                overwrite=overwrite,
                engine=engine,
                workers=workers,
                retry=retry,
            )

    command.__doc__ = verb.help
    return command


# ---- `gbid fit`: prefilter and fits.


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
        from gbid.cli.stages import Manner, opened, print_outcomes, print_plan
        from gbid.core.errors import UsageError
        from gbid.experiment.fields import nearest
        from gbid.experiment.load import load_experiment
        from gbid.experiment.run import run_stage, run_tasks
        from gbid.experiment.stages.fit import FIT, fit_tasks
        from gbid.experiment.stages.prefilter import PREFILTER

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


# ---- `gbid batch`: recordings, prefilter and fits of a campaign on all processors, with the table of the fits.


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
        from gbid.cli.documents import campaign_document
        from gbid.cli.printing import print_json, print_tables
        from gbid.cli.progress import reporting
        from gbid.cli.stages import Manner, finish, outcome_rows, print_plan
        from gbid.core.errors import UsageError
        from gbid.experiment.campaign import collect as make_table
        from gbid.experiment.campaign import read_shard, run_campaign, working
        from gbid.experiment.load import load_experiment
        from gbid.experiment.stages import registry
        from gbid.report.fit_tables import campaign_tables

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


# ---- `gbid run`: all stages that the YAML names; current results are kept.


def run(
    experiment: ExperimentPath,
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
    """Run all stages that an experiment names, from recordings to the report; current results are kept."""
    with guarded(as_json, debug):
        import typer

        from gbid.cli.documents import campaign_document, view_of
        from gbid.cli.printing import print_json, print_notes, print_tables
        from gbid.cli.progress import MANY, reporting
        from gbid.cli.stages import Manner, finish, outcome_rows, print_plan
        from gbid.experiment.campaign import collect, run_campaign, working
        from gbid.experiment.experiment import changed_files
        from gbid.experiment.load import load_experiment
        from gbid.experiment.run import run_stage
        from gbid.experiment.stages import registry
        from gbid.experiment.stages.fit import FIT
        from gbid.report.fit_tables import campaign_tables
        from gbid.report.pictures import draw_figures
        from gbid.report.write import write_report

        loaded, how = load_experiment(experiment, results), Manner("run", as_json, quiet, verbose, dry_run)
        if dry_run:
            stages = [stage for stage in registry.STAGES if stage.in_run(loaded)]
            print_plan(loaded, stages, as_json, overwrite=overwrite, retry=retry)
            return
        print_notes(changed_files(loaded))
        with (
            reporting(quiet, verbose) as reporter,
            working(loaded, overwrite=overwrite, retry=retry, reporter=reporter, engine=engine, workers=workers) as job,
        ):
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
        if as_json:
            page = None if written.state == "failed" else str(written.path)
            print_json({**document, "figures": figures, "report": page, "outcomes": outcome_rows(outcomes)})
        else:
            for stage in shown:
                if stage is FIT and len(document["fits"]) > MANY:
                    print_tables(*campaign_tables(campaign_document(loaded, outcomes, table)))
                else:
                    print_tables(*view_of(stage).tables(document))
            typer.echo("\n".join([*(f"figure: {path}" for path in figures), f"results: {loaded.results}"]))
            if written.state != "failed":
                typer.echo(f"report: {written.path}")
        finish(outcomes, document["crossval"], how.advice(loaded))
