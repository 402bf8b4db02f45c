"""Tables of recordings, of the channels of a file, and of the corrections by the prefilter."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress

from gbid.errors import UsageError
from gbid.prefilter import PrefilterReport
from gbid.recording.importers.file_format import FileChannel
from gbid.report.tables.fit_document import Row
from gbid.tables.numbers import shown_unit
from gbid.tables.table import Column, Table
from gbid.units import conversion_factor

SHOWN_SPIKES = 10
"""Largest number of spikes whose sample numbers a row lists."""


def recording_table(rows: Sequence[Row]) -> Table:
    """Return the table of recordings with their length and operating point."""
    columns = [
        Column("recording"),
        Column("samples", format="d"),
        Column("duration", "s", "g"),
        Column("conditions"),
        Column("state"),
    ]
    laid = []
    for row in rows:
        conditions = ", ".join(f"{key} {value:g}" for key, value in row["conditions"].items())
        laid.append([row["name"], row["samples"], row["duration_s"], conditions, row["state"]])
    return Table("recordings", columns, laid)


def channel_rows(channels: Iterable[FileChannel]) -> list[Row]:
    """Return the channels of a file of another program as plain values."""
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
    """Return the table of the channels of a file, from `channel_rows`."""
    columns = [
        Column("channel"),
        Column("samples", format="d"),
        Column("unit"),
        Column("sample time", "s", ".6g"),
        Column("rate", "Hz", ".6g"),
        Column("first samples"),
        Column("remark", wrap=True),
    ]
    laid = []
    for row in rows:
        first = " ".join(f"{value:.5g}" for value in row["first"]) or None
        remark = row["remark"] or _rising(row)
        laid.append([row["channel"], row["samples"], row["unit"], row["sample_time_s"], row["rate_hz"], first, remark])
    return Table(name, columns, laid)


def _rising(row: Row) -> str:
    """Return what is known of a column that may be the time."""
    if row["step"] is None:
        return ""
    rate = ""
    with suppress(UsageError):
        rate = f": {1 / (row['step'] * conversion_factor(row['unit'], 's')):.6g} Hz" if row["unit"] else ""
    if row["jitter_ppm"] is None:
        return f"rises in even steps of {row['step']:.6g}{rate}"
    return f"rises in steps of {row['step']:.6g}{rate}, with a jitter of {row['jitter_ppm']:.0f} ppm"


def layout_words(layout: Mapping[str, str | int | None]) -> str:
    """Return the layout of a text file as one line; empty for a file of another kind."""
    return ", ".join(f"{key.replace('_', ' ')} {value!r}" for key, value in layout.items() if value is not None)


def prefilter_rows(reports: Iterable[PrefilterReport]) -> list[Row]:
    """Return the corrections of each channel of p by the prefilter as plain values, in the unit of p."""
    return [
        {
            "recording": report.name,
            "channel": f"p_{channel}",
            "unit": report.units["p"],
            "rms_before": float(report.rms_before["p"][i]),
            "rms_after": float(report.rms_after["p"][i]),
            "offset": float(report.offsets["p"][i]),
            "runout_share": float(report.runout_share[i]),
            "harmonics": [float(amplitude) for amplitude in report.harmonics[:, i]],
            "spikes": report.spikes[i],
            "first_spikes": list(report.spike_samples[i][:SHOWN_SPIKES]) if report.spike_samples else [],
            "notes": list(report.notes),
        }
        for report in reports
        for i, channel in enumerate(report.channels["p"])
    ]


def position_unit(rows: Sequence[Row]) -> tuple[float, str]:
    """Factor and unit in which rows of the prefilter are shown; as they are where the recordings differ in unit."""
    units = list(dict.fromkeys(row["unit"] for row in rows))
    return shown_unit(units[0]) if len(units) == 1 else (1.0, " or ".join(units))


def prefilter_table(rows: Sequence[Row]) -> Table:
    """Return the table of the corrections by the prefilter, from `prefilter_rows`."""
    factor, unit = position_unit(rows)
    columns = [
        Column("recording"),
        Column(""),
        Column("rms before\n", unit, ".3f"),
        Column("after\n", unit, ".3f"),
        Column("run-out\nshare", format=".1%"),
        Column("harmonics\n1, 2, 3", unit),
        Column("spikes", format="d"),
    ]
    laid = []
    for row in rows:
        harmonics = " ".join(f"{factor * amplitude:.2f}" for amplitude in row["harmonics"][:3]) or None
        sizes = (factor * row["rms_before"], factor * row["rms_after"])
        laid.append([row["recording"], row["channel"], *sizes, row["runout_share"], harmonics, row["spikes"]])
    return Table("prefilter", columns, laid)
