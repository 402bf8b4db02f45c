"""Tables of a campaign, of the channels of a file, and of the provenance of results."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from gbid import identify
from gbid.core.errors import UsageError
from gbid.core.tables import Column, Entry, Row, Table, keyed_table
from gbid.core.units import conversion_factor
from gbid.experiment.experiment import Experiment
from gbid.experiment.run import Outcome
from gbid.recording.readers import FileChannel

# ---- Tables of a campaign: states of the items of each stage, and a summary of the fits.

_STATES = ("made", "kept", "failed", "not_converged")


def campaign_document(
    experiment: Experiment, outcomes: Sequence[Outcome], table: identify.FitTable | None = None
) -> Row:
    """Return a summary of a campaign: states of the stages, fits by name, and the files of the table."""
    stages: dict[str, dict[str, int]] = {}
    for outcome in outcomes:
        if outcome.item.stage != "table":
            counts = stages.setdefault(outcome.item.stage, dict.fromkeys(_STATES, 0))
            counts[outcome.state] += 1
            counts["not_converged"] += outcome.state != "failed" and not outcome.converged
    return {
        "experiment": experiment.spec.name,
        "results": str(experiment.results),
        "stages": stages,
        "fits": [] if table is None else [_fit_of_campaign(table, name) for name in experiment.spec.fits],
        "table": [str(outcome.path) for outcome in outcomes if outcome.item.stage == "table"],
    }


def _fit_of_campaign(table: identify.FitTable, name: str) -> Row:
    """Return a summary of one fit name: converged, unconverged and missing models, median fit percent, worst fit."""
    rows = table.select(fit=name)
    fitted = np.isfinite(rows.fit_percent).any(axis=1)
    smallest = rows.fit_percent[fitted].min(axis=1, initial=np.inf)
    worst = int(np.argmin(smallest)) if smallest.size else None
    return {
        "fit": name,
        "fits": len(rows),
        "converged": int(rows.success.sum()),
        "not_converged": int(fitted.sum() - rows.success.sum()),
        "missing": int((~fitted).sum()),
        "median_fit_percent": {
            output: float(np.median(rows.fit_percent[fitted, j])) for j, output in enumerate(rows.output_names)
        },
        "worst": None if worst is None else str(rows.model[fitted][worst]),
        "worst_fit_percent": None if worst is None else float(smallest[worst]),
    }


def campaign_tables(document: Row) -> list[Table]:
    """Return the tables of the stages and of the fits of a campaign; empty tables are left out."""
    heads = {"stage": Column("stage")} | {key: Column(key.replace("_", " "), format="d") for key in _STATES}
    stages = [{"stage": stage, **counts} for stage, counts in document["stages"].items()]
    columns = {
        "fit": Column("fit"),
        **{key: Column(key, format="d") for key in ("fits", "converged", "missing")},
        "median": Column("median", "%"),
        "worst_fit_percent": Column("worst", "%", ".1f", missing=""),
        "worst": Column("of", missing=""),
    }
    fits = [
        {**row, "median": ", ".join(f"{output} {value:.1f}" for output, value in row["median_fit_percent"].items())}
        for row in document["fits"]
    ]
    return [table for table in (keyed_table("", heads, stages), keyed_table("", columns, fits)) if table.rows]


# ---- Tables of recordings, of the channels of a file, and of the corrections by the prefilter.


def conditions_text(conditions: Mapping[str, float]) -> str:
    """Return the operating conditions of a recording as text."""
    return ", ".join(f"{key} {value:g}" for key, value in conditions.items())


def channel_rows(channels: Iterable[FileChannel]) -> list[Row]:
    """Return the channels of a measured file as plain values."""
    return [
        {
            "channel": channel.name,
            "samples": channel.n_samples,
            "unit": channel.unit,
            "sample_time_s": channel.sample_time,
            "rate_hz": None if channel.sample_time is None else 1.0 / channel.sample_time,
            "step": channel.step,
            "jitter_ppm": channel.jitter_ppm,
            "first": list(channel.first),
            "remark": channel.remark,
        }
        for channel in channels
    ]


def channel_table(name: str, rows: Sequence[Row]) -> Table:
    """Return the table of the channels of a measured file, from `channel_rows`."""
    columns = {
        "channel": Column("channel"),
        "samples": Column("samples", format="d"),
        "unit": Column("unit"),
        "sample_time_s": Column("sample time", "s", ".6g"),
        "rate_hz": Column("rate", "Hz", ".6g"),
        "first": Column("first samples"),
        "remark": Column("remark", wrap=True),
    }
    cells = (
        {
            **row,
            "first": " ".join(f"{value:.5g}" for value in row["first"]) or None,
            "remark": row["remark"] or _rising(row),
        }
        for row in rows
    )
    return keyed_table(name, columns, cells)


def _rising(row: Row) -> str:
    """Return a text on a column that may be the time, such as its step."""
    if row["step"] is None:
        return ""
    rate = ""
    with suppress(UsageError):
        rate = f": {1 / (row['step'] * conversion_factor(row['unit'], 's')):.6g} Hz" if row["unit"] else ""
    even, jitter = (
        ("even ", "") if row["jitter_ppm"] is None else ("", f", with a jitter of {row['jitter_ppm']:.0f} ppm")
    )
    return f"rises in {even}steps of {row['step']:.6g}{rate}{jitter}"


def layout_words(layout: Mapping[str, str | int | None]) -> str:
    """Return the layout of a text file as one line; empty for other kinds of files."""
    return ", ".join(f"{key.replace('_', ' ')} {value!r}" for key, value in layout.items() if value is not None)


# ---- Origin of results: programs, YAML, seeds, data and command.


def origin_table(origins: Iterable[Mapping[str, Any]]) -> Table:
    """Return the provenance table of results; a row with different values lists them side by side.

    Parameters
    ----------
    origins : iterable of dict
        What `gbid.core.hdf5.read_made_with` returns for each file.
    """
    values: dict[str, dict[str, None]] = {}
    for origin in origins:
        words: dict[str, str] = {key: value for key, value in origin.items() if isinstance(value, str)}
        if "experiment" in origin:
            words["experiment"] = f"{origin['experiment']['file']} (sha256 {origin['experiment']['sha256']})"
        for key, seed in origin.get("seeds", {}).items():
            words[f"seed ({key})"] = str(seed)
        for text in words:
            values.setdefault(text, {})[words[text]] = None
        for file, digest in origin.get("data", {}).items():
            values.setdefault("data", {})[f"{file} (sha256 {digest})"] = None
    rows: list[list[Entry]] = [[key, "\n".join(each)] for key, each in values.items()]
    return Table("made with", [Column(""), Column("", wrap=True)], rows)
