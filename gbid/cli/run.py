"""`gbid run`: every stage that the YAML names; what is already there is kept."""

from __future__ import annotations

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, ExperimentPath, Overwrite, Results


def run(
    experiment: ExperimentPath,
    results: Results = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Run all stages of an experiment: recordings, prefilter, fits, cross-validation, figures."""
    with guarded(as_json, debug):
        import typer

        from gbid.cli.documents import crossval_documents, fit_documents, prefilter_documents
        from gbid.cli.ending import finish, outcome_rows
        from gbid.cli.printing import print_crossval, print_json, print_table
        from gbid.cli.progress import reporting
        from gbid.experiment.load import load_experiment
        from gbid.experiment.stages import (
            Job,
            import_recordings,
            make_rig_recordings,
            prefilter_recordings,
            run_crossval,
            run_fits,
        )
        from gbid.report.stage import draw_figures
        from gbid.report.tables import fit_tables, prefilter_table

        loaded = load_experiment(experiment, results)
        with reporting() as reporter:
            job = Job(loaded, overwrite, reporter)
            outcomes = []
            for stage in (make_rig_recordings, import_recordings, prefilter_recordings, run_fits):
                outcomes += stage(job)
            made, rows = run_crossval(job)
            drawn = draw_figures(job)
        outcomes += [*made, *drawn]
        fits, validated = fit_documents(job, outcomes), crossval_documents(rows)
        filtered = prefilter_documents(outcomes)
        figures = [str(o.path) for o in drawn if o.state != "failed"]
        if as_json:
            print_json(
                {
                    "experiment": loaded.spec.name,
                    "results": str(loaded.results),
                    "prefilter": filtered,
                    "fits": fits,
                    "crossval": validated,
                    "figures": figures,
                    "outcomes": outcome_rows(outcomes),
                }
            )
        else:
            if filtered:
                print_table(prefilter_table(filtered), "")
            for document in fits:
                print_table(fit_tables(f"{document['fit']}, {document['model']}", document))
            if validated:
                print_crossval(validated)
            typer.echo("\n".join([*(f"figure: {path}" for path in figures), f"results: {loaded.results}"]))
        finish(outcomes, rows)
