"""`gbid check`, `doctor`, `bench`, `explain` and `schema`: the verbs about experiment files and this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gbid.cli.options import CommonOptions, ExperimentPath, with_options


@with_options("results", "changes", "as_json", "debug")
def check(
    experiment: ExperimentPath,
    options: CommonOptions,
    quick: Annotated[
        bool, typer.Option("--quick", help="Check files, lengths and sample times only, not the signals.")
    ] = False,
) -> None:
    """Check an experiment YAML, the data that it imports and the disk space for its results; report all problems."""
    from gbid.cli.printing import print_json, print_notes, tell
    from gbid.cli.stages import next_step
    from gbid.core.tables import file_size
    from gbid.experiment.experiment import changed_files
    from gbid.experiment.load import check_experiment

    loaded = options.load(experiment)
    problems, code, (needed, free) = check_experiment(loaded, quick)
    print_notes(changed_files(loaded))
    for text in problems:
        tell(f"gbid: error: {text}")
    spec, recordings = loaded.spec, list(loaded.recordings)
    if options.as_json:
        about = {"experiment": spec.name, "recordings": recordings, "fits": list(spec.fits), "results": loaded.results}
        print_json({**about, "bytes_needed": needed, "bytes_free": free, "problems": problems})
    elif not problems:
        fits = f"{len(spec.fits)} fit{'s' * (len(spec.fits) != 1)}"
        typer.echo(f"{experiment}: nothing wrong: {len(recordings)} recordings, {fits}")
        tell(f"results in {loaded.results}: about {file_size(needed)}, {file_size(free)} free")
        tell(f"next: {next_step(loaded, 'check')}")
    if problems:
        raise typer.Exit(code)


# ---- `gbid doctor`: requirements of gbid on this machine, and missing optional parts.


@with_options("as_json", "debug")
def doctor(options: CommonOptions) -> None:
    """Show compiler, cache, versions, disk and threads of this machine, and what to do where something is missing."""
    from gbid.cli.printing import print_json, print_tables, tell
    from gbid.core.tables import Column, Table
    from gbid.experiment.examination import Verdict, examine

    findings = examine()
    if options.as_json:
        print_json({"findings": [finding.document() for finding in findings]})
    else:
        columns = [Column("what"), Column("verdict"), Column("found", wrap=True)]
        rows = [[finding.what, finding.verdict.value, finding.found] for finding in findings]
        print_tables(Table("this machine", columns, rows))
    for finding in findings:
        if finding.remedy:
            tell(f"gbid: {finding.verdict.value}: {finding.what}: {finding.remedy}")
    if any(finding.verdict is Verdict.BAD for finding in findings):
        raise typer.Exit(1)


# ---- `gbid bench`: duration of a fit on this machine.


@with_options("as_json", "debug")
def bench(
    options: CommonOptions,
    samples: Annotated[
        int, typer.Option("--samples", metavar="N", min=1000, help="Samples of the recording.")
    ] = 25_000,
) -> None:
    """Time a fit of the bearing of the paper on this machine: 14 parameters, two inputs and outputs."""
    import numpy as np

    from gbid.cli.printing import print_json, print_tables
    from gbid.core.tables import Column, Table
    from gbid.identify.fitting import fit
    from gbid.lpv.model_file import load_model
    from gbid.recording import Recording
    from gbid.structure import RotorBearing

    random, step = np.random.default_rng(1), 2e-4
    u = np.repeat(random.choice([-5e-6, 5e-6], (-(-samples // 10), 2)), 10, axis=0)[:samples]
    p = load_model("theisen2016").at(6.0, 0.0).simulate(u, step, intersample="foh")
    recording = Recording({"u": u, "p": p + 30e-9 * random.standard_normal(p.shape)}, step, name="bench")
    results = [fit(RotorBearing(), recording) for _ in range(3)]
    seconds = [result.wall_time_s for result in results]
    document = {"samples": samples, "first_s": seconds[0], "best_s": min(seconds), "status": str(results[-1].status)}
    if options.as_json:
        print_json(document)
        return
    columns = [Column("fit"), Column("time", "s", 3)]
    rows = [("the first, with what is compiled and loaded once", seconds[0]), ("the fastest of three", min(seconds))]
    print_tables(Table(f"fit of {samples} samples, {document['status']}", columns, rows))


# ---- `gbid explain`: meaning of a note's code, and advice.


@with_options("as_json", "debug")
def explain(
    options: CommonOptions,
    code: Annotated[
        str, typer.Argument(metavar="[CODE]", help="Code of a note, as GB102; without it all are listed.")
    ] = "",
) -> None:
    """Explain the code of a note, such as GB102: where it comes from and what to do."""
    from gbid.cli.printing import print_json, print_tables
    from gbid.core.notes import explain as explanation_of
    from gbid.core.notes import families
    from gbid.core.tables import Column, Table

    if code:
        note = explanation_of(code)
        if options.as_json:
            print_json(note._asdict())
        else:
            typer.echo(f"{note.code}: {note.title}\n\n{note.meaning}\n\nWhat to do: {note.remedy}")
    elif options.as_json:
        print_json({"notes": [note._asdict() for group in families().values() for note in group]})
    else:
        columns = [Column("code"), Column("note", wrap=True)]
        tables = (Table(about, columns, [[q.code, q.title] for q in group]) for about, group in families().items())
        print_tables(*tables)


# ---- `gbid schema`: JSON schema of the experiment YAML, for editors.


@with_options("overwrite", "debug")
def schema(
    options: CommonOptions,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Write it to a file instead of standard output."),
    ] = None,
) -> None:
    """Print the JSON schema of the experiment YAML; with it an editor completes and checks the keys."""
    import json

    from gbid.experiment.load import experiment_json_schema

    text = json.dumps(experiment_json_schema(), indent=2, ensure_ascii=False)
    if output is None:
        typer.echo(text)
        return
    from gbid.core.files import atomic_path

    with atomic_path(output, options.overwrite) as part:
        part.write_text(text + "\n", encoding="utf-8")
    typer.echo(str(output))
    typer.echo(
        f"next: put this line on top of your experiment: # yaml-language-server: $schema={output.name}", err=True
    )
