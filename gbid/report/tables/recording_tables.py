"""Tables of recordings, of the channels of a file, and of the corrections by the prefilter."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from gbid.prefilter import PrefilterReport
from gbid.recording.importers.file_format import FileChannel
from gbid.report.tables.fit_document import Row
from gbid.tables.numbers import shown_unit
from gbid.tables.table import Column, Table

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
        Column("remark", wrap=True),
    ]
    laid = []
    for row in rows:
        even = f"rises in even steps of {row['step']:.6g}" if row["step"] is not None else ""
        remark = row["remark"] or even
        laid.append([row["channel"], row["samples"], row["unit"], row["sample_time_s"], row["rate_hz"], remark])
    return Table(name, columns, laid)


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
