"""Tables for a terminal, fed from the rows that programs read as JSON."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import floor, log10

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from gbid.report.rows import Row
from gbid.report.summary import summary_lines
from gbid.tables.numbers import engineering, exponent_of, shown_unit


def fit_tables(title: str, document: Row) -> Group:
    """Parameters, modes, static gain and fit of one fit, one below the other.

    Parameters
    ----------
    title : str
    document : dict
        From `gbid.report.rows.fit_document`.
    """
    parts: list[Table | Text] = [parameter_table(title, document["parameters"], document["trusted"]), Text("")]
    if document["modes"]:
        parts += [mode_table(document["modes"]), Text("")]
    if document["static_gain"]:
        parts += [gain_table(document["static_gain"]), Text("")]
    return Group(*parts, summary_table(summary_lines(document)), Text(""))


def parameter_table(title: str, rows: Sequence[Row], trusted: str) -> Table:
    """Estimates, standard deviations and truth; each row in one power of ten."""
    with_truth = any(row["truth"] is not None for row in rows)
    truth = ["truth", "off by", "in std"] if with_truth else []
    table = new_table(title, ["parameter", "estimate", f"std\n({trusted})", *truth, "unit"], left=("parameter", "unit"))
    for row in rows:
        factor, unit = shown_unit(row["unit"])
        estimate = factor * row["estimate"]
        spread = factor * (row["std"] or 0.0)
        exponent = exponent_of(max(abs(estimate), spread))
        std = "fixed" if row["fixed"] else engineering(_times(factor, row["std"]), 2, exponent)
        cells = [row["parameter"], engineering(estimate, _digits(estimate, spread), exponent), std]
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
    truth = ["truth"] if with_truth else []
    table = new_table("", ["mode", "frequency\n[Hz]", "std", *truth, "damping\nfactor", "std", *truth], left=("mode",))
    for row in rows:
        cells = [str(row["mode"])]
        for key, std, true, least in (
            ("frequency_hz", "frequency_std_hz", "true_frequency_hz", 2),
            ("damping", "damping_std", "true_damping", 4),
        ):
            decimals = _decimals(row[std], least)
            cells += [f"{row[key]:.{decimals}f}", "-" if row[std] is None else f"{row[std]:.{decimals}f}"]
            cells += [f"{row[true]:.{decimals}f}"] if with_truth else []
        table.add_row(*cells)
    return table


def gain_table(rows: Sequence[Row]) -> Table:
    """Lay out static gains; those that the structure holds at zero are left out."""
    with_truth = any(row["truth"] is not None for row in rows)
    table = new_table("", ["static gain", "value", "std", *(["truth"] if with_truth else [])], left=("static gain",))
    for row in rows:
        if row["gain"] == 0 and not row["std"]:
            continue
        exponent = exponent_of(row["gain"])
        cells = [engineering(row["gain"], 5, exponent), engineering(row["std"], 2, exponent)]
        cells += [engineering(row["truth"], 5, exponent)] if with_truth else []
        table.add_row(f"{row['input']} to {row['output']}", *cells)
    return table


def summary_table(lines: Iterable[tuple[str, str]]) -> Table:
    """Lines with a word before each; long ones go on below their own beginning."""
    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for word, text in lines:
        table.add_row(Text(word), Text(text))
    return table


def prefilter_table(rows: Sequence[Row]) -> Table:
    """Lay out what the prefilter took out."""
    columns = ["recording", "", "rms before\n[µm]", "after\n[µm]", "run-out\nshare", "harmonics\n1, 2, 3 [µm]"]
    table = new_table("prefilter", [*columns, "spikes"], left=("recording", ""))
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


def crossval_table(title: str, rows: Sequence[Row]) -> Table:
    """Fit percent of each model on each recording, simulated, and what the residuals say."""
    missed = any(row["missed"] for row in rows)
    columns = ["model of", "on", "output", "fit\n[%]", "largest\nerror", "residuals\nwhite", "follow"]
    left = ("model of", "on", "output", "follow", "")
    table = new_table(f"{title}, cross-validation, simulated", [*columns, *([""] if missed else [])], left=left)
    for row in rows:
        factor, unit = (1e6, "µm") if row["unit"] == "m" else (1.0, row["unit"])
        cells = [row[key] for key in ("model", "recording", "output")]
        cells += [f"{row['fit_percent']:.2f}", f"{engineering(factor * row['infinity_norm'], 2)} {unit}"]
        white = {None: "-", True: "yes", False: "no"}[row["residuals_white"]]
        cells += [white, ", ".join(row["residuals_follow"]) or "-"]
        cells += [f"below {row['minimum_percent']:g} %" if row["missed"] else ""] if missed else []
        table.add_row(*cells)
    return table


def recording_table(rows: Sequence[Row]) -> Table:
    """Lay out recordings with their length and operating point."""
    table = new_table("recordings", ["recording", "samples", "duration [s]", "conditions", "state"])
    for row in rows:
        conditions = ", ".join(f"{key} {value:g}" for key, value in row["conditions"].items())
        table.add_row(row["name"], str(row["samples"]), f"{row['duration_s']:g}", conditions, row["state"])
    return table


def campaign_tables(document: Row) -> Group:
    """Sum up a campaign: what became of the items of each stage, and how the fits came out."""
    stages = new_table("", ["stage", "made", "kept", "failed", "not converged"], left=("stage",))
    for stage, counts in document["stages"].items():
        stages.add_row(stage, *(str(counts[state]) for state in ("made", "kept", "failed", "not_converged")))
    fits = new_table("", ["fit", "fits", "converged", "missing", "median [%]", "worst [%]", "of"], left=("fit", "of"))
    for row in document["fits"]:
        medians = ", ".join(f"{output} {value:.1f}" for output, value in row["median_fit_percent"].items())
        worst = "" if row["worst"] is None else f"{row['worst_fit_percent']:.1f}"
        numbers = (str(row[key]) for key in ("fits", "converged", "missing"))
        fits.add_row(row["fit"], *numbers, medians, worst, row["worst"] or "")
    return Group(*(part for table in (stages, fits) if table.row_count for part in (table, Text(""))))


def _digits(estimate: float, std: float) -> int:
    """Significant digits of an estimate: five, or as many as its standard deviation has when that is larger."""
    if estimate == 0 or abs(estimate) >= std:
        return 5
    return max(1, 2 + floor(log10(abs(estimate))) - floor(log10(std)))


def _decimals(std: float | None, least: int) -> int:
    """Decimals that show two digits of a standard deviation."""
    return least if not std else min(max(least, 1 - floor(log10(std))), 7)


def new_table(title: str, columns: Sequence[str], left: Sequence[str] = ("recording", "conditions", "state")) -> Table:
    """Begin a table in the house style; the columns named in `left` hold words."""
    table = Table(
        title=Text(title) if title else None,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
    )
    for column in columns:
        table.add_column(column, justify="left" if column in left else "right", no_wrap=True)
    return table


def _times(factor: float, value: float | None) -> float | None:
    return None if value is None else factor * value
