"""`gbid new`, `import`, `export` and `clean`: the verbs that write files beside or from an experiment."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

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
    complete_source,
)
from gbid.cli.verbs import OR_RUN
from gbid.core.errors import UsageError
from gbid.export.targets import TARGETS, ExportRequest, export_target

if TYPE_CHECKING:
    from gbid.experiment.draft import Draft, DraftOptions


class Template(StrEnum):
    """Templates of experiments."""

    quickstart = "quickstart"
    gas_bearing = "gas-bearing"
    one_speed = "one-speed"
    one_point = "one-point"
    own_recordings = "own-recordings"
    magnetic_bearing = "magnetic-bearing"
    theisen2016 = "theisen2016"


ABOUT = {
    Template.quickstart: "the virtual rig at one operating point: recordings, prefilter, fits, validation, figures",
    Template.gas_bearing: "a gas bearing at six operating points: fits, surfaces over pressure and speed, a controller",
    Template.one_speed: "a gas bearing at one speed: surfaces over the pressure alone, a controller",
    Template.one_point: "a gas bearing at one operating point: a constant model, a controller",
    Template.own_recordings: "example data in csv and a structure in Python, to be replaced by your own",
    Template.magnetic_bearing: "a magnetic bearing in its loop: example data in csv, a structure in Python",
    Template.theisen2016: "the campaign of the paper on the virtual rig: 86 recordings at 15 operating points",
}
"""Contents of each template."""


def _print_templates(wanted: bool) -> None:
    if wanted:
        for template, about in ABOUT.items():
            typer.echo(f"{template.value:18}{about}")
        raise typer.Exit


def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new or empty folder.", show_default=False)],
    template: Annotated[
        Template, typer.Option("--template", help="Template; --list shows what each contains.")
    ] = Template.quickstart,
    measured: Annotated[
        Path | None,
        typer.Option(
            "--from", metavar="FOLDER", help="Draft an experiment for a gas bearing from the files of a folder."
        ),
    ] = None,
    signal: Annotated[
        list[str] | None,
        typer.Option(
            "--signal", metavar="NAME=X,Y", help="With --from: columns of r, u, p or phi.", show_default="found"
        ),
    ] = None,
    time: Annotated[
        str | None,
        typer.Option(metavar="COLUMN", help="With --from: column of the sample times.", show_default="found"),
    ] = None,
    sample_time: Annotated[
        float | None, typer.Option(metavar="S", help="With --from: time between samples.", show_default="found")
    ] = None,
    unit: Annotated[
        str | None, typer.Option(help="With --from: unit of positions whose file states none.", show_default="found")
    ] = None,
    pattern: Annotated[
        str | None, typer.Option(help="With --from: pattern of the file names.", show_default="found")
    ] = None,
    from_s: Annotated[
        float | None, typer.Option(metavar="S", help="With --from: begin of the part to use.", show_default="found")
    ] = None,
    to_s: Annotated[
        float | None, typer.Option(metavar="S", help="With --from: end of the part to use.", show_default="found")
    ] = None,
    pressure: Annotated[
        float | None, typer.Option(metavar="BAR", help="With --from: pressure of all files.", show_default="found")
    ] = None,
    speed: Annotated[
        float | None, typer.Option(metavar="RPM", help="With --from: speed of all files.", show_default="found")
    ] = None,
    controller: Annotated[str, typer.Option(help="With --from: structure of the controller.")] = "P",
    _list: Annotated[
        bool, typer.Option("--list", callback=_print_templates, is_eager=True, help="List the templates and exit.")
    ] = False,
    debug: Debug = False,
) -> None:
    """Write a commented experiment: a template that runs as it is, or one for the files of a folder."""
    with guarded(debug=debug):
        from gbid.cli.templates import refuse_used, write_draft, write_template

        notes: tuple[str, ...] = ()
        if measured is None:
            written = write_template(template.value, folder)
        else:
            from gbid.experiment.draft import DraftOptions

            refuse_used(folder)
            columns = dict(_signal(text) for text in signal or ())
            options = DraftOptions(
                measured, columns, time, sample_time, unit, pattern, from_s, to_s, pressure, speed, controller
            )
            draft = _drafted(options, folder)
            written, notes = write_draft(draft.text, folder), draft.notes
        for path in written:
            typer.echo(str(path))
        experiment = folder / "experiment.yaml"
        first = "check" if measured else "run"
        then = "run" if measured else "check"
        for line in (
            *(f"note: {text}" for text in notes),
            f"next: gbid {first} {experiment}",
            f"then: change {experiment} and {then} it with gbid {then} {experiment}",
        ):
            typer.echo(line, err=True)


def _signal(text: str) -> tuple[str, tuple[str, ...]]:
    """Return name and columns of an option like ``p=Weg x,Weg y``."""
    name, _, columns = text.partition("=")
    counts = {"r": 2, "u": 2, "p": 2, "phi": 1}
    found = tuple(column.strip() for column in columns.split(",") if column.strip())
    if len(found) != counts.get(name.strip()):
        raise UsageError(f"--signal: expected r, u or p with two columns, or phi with one, as p=X,Y; found {text!r}")
    return name.strip(), found


def _drafted(options: DraftOptions, target: Path) -> Draft:
    """Return the draft; ask for what the files do not say, where there is someone to answer."""
    from gbid.experiment.draft import ASKED, UnansweredError, draft_experiment

    while True:
        try:
            return draft_experiment(options, target)
        except UnansweredError as error:
            if not sys.stdin.isatty():
                raise
            typer.echo(str(error), err=True)
            options = options.answered(error.option, typer.prompt(ASKED[error.option], err=True))


# ---- `gbid import`: recordings of the import section; with --peek the channels of one file.


def import_recordings(
    experiment: Annotated[
        Path,
        typer.Argument(
            metavar="EXPERIMENT|FILE", help="The experiment YAML; with --peek the file.", show_default=False
        ),
    ],
    peek: Annotated[
        bool,
        typer.Option(
            "--peek",
            help="Show the channels of a measured file: names, units, rates, first samples, and how it is read.",
        ),
    ] = False,
    encoding: Annotated[
        str | None, typer.Option(help="With --peek: encoding of a text file.", show_default="found")
    ] = None,
    decimal: Annotated[str | None, typer.Option(help="With --peek: its decimal sign.", show_default="found")] = None,
    delimiter: Annotated[
        str | None, typer.Option(help="With --peek: the character between its cells.", show_default="found")
    ] = None,
    header_line: Annotated[
        int | None, typer.Option(help="With --peek: number of its line with the names.", show_default="found")
    ] = None,
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
    """Read the recordings of the import section, or show the channels of a measured file."""
    with guarded(as_json, debug):
        if peek:
            from gbid.cli.printing import print_json, print_tables
            from gbid.recording.importing import list_channels, read_layout
            from gbid.recording.mapping import TextOptions
            from gbid.report.read import channel_rows, channel_table, layout_words

            options = TextOptions(encoding, decimal, delimiter, header_line)
            rows, layout = channel_rows(list_channels(experiment, options)), read_layout(experiment, options)
            if as_json:
                print_json({"file": experiment, "layout": layout, "channels": rows})
            else:
                if layout:
                    typer.echo(f"read as text: {layout_words(layout)}")
                print_tables(channel_table(experiment.name, rows))
            return
        from gbid.cli.stages import Manner, run_stages

        run_stages(
            ("import",),
            experiment,
            results,
            Manner("import", as_json, quiet, verbose, dry_run),
            OR_RUN,
            overwrite=overwrite,
            engine=engine,
            workers=workers,
            retry=retry,
        )


# ---- `gbid export`: models and controllers for other programs.


def _complete_target(incomplete: str) -> list[str]:
    return [name for name in TARGETS if name.startswith(incomplete)]


def export(
    source: Annotated[
        str,
        typer.Argument(
            metavar="EXPERIMENT|MODEL|CONTROLLER",
            help="An experiment YAML (its fits, LPV models and controllers), a model YAML or name, a controller YAML, "
            "or a fit in .h5.",
            show_default=False,
            autocompletion=complete_source,
        ),
    ],
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="TARGET",
            help=f"What to write: {', '.join(TARGETS)}.",
            autocompletion=_complete_target,
        ),
    ] = "matlab",
    at: Annotated[
        tuple[float, float] | None,
        typer.Option("--at", metavar="BAR RPM", help="Of LPV models and controllers: those at this operating point."),
    ] = None,
    number: Annotated[
        Literal["double", "float"] | None,
        typer.Option("--number", help="Type of the numbers in C source; else that of the section target, or double."),
    ] = None,
    mass: Annotated[
        float | None, typer.Option("--mass", metavar="KG", help="Modal mass of the rotor; needed for ross.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Folder; `export` in the results, or here for a file."),
    ] = None,
    results: Results = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Write models and controllers for other programs."""
    with guarded(as_json, debug):
        from gbid.cli.printing import print_json, print_notes, tell
        from gbid.experiment.exporting import find_exports, write_exports

        export_target(to)
        found = find_exports(source, at, results)
        request = ExportRequest(output or found.folder, overwrite, at, number, mass)
        files = [str(path) for path in write_exports(found, to, request)]
        if as_json:
            print_json({"files": files, "left_out": list(found.left_out), "notes": list(found.notes)})
        else:
            typer.echo("\n".join(files))
        print_notes(found.notes)
        for text in found.left_out:
            tell(f"gbid: warning: left out: {text}")


# ---- `gbid clean`: removal of what killed runs left, of records of failures, and on request of results.


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
        from gbid.cli.printing import print_json
        from gbid.core.compiled import cache_folder
        from gbid.experiment.campaign import locked, remove, stale_files
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
