"""Tables for a terminal, fed from the rows that programs read as JSON."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from gbid.report.numbers import engineering, exponent_of, shown_unit
from gbid.report.rows import Row


def fit_tables(title: str, document: Row) -> Group:
    """Parameters, modes, static gain and fit of one fit, one below the other.

    Parameters
    ----------
    title : str
    document : dict
        From `gbid.report.rows.fit_document`.
    """
    parts: list[Table | Text] = [parameter_table(title, document["parameters"]), Text("")]
    if document["modes"]:
        parts += [mode_table(document["modes"]), Text("")]
    if document["static_gain"]:
        parts += [gain_table(document["static_gain"]), Text("")]
    parts += [Text(f" {line}") for line in summary_lines(document)]
    return Group(*parts, Text(""))


def parameter_table(title: str, rows: Sequence[Row]) -> Table:
    """Estimates, standard deviations and truth; each row in one power of ten."""
    with_truth = any(row["truth"] is not None for row in rows)
    columns = ["parameter", "estimate", "std", *(["truth", "off by", "in std"] if with_truth else []), "unit"]
    table = _table(title, columns, left=("parameter", "unit"))
    for row in rows:
        factor, unit = shown_unit(row["unit"])
        estimate = factor * row["estimate"]
        exponent = exponent_of(estimate)
        std = "fixed" if row["fixed"] else engineering(_times(factor, row["std"]), 2, exponent)
        cells = [row["parameter"], engineering(estimate, 5, exponent), std]
        if with_truth:
            percent, deviation = row["deviation_percent"], row["deviation_std"]
            cells += [
                engineering(_times(factor, row["truth"]), 5, exponent),
                "-" if percent is None else f"{percent:+.2f} %",
                "-" if deviation is None else f"{deviation:+.1f}",
            ]
        table.add_row(*cells, unit)
    return table


def mode_table(rows: Sequence[Row]) -> Table:
    """Natural frequencies and damping factors."""
    with_truth = any(row["true_frequency_hz"] is not None for row in rows)
    truth = ("truth [Hz]", "damping", "truth") if with_truth else ("damping",)
    table = _table("", ["mode", "frequency [Hz]", *truth], left=("mode",))
    for row in rows:
        cells = [str(row["mode"]), f"{row['frequency_hz']:.2f}"]
        cells += [f"{row['true_frequency_hz']:.2f}"] if with_truth else []
        cells += [f"{row['damping']:.4f}"]
        cells += [f"{row['true_damping']:.4f}"] if with_truth else []
        table.add_row(*cells)
    return table


def gain_table(rows: Sequence[Row]) -> Table:
    """Lay out static gains."""
    with_truth = any(row["truth"] is not None for row in rows)
    table = _table("", ["static gain", "value", *(["truth"] if with_truth else [])], left=("static gain",))
    for row in rows:
        cells = [f"{row['input']} to {row['output']}", engineering(row["gain"], 4)]
        table.add_row(*cells, *([engineering(row["truth"], 4)] if with_truth else []))
    return table


def summary_lines(document: Row) -> Iterable[str]:
    """Fit percent, status and notes in words."""
    own = "one step ahead" if document["options"].get("focus") == "prediction" else "simulated"
    for recording in document["recordings"]:
        fits = [row for row in document["fit_percent"] if row["recording"] == recording]
        text = ", ".join(f"{row['output']} {row['fit_percent']:.2f} %" for row in fits)
        yield f"fit on {recording}, {own}: {text}"
    yield f"{document['status']}; {document['iterations']} iterations, {document['wall_time_s']:.2f} s"
    yield from (f"note: {note}" for note in document["notes"])


def prefilter_table(rows: Sequence[Row]) -> Table:
    """Lay out what the prefilter took out."""
    columns = ["recording", "channel", "rms before [µm]", "after [µm]", "run-out share", "harmonics 1, 2, 3 [µm]"]
    table = _table("prefilter", [*columns, "spikes"], left=("recording", "channel"))
    for row in rows:
        harmonics = " ".join(f"{1e6 * amplitude:.2f}" for amplitude in row["harmonics"][:3])
        table.add_row(
            row["recording"],
            row["channel"],
            f"{1e6 * row['rms_before']:.3f}",
            f"{1e6 * row['rms_after']:.3f}",
            f"{row['runout_share']:.1%}",
            harmonics or "-",
            str(row["spikes"]),
        )
    return table


def crossval_table(rows: Sequence[Row]) -> Table:
    """Fit percent of each model on each recording, simulated."""
    table = _table(
        "cross-validation, simulated",
        ["fit", "model of", "on", "output", "fit [%]", "largest error", "unit", ""],
        left=("fit", "model of", "on", "output", "unit", ""),
    )
    for row in rows:
        factor, unit = (1e6, "µm") if row["unit"] == "m" else (1.0, row["unit"])
        missed = f"below {row['minimum_percent']:g} %" if row["missed"] else ""
        largest = engineering(factor * row["infinity_norm"], 3)
        cells = [row[key] for key in ("fit", "model", "recording", "output")]
        table.add_row(*cells, f"{row['fit_percent']:.2f}", largest, unit, missed)
    return table


def recording_table(rows: Sequence[Row]) -> Table:
    """Lay out recordings with their length and operating point."""
    table = _table("recordings", ["recording", "samples", "duration [s]", "conditions", "state"])
    for row in rows:
        conditions = ", ".join(f"{key} {value:g}" for key, value in row["conditions"].items())
        table.add_row(row["name"], str(row["samples"]), f"{row['duration_s']:g}", conditions, row["state"])
    return table


def _table(title: str, columns: Sequence[str], left: Sequence[str] = ("recording", "conditions", "state")) -> Table:
    table = Table(
        title=Text(title) if title else None,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        show_edge=False,
    )
    for column in columns:
        table.add_column(column, justify="left" if column in left else "right", no_wrap=True)
    return table


def _times(factor: float, value: float | None) -> float | None:
    return None if value is None else factor * value
