"""`gbid serve`: results as pages that follow a running campaign."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gbid.cli.guard import guarded
from gbid.cli.options import Debug, ExperimentPath, Results


def serve(
    experiment: ExperimentPath,
    port: Annotated[int, typer.Option("--port", metavar="N", help="Port of this machine; 0 for any free one.")] = 8471,
    results: Results = None,
    browser: Annotated[bool, typer.Option("--browser", help="Open the report in the browser.")] = False,
    debug: Debug = False,
) -> None:
    """Show the results as pages on this machine; they follow a running campaign. Ctrl-C ends it."""
    with guarded(debug=debug):
        import webbrowser

        from gbid.serve import open_server

        server = open_server(Path(experiment), results, port)
        try:
            typer.echo(f"report: {server.address}")
            typer.echo(f"gain explorer: {server.address}explorer")
            if browser:
                webbrowser.open(server.address)
            server.serve_forever()
        finally:
            server.server_close()
