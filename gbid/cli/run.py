"""`gbid run`: all stages that the YAML names; current results are kept."""

from __future__ import annotations

from typing import Any

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

        from gbid.campaign.collect import collect
        from gbid.campaign.run import run_campaign, working
        from gbid.cli.documents import campaign_document
        from gbid.cli.dry_run import print_plan
        from gbid.cli.ending import finish, outcome_rows
        from gbid.cli.manner import Manner
        from gbid.cli.printing import print_json, print_notes, print_tables
        from gbid.cli.progress import reporting
        from gbid.cli.tally import MANY
        from gbid.cli.views import view_of
        from gbid.experiment.changed_files import changed_files
        from gbid.experiment.load import load_experiment
        from gbid.experiment.run.stage import run_stage
        from gbid.experiment.stages import registry
        from gbid.experiment.stages.fit.stage import FIT
        from gbid.report.figures.pair_figures import draw_figures
        from gbid.report.html import write_report
        from gbid.report.tables.campaign_tables import campaign_tables

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
