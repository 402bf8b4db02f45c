"""Document of a fit (plain values in SI units, for JSON and pages), and the tables made from it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from math import floor, log10
from typing import Any

import numpy as np

from gbid.core.errors import UsageError
from gbid.core.tables import (
    Cell,
    Column,
    Entry,
    Row,
    Table,
    engineering,
    exponent_of,
    finite_or_none,
    formatted,
    probability,
    shown_unit,
)
from gbid.structure.models import LinearModel


def parameter_rows(result: Any, truth: Mapping[str, float]) -> list[Row]:
    """Return estimates with standard deviations and, where known, true values.

    Parameters
    ----------
    result : FitResult
        Result of the fit.
    truth : dict of str to float
        True values of some parameters; may be empty.

    Returns
    -------
    list of dict
        parameter, estimate, std (the one to use), std_white, std_robust, truth,
        deviation_std (in standard deviations), deviation_percent, unit, fixed, start, start_origin. Unknown values are
        None, also the standard deviation of a parameter without one.
    """
    rows = []
    white, robust = result.std_with("white"), result.std_with("robust")
    for name, estimate in result.parameters.items():
        std, true = result.std[name], truth.get(name)
        off = None if true is None else estimate - true
        rows.append(
            {
                "parameter": name,
                "estimate": estimate,
                "std": finite_or_none(std),
                "std_white": finite_or_none(white[name]),
                "std_robust": finite_or_none(robust[name]),
                "truth": true,
                "deviation_std": off / std if off is not None and np.isfinite(std) and std > 0 else None,
                "deviation_percent": 100 * off / abs(true) if off is not None and true else None,
                "unit": result.units[name],
                "fixed": name not in result.free,
                "start": result.start[name],
                "start_origin": result.start_origin[name],
            }
        )
    return rows


def mode_rows(result: Any, truth: LinearModel | None) -> list[Row]:
    """Return natural frequencies and damping factors in ascending order, with standard deviations and true values."""
    modes = result.model.modes()
    known = truth.modes() if truth is not None else []
    true = known if len(known) == len(modes) else [(None, None)] * len(modes)
    return [
        {
            "mode": i,
            "frequency_hz": frequency,
            "frequency_std_hz": finite_or_none(frequency_std),
            "damping": damping,
            "damping_std": finite_or_none(damping_std),
            "true_frequency_hz": true_frequency,
            "true_damping": true_damping,
        }
        for i, ((frequency, damping), (frequency_std, damping_std), (true_frequency, true_damping)) in enumerate(
            zip(modes, result.modes_std, true, strict=True), 1
        )
    ]


def gain_rows(result: Any, truth: LinearModel | None) -> list[Row]:
    """Return static gains with standard deviations and true values; empty for a model with a pole at zero."""
    model = result.model
    try:
        gain = model.static_gain()
    except UsageError:
        return []
    true = truth.static_gain() if truth is not None else None
    return [
        {
            "output": output,
            "input": source,
            "gain": float(gain[i, j]),
            "std": finite_or_none(result.static_gain_std[i, j]),
            "truth": None if true is None else float(true[i, j]),
        }
        for i, output in enumerate(model.output_names)
        for j, source in enumerate(model.input_names)
    ]


def profile_rows(result: Any) -> list[Row]:
    """Return the intervals of the computed profile likelihoods; an open end is None."""
    return [
        {
            "parameter": name,
            "level": profile.level,
            "lower": finite_or_none(profile.interval[0]),
            "upper": finite_or_none(profile.interval[1]),
            "verdict": profile.verdict,
            "unit": profile.unit,
        }
        for name, profile in result.profiles.items()
    ]


def fit_document(result: Any, truth: Mapping[str, float] | None = None, true_model: LinearModel | None = None) -> Row:
    """Return the document of a fit, including true values where they are known."""
    truth = truth or {}
    outputs, starts = result.model.output_names, result.multi_start
    return {
        "structure": result.structure,
        "recordings": list(result.recordings),
        "status": result.status,
        "success": result.success,
        "iterations": result.iterations,
        "wall_time_s": result.wall_time_s,
        "loss": result.loss,
        "aic": finite_or_none(result.aic),
        "fpe": finite_or_none(result.fpe),
        "condition": finite_or_none(result.condition),
        "trusted": result.trusted,
        "whiteness": [
            {"output": output, "p_value": finite_or_none(p)}
            for output, p in zip(outputs, result.whiteness, strict=True)
        ],
        "multi_start": None if starts is None else {**asdict(starts), "spread": finite_or_none(starts.spread)},
        "options": dict(vars(result.options)),
        "parameters": parameter_rows(result, truth),
        "modes": mode_rows(result, true_model),
        "static_gain": gain_rows(result, true_model),
        "profiles": profile_rows(result),
        "fit_percent": [
            {"recording": recording, "output": output, "fit_percent": float(percent)}
            for recording, percents in zip(result.recordings, result.fit_percent, strict=True)
            for output, percent in zip(outputs, percents, strict=True)
        ],
        "notes": list(result.notes),
    }


Line = tuple[str, str]
"""Heading and text of a line."""

_MINIMA = 6  # largest number of minima that are listed
_FAR = 5.0  # smallest deviation from the truth, in standard deviations, that noise does not explain


def summary_lines(document: Row) -> Iterator[Line]:
    """Yield the lines of the summary: fit percent, weights, residuals, start, solver status, and notes.

    Parameters
    ----------
    document : dict
        Document of `fit_document`.

    Yields
    ------
    (word, text)
        Heading and text of each line.
    """
    how = "one step ahead" if document["options"].get("focus") == "prediction" else "simulated"
    for recording in document["recordings"]:
        fits = [row for row in document["fit_percent"] if row["recording"] == recording]
        text = ", ".join(f"{row['output']} {row['fit_percent']:.2f} %" for row in fits)
        yield "fit", f"{text} ({how}, on {recording})"
    if len(document["whiteness"]) > 1:
        det = document["options"].get("criterion") == "det"
        yield "outputs", "weighted by the covariance of their errors (det)" if det else "squared errors summed (trace)"
    yield "residuals", residuals_line(document)
    yield "start", start_line(document)
    if document["multi_start"]:
        yield "starts", starts_line(document["multi_start"])
    condition = "" if document["condition"] is None else f", condition {document['condition']:.1g}"
    text = f"{document['status']}; {document['iterations']} iterations, {document['wall_time_s']:.2f} s{condition}"
    yield "solver", text
    yield from (("note", note) for note in document["notes"])
    far = [row for row in document["parameters"] if abs(row["deviation_std"] or 0.0) > _FAR]
    if far:
        names = ", ".join(f"{row['parameter']} ({row['deviation_std']:+.0f})" for row in far)
        text = f"many standard deviations from the truth: {names}; a bias of structure, hold or prefilter, not noise"
        yield "note", text


def residuals_line(document: Row) -> str:
    """Return the result of the whiteness test of each output, with p-value, as text."""
    level = 0.01 / max(1, len(document["whiteness"]))  # shared by the outputs, as the fit shares it

    def word(p: float | None) -> str:
        return "unknown" if p is None else f"{'white' if p >= level else 'not white'} ({probability(p)})"

    return ", ".join(f"{row['output']} {word(row['p_value'])}" for row in document["whiteness"])


def start_line(document: Row) -> str:
    """Return a text with the number of start values of each origin, and the names of the user's start values."""
    rows = [row for row in document["parameters"] if not row["fixed"]]
    words = {"data": "from the data", "structure": "from the structure", "user": "given"}
    parts = []
    for origin, word in words.items():
        names = [row["parameter"] for row in rows if row["start_origin"] == origin]
        if names:
            listed = f" ({', '.join(names)})" if origin == "user" or len(names) <= 4 else ""
            parts.append(f"{len(names)} {word}{listed}")
    return ", ".join(parts)


def starts_line(row: Row) -> str:
    """Return a text with the number of starts that reached the smallest loss, and the minima with losses."""
    spread = "-" if row["spread"] is None else f"{row['spread']:.4g}"
    text = (
        f"{row['starts']} (seed {row['seed']}): {row['converged']} converged, {row['agreed']} ended at the best; "
        f"largest over smallest loss {spread}"
    )
    minima = [f"{loss:.5g} ({count})" for loss, count in zip(row["minima"], row["minima_starts"], strict=True)]
    if len(minima) < 2:
        return text
    more = [f"{len(minima) - _MINIMA} more"] if len(minima) > _MINIMA else []
    return f"{text}; {len(minima)} minima, loss (starts): {', '.join([*minima[:_MINIMA], *more])}"


# Heading, unit, entries of the row, and smallest number of decimals of a mode.
_MODE = (
    ("frequency\n", "Hz", "frequency_hz", "frequency_std_hz", "true_frequency_hz", 2),
    ("damping\nfactor", "", "damping", "damping_std", "true_damping", 4),
)


def fit_tables(document: Row) -> list[Table]:
    """Return the tables of a fit from its document: parameters, modes, static gain, profile likelihoods, summary."""
    return [
        parameter_table(document["parameters"], document["trusted"]),
        *([mode_table(document["modes"])] if document["modes"] else []),
        *([gain_table(document["static_gain"])] if document["static_gain"] else []),
        *([profile_table(document["profiles"])] if document["profiles"] else []),
        Table("", [Column(""), Column("", wrap=True)], list(summary_lines(document))),
    ]


def parameter_table(rows: Sequence[Row], trusted: str) -> Table:
    """Return the table of estimates, standard deviations and true values; each row has one power of ten."""
    with_truth = any(row["truth"] is not None for row in rows)
    kind = "not trusted" if trusted == "none" else trusted
    columns = [Column("parameter"), Column("estimate", format=5), Column(f"std\n({kind})", format=2)]
    if with_truth:
        columns += [Column("truth", format=5), Column("off by", format="+z.2f"), Column("in std", format="+z.1f")]
    laid: list[list[Entry]] = []
    for row in rows:
        factor, unit = shown_unit(row["unit"])
        estimate, spread = factor * row["estimate"], factor * (row["std"] or 0.0)
        exponent = exponent_of(max(abs(estimate), spread))
        std = Cell(None, "fixed") if row["fixed"] else _in_power(row["std"], 2, exponent, factor)
        # Five significant digits, or enough to show the standard deviation.
        fewer = estimate != 0 and abs(estimate) < spread
        digits = max(1, 2 + floor(log10(abs(estimate))) - floor(log10(spread))) if fewer else 5
        cells = [row["parameter"], _in_power(row["estimate"], digits, exponent, factor), std]
        if with_truth:
            off = formatted(row["deviation_percent"], "+z.2f", "%")
            cells += [_in_power(row["truth"], 5, exponent, factor), off, row["deviation_std"]]
        laid.append([*cells, unit])
    return Table("", [*columns, Column("unit")], laid)


def mode_table(rows: Sequence[Row]) -> Table:
    """Return the table of natural frequencies and damping factors."""
    with_truth = any(row["true_frequency_hz"] is not None for row in rows)
    columns = [Column("mode")]
    laid: list[list[Entry]] = [[str(row["mode"])] for row in rows]
    for heading, unit, key, std, true, least in _MODE:
        form = f".{least}f"
        columns += [Column(heading, unit, form), Column("std", format=form)]
        columns += [Column("truth", format=form)] if with_truth else []
        for row, cells in zip(rows, laid, strict=True):  # two digits of the standard deviation
            decimals = min(max(least, 1 - floor(log10(row[std]))), 7) if row[std] else least
            cells += [formatted(row[name], f".{decimals}f") for name in (key, std, *([true] if with_truth else []))]
    return Table("", columns, laid)


def gain_table(rows: Sequence[Row]) -> Table:
    """Return the table of static gains, without the gains that are zero by structure."""
    with_truth = any(row["truth"] is not None for row in rows)
    columns = [Column("static gain"), Column("value", format=5), Column("std", format=2)]
    laid: list[list[Entry]] = []
    for row in rows:
        if row["gain"] != 0 or row["std"]:
            exponent = exponent_of(row["gain"])
            cells = [_in_power(row["gain"], 5, exponent), _in_power(row["std"], 2, exponent)]
            cells += [_in_power(row["truth"], 5, exponent)] if with_truth else []
            laid.append([f"{row['input']} to {row['output']}", *cells])
    return Table("", [*columns, *([Column("truth", format=5)] if with_truth else [])], laid)


def profile_table(rows: Sequence[Row]) -> Table:
    """Return the table of the intervals of profile likelihoods."""
    laid: list[list[Entry]] = []
    for row in rows:
        factor, unit = shown_unit(row["unit"])
        exponent = exponent_of(factor * max(abs(row[end] or 0.0) for end in ("lower", "upper")))
        ends = [_in_power(row[end], 5, exponent, factor) for end in ("lower", "upper")]
        laid.append([row["parameter"], *ends, row["verdict"], unit])
    head = f"profile likelihood, {100 * rows[0]['level']:g} %"
    return Table("", [Column(head), Column("from"), Column("to"), Column("verdict"), Column("unit")], laid)


def _in_power(value: float | None, digits: int, exponent: int, factor: float = 1.0) -> Entry:
    """Return a cell with a given power of ten, so that the numbers of a row are comparable."""
    return None if value is None else Cell(factor * value, engineering(factor * value, digits, exponent))
