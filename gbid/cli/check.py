"""`gbid check`: problems of an experiment, found before a run."""

from __future__ import annotations

from typing import Annotated

import typer

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug, ExperimentPath, Results


def check(
    experiment: ExperimentPath,
    quick: Annotated[
        bool, typer.Option("--quick", help="Check files, lengths and sample times only, not the signals.")
    ] = False,
    results: Results = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Check an experiment YAML, the data that it imports and the disk space for its results; report all problems."""
    with guarded(as_json, debug):
        from gbid.cli.next_step import next_step
        from gbid.cli.printing import print_json, print_notes
        from gbid.cli.telling import tell
        from gbid.experiment.changed_files import changed_files
        from gbid.experiment.data_checks import find_data_problems
        from gbid.experiment.load import load_experiment
        from gbid.experiment.stages.importing.stage import find_import_problems
        from gbid.tables.numbers import file_size

        loaded = load_experiment(experiment, results)
        problems, code, (needed, free) = find_data_problems(loaded)
        reported = "\n".join(problems)
        for planned, text, own in find_import_problems(loaded) if not quick else ():
            if text not in reported:
                problems.append(f"{loaded.file.position(planned.location)}: {text}")
                code = max(code, own)
        print_notes(changed_files(loaded))
        for text in problems:
            tell(f"gbid: error: {text}")
        spec = loaded.spec
        if as_json:
            print_json(
                {
                    "experiment": spec.name,
                    "recordings": list(loaded.recordings),
                    "fits": list(spec.fits),
                    "results": str(loaded.results),
                    "bytes_needed": needed,
                    "bytes_free": free,
                    "problems": problems,
                }
            )
        elif not problems:
            fits = f"{len(spec.fits)} fit{'s' * (len(spec.fits) != 1)}"
            typer.echo(f"{experiment}: nothing wrong: {len(loaded.recordings)} recordings, {fits}")
            tell(f"results in {loaded.results}: about {file_size(needed)}, {file_size(free)} free")
            tell(f"next: {next_step(loaded, 'check')}")
        if problems:
            raise typer.Exit(code)
