"""`gbid check`: what is wrong with an experiment, before anything runs."""

from __future__ import annotations

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, ExperimentPath


def check(experiment: ExperimentPath, as_json: AsJson = False, debug: Debug = False) -> None:
    """Check an experiment YAML and the data that it imports; all problems at once."""
    with guarded(as_json, debug):
        import typer

        from gbid.cli.printing import print_json
        from gbid.errors import DataError, GbidError
        from gbid.experiment.load import load_experiment
        from gbid.experiment.stages import read_import

        loaded = load_experiment(experiment)
        problems: list[str] = []
        code = 0
        for planned in loaded.recordings.values():
            if planned.imported is not None:
                try:
                    read_import(loaded, planned)
                except GbidError as error:
                    problems.append(f"{loaded.file.position(planned.location)}: {error}")
                    code = max(code, error.exit_code)
        for text in problems:
            typer.echo(f"gbid: error: {text}", err=True)
        spec = loaded.spec
        if as_json:
            print_json(
                {
                    "experiment": spec.name,
                    "recordings": list(loaded.recordings),
                    "fits": list(spec.fits),
                    "results": str(loaded.results),
                    "problems": problems,
                }
            )
        elif not problems:
            typer.echo(f"{experiment}: nothing wrong: {len(loaded.recordings)} recordings, {len(spec.fits)} fits")
        if problems:
            raise typer.Exit(code or DataError.exit_code)
