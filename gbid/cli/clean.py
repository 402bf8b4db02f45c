"""`gbid clean`: removal of what killed runs left, of records of failures, and on request of results."""

from __future__ import annotations

from typing import Annotated

import typer

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, DryRun, ExperimentPath, Quiet, Results


def clean(
    experiment: ExperimentPath,
    everything: Annotated[
        bool, typer.Option("--everything", help="Also remove the results; files that gbid did not make stay.")
    ] = False,
    kernels: Annotated[
        bool, typer.Option("--kernels", help="Also remove the compiled kernels of this user; they are compiled anew.")
    ] = False,
    results: Results = None,
    dry_run: DryRun = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Remove temporary files of killed runs and records of failures, so that failed items are tried again."""
    with guarded(as_json, debug):
        from gbid.campaign.cleaning import remove, stale_files
        from gbid.campaign.lock import locked
        from gbid.cli.printing import print_json
        from gbid.compiling import cache_folder
        from gbid.experiment.load import load_experiment

        loaded = load_experiment(experiment, results)
        cache = cache_folder() if kernels else None
        if dry_run or not loaded.results.is_dir():
            found = stale_files(loaded.results, everything, cache)
        else:
            with locked(loaded.results):
                found = stale_files(loaded.results, everything, cache)
                remove(loaded.results, found)
        if as_json:
            print_json({"results": loaded.results, "removed": [] if dry_run else found, "found": found})
            return
        if not quiet:
            for path in found:
                typer.echo(str(path))
        typer.echo(f"{len(found)} files {'would be ' if dry_run else ''}removed")
