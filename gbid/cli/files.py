"""`gbid new`: a new experiment from a template, or from a folder of measured files."""

from __future__ import annotations

import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
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
from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError, UsageError
from gbid.core.files import share_folder
from gbid.experiment.load import experiment_json_schema
from gbid.export.targets import export_target, target_names
from gbid.structure import LinearModel

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
    from gbid.core.errors import UsageError

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


# ---- Example data of templates: csv files as a data logger writes them.


def write_example_data(path: Path, seed: int, n_samples: int = 4000, sample_time: float = 5e-4) -> None:
    """Write a CSV file like that of a data logger: a mass on a spring, 40 Hz, damping factor 0.05, random input.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    seed : int
        Seed of the random numbers.
    n_samples : int
        Number of samples.
    sample_time : float
        Time between samples [s].
    """
    random = np.random.default_rng(seed)
    omega = 2 * np.pi * 40.0
    model = LinearModel(
        np.array([[0.0, 1.0], [-(omega**2), -2 * 0.05 * omega]]),
        np.array([[0.0], [2.0]]),
        np.array([[1.0, 0.0]]),
        np.array([[0.0]]),
    )
    volt = np.repeat(random.choice([-1.0, 1.0], size=-(-n_samples // 8)), 8)[:n_samples]
    metre = model.simulate(volt[:, None], sample_time)[:, 0] + 2e-7 * random.standard_normal(n_samples)
    time = 1e3 * sample_time * np.arange(n_samples)
    rows = np.column_stack([time, volt, 1e6 * metre])
    np.savetxt(path, rows, delimiter=",", header="time [ms],drive [V],position [um]", comments="", fmt="%.6g")


def write_held_bearing(path: Path, seed: int, n_samples: int = 6000, sample_time: float = 1e-4) -> None:
    """Write a CSV file of a magnetic bearing that a PD controller holds, with a random current added to its output.

    The bearing has the negative stiffness 4e4 N/(kg m), the damping 2 N s/(kg m) and the gain 60 N/(kg A).

    Parameters
    ----------
    path : pathlib.Path
        The file.
    seed : int
        Seed of the random numbers.
    n_samples : int
        Number of samples.
    sample_time : float
        Time between samples [s].
    """
    random = np.random.default_rng(seed)
    stiffness, gain = 4e4, 60.0
    rate = stiffness**0.5  # the poles are about +- this, in 1/s
    A = np.array([[np.cosh(rate * sample_time), np.sinh(rate * sample_time) / rate], [0.0, 0.0]])
    A[1] = [rate * np.sinh(rate * sample_time), np.cosh(rate * sample_time)]
    A[:, 1] *= np.exp(-2.0 * sample_time)  # damping
    B = gain * np.array([(np.cosh(rate * sample_time) - 1) / stiffness, np.sinh(rate * sample_time) / rate])
    added = np.repeat(random.choice([-0.15, 0.15], -(-n_samples // 20)), 20)[:n_samples]
    noise = 1e-6 * random.standard_normal(n_samples)
    current, position = np.empty(n_samples), np.empty(n_samples)
    x: FloatArray = np.zeros(2)
    before, velocity = 0.0, 0.0
    for k in range(n_samples):
        position[k] = x[0] + noise[k]
        velocity += 0.3 * ((position[k] - before) / sample_time - velocity)
        before = position[k]
        current[k] = added[k] - (5 * stiffness * position[k] + 2.8 * rate * velocity) / gain
        x = A @ x + B * current[k]
    rows = np.column_stack([1e3 * sample_time * np.arange(n_samples), added, current, 1e6 * position])
    header = "time [ms],added [A],current [A],position [um]"
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.6g")


# ---- Templates of experiments that `gbid new` writes.

SCHEMA = "experiment.schema.json"
"""Name of the schema file beside an experiment; an editor completes and checks keys with it."""

EXPERIMENT = "experiment.yaml"
_EXAMPLES = {
    "own_recordings": (write_example_data, ""),
    "magnetic_bearing": (write_held_bearing, "magnetic_bearing.py"),
}
"""Writer of the example data of each template with data, and the file of ``models`` that it takes along."""


def write_template(template: str, folder: Path) -> list[Path]:
    """Write the files of a template and the schema for editors into a new or empty folder: all of them or none.

    Parameters
    ----------
    template : str
        Name of the template, as `gbid new --list` shows it.
    folder : pathlib.Path
        Folder to write to.

    Returns
    -------
    list of pathlib.Path
        The files written.

    Raises
    ------
    UsageError
        When the folder exists and is not empty.
    DataError
        When the folder cannot be written.
    """
    source = share_folder("experiments") / template.replace("-", "_")
    return _write(folder, lambda part: _copy(source, part))


def write_draft(text: str, folder: Path) -> list[Path]:
    """Write an experiment and the schema for editors into a new or empty folder: both or none.

    Raises
    ------
    UsageError
        When the folder exists and is not empty.
    DataError
        When the folder cannot be written.
    """
    return _write(folder, lambda part: _write_text(part / EXPERIMENT, text))


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def _copy(source: Path, part: Path) -> None:
    """Copy a template, which is a file or a folder; a folder has example data made for it."""
    if not source.is_dir():
        shutil.copyfile(source.with_suffix(".yaml"), part / EXPERIMENT)
        return
    for file in sorted(source.iterdir()):
        if file.suffix in (".yaml", ".py"):
            shutil.copyfile(file, part / file.name)
    (part / "data").mkdir()
    write, model = _EXAMPLES[source.name]
    for seed in (1, 2):
        write(part / "data" / f"run{seed}.csv", seed)
    if model:
        shutil.copyfile(share_folder("models") / model, part / model)


def refuse_used(folder: Path) -> None:
    """Refuse a folder that exists and is not empty.

    Raises
    ------
    UsageError
        When it is so.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder} exists and is not empty; choose another folder")


def _write(folder: Path, fill: Callable[[Path], None]) -> list[Path]:
    refuse_used(folder)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}.", suffix=".part"))
    except OSError as error:
        raise DataError(f"{folder}: cannot be written: {error.strerror or error}") from None
    try:
        fill(part)
        _add_schema(part)
        mask = os.umask(0)
        os.umask(mask)
        part.chmod(0o777 & ~mask)
        part.replace(folder)
    except OSError as error:
        raise DataError(f"{folder}: cannot be written: {error.strerror or error}") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return sorted(path for path in folder.rglob("*") if path.is_file())


def _add_schema(folder: Path) -> None:
    """Write the schema, and name it in the first line of the experiment, where editors look for it."""
    schema = json.dumps(experiment_json_schema(), indent=2, ensure_ascii=False)
    (folder / SCHEMA).write_text(schema + "\n", encoding="utf-8")
    experiment = folder / EXPERIMENT
    text = experiment.read_text(encoding="utf-8")
    experiment.write_text(f"# yaml-language-server: $schema={SCHEMA}\n{text}", encoding="utf-8")


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
    return [name for name in target_names() if name.startswith(incomplete)]


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
            help=f"What to write: {', '.join(target_names())}.",
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
    measure: Annotated[
        bool, typer.Option("--measure", help="Run C source on an emulated Cortex-M4F and write its instructions down.")
    ] = False,
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
        from gbid.export.target import ExportRequest

        export_target(to)
        found = find_exports(source, at, results)
        request = ExportRequest(output or found.folder, overwrite, at, number, measure, mass)
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
