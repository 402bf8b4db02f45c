"""`gbid figures`: the figures and tables of the paper, from the results of an experiment."""

from __future__ import annotations

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, ExperimentPath, Overwrite, Results


def figures(
    experiment: ExperimentPath,
    results: Results = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Write the paper's figures (pdf, svg, png) and tables (csv, Markdown), as far as the results allow."""
    with guarded(as_json, debug):
        import typer

        from gbid.cli.ending import finish, outcome_rows
        from gbid.cli.printing import print_json
        from gbid.cli.progress import reporting
        from gbid.experiment.load import load_experiment
        from gbid.experiment.run.job import Job
        from gbid.report.paper.paper_files import FOLDER, write_paper

        loaded = load_experiment(experiment, results)
        with reporting() as reporter:
            outcomes, left_out = write_paper(Job(loaded, overwrite, reporter))
        if as_json:
            absent = [{"item": item.item, "why": item.why} for item in left_out]
            print_json({"outcomes": outcome_rows(outcomes), "left_out": absent})
        else:
            for item in left_out:
                typer.echo(f"left out: {item.item}: {item.why}")
            items = {o.path.stem for o in outcomes if o.state != "failed"}
            typer.echo(f"{len(items)} figures and tables in {loaded.results / FOLDER}")
        finish(outcomes)
