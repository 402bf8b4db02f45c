"""`gbid new`, `init`, `peek`, `export` and `clean`: the verbs about files."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast, get_args

import typer

from gbid.cli.options import (
    CommonOptions,
    ExperimentPath,
    MeasuredFolder,
    complete_source,
    drafted_folder,
    with_options,
)
from gbid.core.errors import UsageError
from gbid.export.targets import TARGETS, ExportRequest, export_target

if TYPE_CHECKING:
    from gbid.experiment.draft import Draft, DraftOptions
    from gbid.lpv import MachineData


class Template(StrEnum):
    """Names of the experiment templates."""

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


def _drafting(help: str, metavar: str | None = None) -> Any:
    return typer.Option(metavar=metavar, help=f"Of measured files: {help}.", show_default="found")


def _of_machine(help: str, metavar: str) -> Any:
    return typer.Option(metavar=metavar, help=f"Of the machine: {help}.", show_default="left out")


def _peeking(help: str) -> Any:
    return typer.Option(help=f"Of a text file that is shown: {help}.", show_default="found")


def _print_templates(wanted: bool) -> None:
    if wanted:
        for template, about in ABOUT.items():
            typer.echo(f"{template.value:18}{about}")
        raise typer.Exit


@with_options("debug")
def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new or empty folder.", show_default=False)],
    options: CommonOptions,  # noqa: ARG001
    template: Annotated[
        Template, typer.Option("--template", help="Template; --list shows what each contains.")
    ] = Template.quickstart,
    _list: Annotated[
        bool, typer.Option("--list", callback=_print_templates, is_eager=True, help="List the templates and exit.")
    ] = False,
) -> None:
    """Write a commented experiment from a template; it runs as it is. `gbid init` drafts one for measured files."""
    from gbid.cli.templates import write_template

    _print_written(write_template(template.value, folder), folder, "run", "check")


@with_options("debug")
def init(
    measured: MeasuredFolder,
    options: CommonOptions,  # noqa: ARG001
    folder: Annotated[
        Path | None,
        typer.Argument(metavar="[DIR]", help="A new or empty folder.", show_default="FOLDER-experiment, here"),
    ] = None,
    signal: Annotated[list[str] | None, _drafting("columns of r, u, p or phi", "NAME=X,Y")] = None,
    time: Annotated[str | None, _drafting("column of the sample times", "COLUMN")] = None,
    sample_time: Annotated[float | None, _drafting("time between samples", "S")] = None,
    unit: Annotated[list[str] | None, _drafting("unit of positions whose file states none", "UNIT|NAME=UNIT")] = None,
    calibration: Annotated[list[str] | None, _drafting("points of a sheet and their unit", "X='0:0 10:125 um'")] = None,
    time_unit: Annotated[str | None, _drafting("unit of the sample times")] = None,
    pattern: Annotated[str | None, _drafting("pattern of the file names")] = None,
    kind: Annotated[list[str] | None, _drafting("kind of files with a word in their name", "WORD=KIND")] = None,
    skip_broken: Annotated[
        bool, typer.Option("--skip-broken", help="Leave out broken files and dead channels.")
    ] = False,
    encoding: Annotated[str | None, _drafting("encoding")] = None,
    decimal: Annotated[str | None, _drafting("decimal sign")] = None,
    delimiter: Annotated[str | None, _drafting("character between cells")] = None,
    header_line: Annotated[int | None, _drafting("number of the line with the names; 0 for none")] = None,
    from_s: Annotated[float | None, _drafting("begin of the part to use", "S")] = None,
    to_s: Annotated[float | None, _drafting("end of the part to use", "S")] = None,
    pressure: Annotated[float | None, _drafting("pressure of all files", "BAR")] = None,
    speed: Annotated[float | None, _drafting("speed of all files", "RPM")] = None,
    controller: Annotated[str, typer.Option(help="Of measured files: structure of the controller.")] = "P",
    moving_mass: Annotated[float | None, _of_machine("mass that an impact moves", "KG")] = None,
    travel: Annotated[float | None, _of_machine("whole travel of a piezo stack", "UM")] = None,
    clearance: Annotated[float | None, _of_machine("clearance of the bearing", "UM")] = None,
) -> None:
    """Draft an experiment for a gas bearing from the files of a folder, and ask for all that they do not say."""
    from gbid.cli.printing import tell
    from gbid.cli.templates import refuse_used, write_draft
    from gbid.experiment.draft import DraftOptions
    from gbid.experiment.schema import Kind
    from gbid.lpv import MachineData
    from gbid.recording.mapping import TextOptions
    from gbid.recording.roles import ROLES

    folder = drafted_folder(measured, folder)
    refuse_used(folder)
    layout: Any = (encoding, decimal, delimiter, header_line)
    kinds = dict(_pair("--kind", text) for text in kind or ())
    if wrong := [text for text in kinds.values() if text not in get_args(Kind)]:
        raise UsageError(f"--kind: {wrong[0]!r} is no kind; choose from {', '.join(get_args(Kind))}")
    drafted = DraftOptions(
        measured,
        time=time,
        sample_time=sample_time,
        time_unit=time_unit,
        text=TextOptions(*layout),
        pattern=pattern,
        from_s=from_s,
        to_s=to_s,
        pressure_bar=pressure,
        speed_rpm=speed,
        kinds=cast("dict[str, Kind]", kinds),
        skip_broken=skip_broken,
        controller=controller,
        machine=MachineData(
            moving_mass,
            *(None if value is None else float(f"{1e-6 * value:.12g}") for value in (travel, clearance)),
        ),
        ask=sys.stdin.isatty(),
    )
    for option, texts in (("unit", unit), ("calibration", calibration)):
        for text in texts or ():
            drafted = drafted.answered(option, text)
    for text in signal or ():
        name, columns = _pair("--signal", text)
        if name not in ROLES:
            raise UsageError(f"--signal: expected r, u, p or phi with its columns, as p=X,Y; found {text!r}")
        drafted = drafted.answered(name, columns)
    draft = _drafted(drafted, folder)
    written = write_draft(draft.text, folder)
    tell("\n".join(draft.columns))
    _print_written(written, folder, "check", "run", draft.notes)


def _pair(option: str, text: str) -> tuple[str, str]:
    """Return name and value of an option of the form NAME=VALUE."""
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise UsageError(f"{option}: expected NAME=VALUE; found {text!r}")
    return name.strip(), value.strip()


def _print_written(written: Sequence[Path], folder: Path, first: str, then: str, notes: Sequence[str] = ()) -> None:
    """Print the files of a new experiment, and the commands to run next."""
    for path in written:
        typer.echo(str(path))
    experiment = folder / "experiment.yaml"
    lines = [*(f"note: {text}" for text in notes), f"next: gbid {first} {experiment}"]
    lines.append(f"then: change {experiment} and {then} it with gbid {then} {experiment}")
    typer.echo("\n".join(lines), err=True)


_OF_MACHINE = {
    "moving_mass_kg": ("moving mass [kg]", 1.0),
    "piezo_travel_m": ("whole travel of a piezo stack [um]", 1e-6),
    "clearance_m": ("radial clearance of the bearing [um]", 1e-6),
}
"""Questions on a machine by the field of `gbid.lpv.MachineData`, with the factor to SI."""


def _asked_machine(known: MachineData) -> MachineData:
    """Return the machine data, completed by answers of the user."""
    answers = {}
    for name, (question, factor) in _OF_MACHINE.items():
        if getattr(known, name) is None:
            text = typer.prompt(f"{question}, empty when unknown", default="", show_default=False, err=True)
            try:
                answers[name] = float(f"{factor * float(text.replace(',', '.')):.12g}") if text.strip() else None
            except ValueError:
                raise UsageError(f"{question}: expected a number, found {text!r}") from None
    return replace(known, **answers)


def _drafted(options: DraftOptions, target: Path) -> Draft:
    """Return the draft; on a terminal ask for everything that the files do not state."""
    from gbid.cli.printing import tell
    from gbid.experiment.draft import QUESTIONS, UnansweredError, draft_experiment, list_folder

    content = list_folder(options)  # read once, however many answers it takes
    while True:
        try:
            return draft_experiment(options, target, _asked_machine if options.ask else None, content)
        except UnansweredError as error:
            tell("\n".join(error.columns))
            tell("`gbid init` drafts a gas bearing; for another machine: gbid new DIR --template own-recordings")
            if not options.ask:
                raise
            for option, reason in error.reasons.items():
                tell(reason)
                options = options.answered(
                    option, typer.prompt(QUESTIONS[option], default="", show_default=False, err=True)
                )


# ---- `gbid peek`: the channels of one measured file.


@with_options("as_json", "debug")
def peek(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A measured file.", show_default=False)],
    options: CommonOptions,
    encoding: Annotated[str | None, _peeking("its encoding")] = None,
    decimal: Annotated[str | None, _peeking("its decimal sign")] = None,
    delimiter: Annotated[str | None, _peeking("the character between its cells")] = None,
    header_line: Annotated[int | None, _peeking("number of its line with the names; 0 for none")] = None,
) -> None:
    """Show the channels of a measured file: names, units, rates, first samples, and how it is read."""
    from gbid.cli.printing import print_json, print_tables
    from gbid.recording.importing import list_channels, read_layout
    from gbid.recording.mapping import TextOptions
    from gbid.report.campaign_tables import channel_rows, channel_table, layout_words

    given: Any = (encoding, decimal, delimiter, header_line)
    text = TextOptions(*given)
    rows, layout = channel_rows(list_channels(file, text)), read_layout(file, text)
    if options.as_json:
        print_json({"file": file, "layout": layout, "channels": rows})
    else:
        if layout:
            typer.echo(f"read as text: {layout_words(layout)}")
        print_tables(channel_table(file.name, rows))


# ---- `gbid export`: models and controllers for other programs.


def _complete_target(incomplete: str) -> list[str]:
    return [name for name in TARGETS if name.startswith(incomplete)]


@with_options("results", "overwrite", "as_json", "debug")
def export(
    source: Annotated[
        str,
        typer.Argument(
            metavar="EXPERIMENT|MODEL|CONTROLLER|DATA",
            help="An experiment YAML (its fits, LPV models and controllers), a model YAML or name, a controller YAML, "
            "a fit or a recording in .h5, or a folder of these.",
            show_default=False,
            autocompletion=complete_source,
        ),
    ],
    options: CommonOptions,
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
        typer.Option("--number", help="Of --to c: type of the numbers; else that of the section target, or double."),
    ] = None,
    mass: Annotated[
        float | None, typer.Option("--mass", metavar="KG", help="Of --to ross: modal mass of the rotor, needed there.")
    ] = None,
    balance: Annotated[
        bool,
        typer.Option("--balance", help="Of --to c: cancel unbalance while running, by the identified model."),
    ] = False,
    speeds: Annotated[
        tuple[float, float] | None,
        typer.Option("--speeds", metavar="RPM RPM", help="Of --balance: lowest and highest speed; else of the model."),
    ] = None,
    learn: Annotated[
        str,
        typer.Option("--learn", metavar="NAMES", help="Of --to c: parameters to estimate while running, k_xx,k_yy."),
    ] = "",
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Folder; `export` in the results, or here for a file."),
    ] = None,
) -> None:
    """Write models, controllers and recordings for other programs."""
    from gbid.cli.printing import print_json, print_notes, tell, tell_line
    from gbid.experiment.exporting import find_exports, write_exports

    export_target(to)
    for option, value, target in (
        ("--number", number, "c"),
        ("--balance", balance or None, "c"),
        ("--mass", mass, "ross"),
    ):
        if value is not None and to != target:
            raise UsageError(f"{option} is for --to {target}; leave it out with --to {to}")
    if speeds is not None and not balance:
        raise UsageError("--speeds is for --balance; leave it out without")
    names = tuple(name.strip() for name in learn.split(",") if name.strip())
    exports = find_exports(source, at, options.results, tell_line)
    request = ExportRequest(output or exports.folder, options.overwrite, at, number, mass, balance, speeds, names)
    files = [str(path) for path in write_exports(exports, to, request)]
    if options.as_json:
        print_json({"files": files, "left_out": list(exports.left_out), "notes": list(exports.notes)})
    else:
        typer.echo("\n".join(files))
    print_notes(exports.notes)
    for text in exports.left_out:
        tell(f"gbid: warning: left out: {text}")


# ---- `gbid clean`: removal of files of killed runs, records of failures, and on request results.


@with_options("results", "dry_run", "quiet", "as_json", "debug")
def clean(
    experiment: ExperimentPath,
    options: CommonOptions,
    everything: Annotated[
        bool, typer.Option("--everything", help="Also remove the results; files that gbid did not make stay.")
    ] = False,
    kernels: Annotated[
        bool, typer.Option("--kernels", help="Also remove the compiled kernels of this user; they are compiled anew.")
    ] = False,
) -> None:
    """Remove temporary files of killed runs and records of failures, so that failed items are tried again."""
    from gbid.cli.printing import print_json
    from gbid.core.compiled import cache_folder
    from gbid.experiment.campaign import locked, remove, stale_files

    loaded = options.load(experiment, form_only=True)
    cache = cache_folder() if kernels else None
    if options.dry_run or not loaded.results.is_dir():
        stale = stale_files(loaded.results, everything, cache)
    else:
        with locked(loaded.results):
            stale = stale_files(loaded.results, everything, cache)
            remove(loaded.results, stale)
    if options.as_json:
        print_json({"results": loaded.results, "removed": [] if options.dry_run else stale, "found": stale})
        return
    if not options.quiet:
        for path in stale:
            typer.echo(str(path))
    typer.echo(f"{len(stale)} files {'would be ' if options.dry_run else ''}removed")
