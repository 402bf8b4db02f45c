"""`gbid schema`: JSON schema of the experiment YAML, for editors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gbid.cli.guard import guarded
from gbid.cli.options import Debug, Overwrite


def schema(
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Write it to a file instead of standard output."),
    ] = None,
    overwrite: Overwrite = False,
    debug: Debug = False,
) -> None:
    """Print the JSON schema of the experiment YAML; with it an editor completes and checks the keys."""
    with guarded(debug=debug):
        import json

        from gbid.experiment.json_schema import experiment_json_schema

        text = json.dumps(experiment_json_schema(), indent=2, ensure_ascii=False)
        if output is None:
            typer.echo(text)
            return
        from gbid.atomic import atomic_path

        with atomic_path(output, overwrite) as part:
            part.write_text(text + "\n", encoding="utf-8")
        typer.echo(str(output))
        typer.echo(
            f"next: put this line on top of your experiment: # yaml-language-server: $schema={output.name}", err=True
        )
