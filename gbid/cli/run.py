"""`gbid run`: every stage that the YAML names; what is already there is kept."""

from __future__ import annotations

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, Engine, ExperimentPath, Overwrite, Results, Retry, Workers


def run(
    experiment: ExperimentPath,
    results: Results = None,
    overwrite: Overwrite = False,
    engine: Engine = "auto",
    workers: Workers = None,
    retry: Retry = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Run all stages that an experiment names, from recordings to the report; what is there already is skipped."""
    with guarded(as_json, debug):
        import typer

        from gbid.campaign.collect import collect
        from gbid.campaign.run import run_campaign, working
        from gbid.cli.documents import (
            campaign_document,
            crossval_documents,
            fit_documents,
            impact_documents,
            prefilter_documents,
            static_documents,
            summary_documents,
        )
        from gbid.cli.ending import finish, outcome_rows
        from gbid.cli.printing import print_crossval, print_json, print_tables
        from gbid.cli.progress import reporting
        from gbid.cli.tally import MANY
        from gbid.experiment.load import load_experiment
        from gbid.experiment.stages.crossval.stage import run_crossval
        from gbid.experiment.stages.impact.stage import run_impacts
        from gbid.experiment.stages.lpv.stage import draw_surfaces, made_surfaces
        from gbid.experiment.stages.nominal.stage import choose_nominal
        from gbid.experiment.stages.static.stage import run_static
        from gbid.experiment.stages.tune.stage import made_designs, run_tuning
        from gbid.report.html import write_report
        from gbid.report.stage import draw_figures
        from gbid.report.tables.campaign_tables import campaign_tables
        from gbid.report.tables.fit_tables import fit_tables
        from gbid.report.tables.impact_tables import impact_tables
        from gbid.report.tables.lpv_tables import lpv_documents, lpv_table
        from gbid.report.tables.recording_tables import prefilter_table
        from gbid.report.tables.static_tables import static_table
        from gbid.report.tables.tuning_tables import tuning_documents, tuning_tables
        from gbid.report.tables.validation_tables import nominal_document, nominal_table

        loaded = load_experiment(experiment, results)
        with (
            reporting() as reporter,
            working(loaded, overwrite=overwrite, retry=retry, reporter=reporter, engine=engine, workers=workers) as job,
        ):
            outcomes = [*run_campaign(job), *run_static(job)]
            table, collected = collect(job) if loaded.spec.fits else (None, [])
            made, rows = run_crossval(job)
            chosen, nominal = choose_nominal(job)
            surfaces = draw_surfaces(job)
            tuned = run_tuning(job)
            hit = run_impacts(job)
            drawn = draw_figures(job)
            written = write_report(job)
        outcomes += [*collected, *made, *chosen, *surfaces, *tuned, *hit, *drawn, written]
        fits, validated = fit_documents(job, outcomes), crossval_documents(rows)
        filtered, summaries = prefilter_documents(outcomes), summary_documents(made)
        central = nominal_document(chosen[0].item, nominal, chosen[0].path) if nominal else None
        static = static_documents(job, outcomes)
        models = lpv_documents(loaded, surfaces, made_surfaces(surfaces))
        designs = tuning_documents(tuned, made_designs(tuned))
        impacts = impact_documents(job, hit)
        figures = [str(o.path) for o in drawn if o.state != "failed"]
        if as_json:
            print_json(
                {
                    "experiment": loaded.spec.name,
                    "results": str(loaded.results),
                    "prefilter": filtered,
                    "static": static,
                    "fits": fits,
                    "crossval": validated,
                    "crossval_summary": summaries,
                    "nominal": central,
                    "lpv": models,
                    "tuning": designs,
                    "impacts": impacts,
                    "figures": figures,
                    "report": None if written.state == "failed" else str(written.path),
                    "outcomes": outcome_rows(outcomes),
                }
            )
        else:
            if filtered:
                print_tables(prefilter_table(filtered))
            print_tables(*map(static_table, static))
            if len(fits) > MANY:
                print_tables(*campaign_tables(campaign_document(loaded, outcomes, table)))
            for document in fits if len(fits) <= MANY else ():
                print_tables(*fit_tables(f"{document['fit']}, {document['model']}", document))
            if validated:
                print_crossval(validated, summaries)
            if central:
                print_tables(nominal_table(central))
            print_tables(*map(lpv_table, models), *tuning_tables(designs), *impact_tables(impacts))
            typer.echo("\n".join([*(f"figure: {path}" for path in figures), f"results: {loaded.results}"]))
            if written.state != "failed":
                typer.echo(f"report: {written.path}")
        finish(outcomes, rows)
