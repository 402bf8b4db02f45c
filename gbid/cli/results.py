"""`gbid show`, `compare` and `diff`: stored results, shown and compared."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gbid.cli.options import CommonOptions, files_ending, with_options

if TYPE_CHECKING:
    from gbid.control.assessment import TunedDesign
    from gbid.core.tables import Table
    from gbid.identify import FitResult

_TEXTS = (".yaml", ".yml", ".csv", ".txt", ".md", ".json")
_SHOWN = 20  # rows of a comparison; JSON has all


@with_options("as_json", "debug")
def show(
    result: Annotated[
        Path,
        typer.Argument(
            metavar="RESULT",
            help="A file of a results folder: .h5, .yaml, .csv, .txt, .md or .json.",
            show_default=False,
            autocompletion=files_ending(".h5", *_TEXTS),
        ),
    ],
    options: CommonOptions,
) -> None:
    """Show a stored result: its tables or its description; a result that is a text is printed as it is."""
    from gbid.cli.printing import print_json, print_tables
    from gbid.core.errors import DataError, UsageError
    from gbid.core.hdf5 import read_made_with
    from gbid.core.names import printable
    from gbid.report.campaign_tables import origin_table

    if result.is_dir():
        raise UsageError(f"{result}: a folder; name one of its files, or give two folders to `gbid diff`")
    if result.suffix in _TEXTS:
        try:
            text = result.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise DataError(f"{result}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
        if options.as_json:
            print_json({"file": result, "kind": "text", "text": text})
        else:
            typer.echo("\n".join(map(printable, text.rstrip().splitlines())))
        return
    kind, document, tables = _described(result)
    made_with = read_made_with(result)
    if options.as_json:
        print_json({"file": result, "kind": kind, **document, "made_with": made_with})
        return
    if not tables:
        typer.echo(document["text"])
    print_tables(*tables, origin_table([made_with]))


def _described(path: Path) -> tuple[str, dict[str, Any], list[Table]]:
    """Return kind, document and tables of the value in an HDF5 file; a value without tables has a text."""
    from gbid.core.tables import titled
    from gbid.identify import FitResult
    from gbid.stored import load

    value = load(path)
    if not hasattr(value, "document"):  # recordings, tables of fits: no tables that fit on a screen
        return type(value).__name__, {"text": repr(value)}, []
    name = f"{path.parent.name}, {path.stem}" if isinstance(value, FitResult) else path.stem
    return type(value).__name__, {"name": path.stem, **value.document()}, titled(name, value.tables())


# ---- `gbid compare`: models side by side on recordings.


@with_options("overwrite", "as_json", "debug")
def compare(
    models: Annotated[
        list[Path],
        typer.Argument(
            metavar="FIT...",
            help="Fits of a results folder (.h5).",
            show_default=False,
            autocompletion=files_ending(".h5"),
        ),
    ],
    options: CommonOptions,
    on: Annotated[
        list[Path] | None,
        typer.Option("--on", metavar="RECORDING", help="Recording (.h5) on which they are simulated; repeatable."),
    ] = None,
    plain: Annotated[
        list[Path] | None,
        typer.Option("--plain", metavar="RECORDING", help="Recording (.h5) for a model without structure; repeatable."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="A page (.html) with table and pictures.")
    ] = None,
) -> None:
    """Compare models on recordings: fit, AIC, whiteness and, on a page, frequency responses."""
    from gbid.cli.printing import print_json, print_tables
    from gbid.core.errors import UsageError
    from gbid.core.files import atomic_path
    from gbid.identify.result import FitResult
    from gbid.identify.start.black_box import subspace, subspace_orders
    from gbid.recording.recording import load_recording
    from gbid.report.write import comparison_text
    from gbid.stored import load
    from gbid.validate.comparison import compare as compared

    if not on:
        raise UsageError("--on is missing: give the recordings on which the models are compared")
    if others := [path for path in (*on, *(plain or ())) if path.is_file() and path.suffix not in (".h5", ".hdf5")]:
        raise UsageError(f"{others[0]}: give a recording (.h5), as `gbid import` makes it of a file of a logger")
    named: dict[str, Any] = {f"{path.parent.name}/{path.stem}": load(path, FitResult) for path in models}
    orders = None
    if plain:
        sources, first = [load_recording(path) for path in plain], next(iter(named.values())).options
        signals: Any = {"inputs": first.inputs, "outputs": first.outputs}
        orders = subspace_orders(sources, **signals)
        model = subspace(sources, orders.order, **signals)
        named[model.name] = model
    comparison = compared(named, [load_recording(path) for path in on])
    if output is not None:
        with atomic_path(output, options.overwrite) as part:
            part.write_text(comparison_text(comparison, orders), encoding="utf-8")
    table = comparison.table()
    if options.as_json:
        keys = ["model", "output", "states", "parameters", "fit_percent", "least_fit_percent", "aic", "p_white"]
        rows = [dict(zip(keys, row, strict=True)) for row in table.rows]
        order = orders.order if orders else None
        print_json({"recordings": comparison.recordings, "models": rows, "order": order, "page": output})
        return
    print_tables(*([orders.table()] if orders else []), table)
    if output is not None:
        typer.echo(str(output))


# ---- `gbid diff`: parameters, designs and settings of two results folders.


@with_options("as_json", "debug")
def diff(
    first: Annotated[Path, typer.Argument(metavar="A", help="A results folder.", show_default=False)],
    second: Annotated[Path, typer.Argument(metavar="B", help="Another one.", show_default=False)],
    options: CommonOptions,
) -> None:
    """Compare two results folders: parameters in units of their standard deviations, designs and settings."""
    from gbid.cli.printing import print_json, print_tables
    from gbid.control.assessment import TunedDesign
    from gbid.core.errors import UsageError
    from gbid.identify import FitResult
    from gbid.stored import load

    folders = first, second
    for folder in folders:
        if not folder.is_dir():
            raise UsageError(f"{folder}: no such folder; give the folders of two results")
    fits, fit_sides = _paired("fits", *folders)
    designs, design_sides = _paired("controller", *folders)
    document: dict[str, Any] = {"a": first, "b": second, "parameters": [], "designs": [], "settings": []}
    for name, paths in fits.items():
        a, b = (load(path, FitResult) for path in paths)
        document["parameters"] += parameter_differences(name, a, b)
        document["settings"] += _differences(name, _fit_settings(a), _fit_settings(b))
    for name, paths in designs.items():
        before, after = (load(path, TunedDesign) for path in paths)
        document["designs"] += _differences(name, _design_figures(before), _design_figures(after))
        document["settings"] += _differences(name, _design_settings(before), _design_settings(after))
    first_pair = next(iter([*fits.values(), *designs.values()]), None)
    if first_pair is not None:  # all results of a folder have nearly the same origin: one row for each difference
        document["settings"] += _differences("made with", *map(_origin, first_pair))
    document["compared"] = {"fits": len(fits), "designs": len(designs)}
    document["only_in_a"], document["only_in_b"] = ([*p, *q] for p, q in zip(fit_sides, design_sides, strict=True))
    if not fits and not designs:
        raise UsageError(f"{first} and {second} have no fit and no design in common; are these results folders?")
    if options.as_json:
        print_json(document)
    else:
        print_tables(*_tables(document))


def _paired(kind: str, first: Path, second: Path) -> tuple[dict[str, tuple[Path, Path]], tuple[list[str], list[str]]]:
    """Return the files of a kind in both folders, by name, and the names that only one folder has."""
    a, b = (
        {
            f"{kind}/{path.relative_to(folder / kind).with_suffix('')}": path
            for path in sorted((folder / kind).rglob("*.h5"))
        }
        for folder in (first, second)
    )
    both = {name: (a[name], b[name]) for name in a if name in b}
    return both, ([name for name in a if name not in b], [name for name in b if name not in a])


def parameter_differences(name: str, first: FitResult, second: FitResult) -> list[dict[str, Any]]:
    """Return the parameters of two fits that differ, with the difference b - a in units of their standard deviation.

    The unit is the larger of the two standard deviations. It holds for fits to the same data, whose errors are nearly
    equal; estimates from independent data differ by up to the square root of two more. It is None where neither fit has
    a standard deviation, as for a fixed parameter.

    Parameters
    ----------
    name : str
        Name of the fit.
    first, second : FitResult
        The fits, a and b.
    """
    from gbid.core.tables import finite_or_none

    rows: list[dict[str, Any]] = []
    for parameter in dict.fromkeys([*first.parameters, *second.parameters]):
        a, b = first.parameters.get(parameter), second.parameters.get(parameter)
        if a == b:
            continue
        known = [finite_or_none(fit.std[parameter]) for fit in (first, second) if parameter in fit.std]
        spread = max((std for std in known if std is not None), default=0.0)
        in_std = (b - a) / spread if spread and a is not None and b is not None else None
        rows.append({"fit": name, "parameter": parameter, "a": a, "b": b, "std": spread or None, "in_std": in_std})
    return rows


def _origin(path: Path) -> dict[str, Any]:
    """Return versions, YAML and seeds of a result, without data files and command."""
    from gbid.core.hdf5 import read_made_with

    origin = read_made_with(path)
    seeds = {f"seed ({key})": seed for key, seed in origin.pop("seeds", {}).items()}
    return {**{key: value for key, value in origin.items() if key not in ("data", "command")}, **seeds}


def _fit_settings(fit: FitResult) -> dict[str, Any]:
    return {"structure": fit.structure, "recordings": list(fit.recordings), "status": fit.status, **asdict(fit.options)}


def _design_figures(design: TunedDesign) -> dict[str, Any]:
    worst = {key: value for key, (value, _) in design.performance[0].worst.items()} if design.performance else {}
    return {"status": design.result.status, **design.result.gains, **worst}


def _design_settings(design: TunedDesign) -> dict[str, Any]:
    result = design.result
    goal = {"objective": result.objective, "points": [list(point) for point in result.points]}
    sampled = {"sample_time": design.sample_time, "method": design.method}
    return {"plant": design.plant, **goal, **sampled, "impact": asdict(design.impact)}


def _differences(name: str, first: Mapping[str, Any], second: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the entries that differ; entries are compared as printed, so that nan equals nan."""
    keys = dict.fromkeys([*first, *second])
    return [
        {"of": name, "what": key, "a": first.get(key), "b": second.get(key)}
        for key in keys
        if repr(first.get(key)) != repr(second.get(key))
    ]


def _tables(document: Mapping[str, Any]) -> Iterable[Table]:
    from gbid.core.tables import Column, Table, engineering

    compared = document["compared"]
    notes = [f"A: {document['a']}", f"B: {document['b']}"]
    notes += [
        f"only in {side.upper()}: {', '.join(document[f'only_in_{side}'])}"
        for side in "ab"
        if document[f"only_in_{side}"]
    ]
    rows = sorted(
        document["parameters"], key=lambda row: -abs(row["in_std"]) if row["in_std"] is not None else -float("inf")
    )
    title = f"parameters that differ: {len(rows)}, of {compared['fits']} fits"
    columns = [Column("fit"), Column("parameter"), Column("A", format=5), Column("B", format=5)]
    columns += [Column("std", format=2), Column("B - A\nin std", format="+.2f")]
    cells = [[row[key] for key in ("fit", "parameter", "a", "b", "std", "in_std")] for row in rows]
    yield Table(title, columns, cells[:_SHOWN], [*_more(rows), *notes])

    def words(value: Any) -> str:
        return engineering(value) if isinstance(value, float) else "-" if value is None else str(value)

    for key, title in (
        ("designs", f"figures that differ, of {compared['designs']} designs"),
        ("settings", "settings that differ"),
    ):
        rows = document[key]
        if rows:
            columns = [Column("of"), Column("what"), Column("A", wrap=True), Column("B", wrap=True)]
            texts = [[row["of"], row["what"], words(row["a"]), words(row["b"])] for row in rows[:_SHOWN]]
            yield Table(title, columns, texts, _more(rows))


def _more(rows: list[dict[str, Any]]) -> list[str]:
    return [f"{len(rows) - _SHOWN} more with --json"] if len(rows) > _SHOWN else []
