"""Plots of a measured file as numbers for a page: channels by minimum and maximum, spectra, orbit, speed, problems."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError, GbidError
from gbid.experiment.schema import Kind
from gbid.prefilter.filtering import repair_overloads
from gbid.recording import Recording
from gbid.recording.importing import import_recording
from gbid.recording.quality import BLOCK, find_problems, turning_increments
from gbid.recording.readers import FileChannel
from gbid.recording.roles import find_roles

POINTS = 500
"""Number of blocks of a plot: each shows the smallest and the largest of its samples."""
_ORBIT = 1500  # samples
_CUT = ("from_s", "to_s", "samples")


def plots_of(
    path: Path, channels: Sequence[FileChannel], mapping: Mapping[str, Any] | None, kind: Kind = "excited"
) -> dict[str, Any]:
    """Return the plots of a file, as numbers for JSON.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    channels : sequence of FileChannel
        Its channels, from `gbid.recording.importing.list_channels`.
    mapping : dict, optional
        Its import mapping; without one, every column is shown in the unit of the file.
    kind : str
        Kind of the recording; at rest, r and u may be constant.

    Returns
    -------
    dict
        channels [{name, unit, role, why}], timed (whether times are known), n_samples, sample_time [s], lines [{name,
        unit, low, high}] over the whole file, spectra [{name, y}] up to half the sampling rate, orbit {x, y, unit} or
        None, speed_rpm over the file, problems and remarks in the words of `gbid check`, and fault: why the mapping
        or the clock does not fit, in which case the columns are shown as they are.

    Raises
    ------
    DataError
        When the file cannot be read.
    """
    roles = find_roles(channels, {}, None)
    fault, rec, mapped = "", None, dict[str, Any]()
    if mapping is not None:
        try:
            rec = _recording(path, mapping, channels, roles.time)
            mapped = mapping["signals"]
        except GbidError as error:
            fault = str(error)
    if rec is None:
        try:
            rec = _recording(path, {"signals": {}}, channels, roles.time)
        except DataError as error:  # of its clock, perhaps: shown over the number of the sample
            fault = fault or str(error)
            rec = _recording(path, {"signals": {}, "sample_time_s": 1.0}, channels, roles.time)
        looked_at = [_key(name) for name in roles.signals.get("p", ()) if _key(name) in rec.signals]
        problems = find_problems(rec, looked_at)
    else:
        looked_at = [name for name in mapped if kind != "stationary" or name in ("p", "phi")]
        problems = find_problems(_cut(rec, mapping or {}), looked_at)
    units = {_key(channel.name): channel.unit or "" for channel in channels}
    named = {
        f"{signal}.{channel}" if signal in mapped else signal.removeprefix(_RAW): (units.get(signal) or unit, values)
        for signal, unit in rec.units.items()
        for channel, values in zip(rec.channels[signal], rec.signal(signal).T, strict=True)
    }
    seen = [name for name in named if name.startswith("p.")] or list(roles.signals.get("p", ()))
    pair = [named[name] for name in seen[:2] if name in named]
    orbit = {axis: _short(values[-_ORBIT:]) for axis, (_, values) in zip("xy", pair, strict=False)}
    return {
        "channels": [
            {"name": channel.name, "unit": channel.unit, "role": role, "why": why}
            for channel in channels
            for role, why in [roles.columns[channel.name]]
        ],
        "timed": rec.sample_time != 1.0 or bool(roles.time and not fault),
        "n_samples": rec.n_samples,
        "sample_time": rec.sample_time,
        "lines": [{"name": name, "unit": unit, **_extremes(values)} for name, (unit, values) in named.items()],
        "spectra": [{"name": name, "y": _spectrum(values)} for name, (_, values) in named.items()],
        "orbit": {**orbit, "unit": pair[0][0]} if len(pair) == 2 else None,
        "speed_rpm": _speed(rec),
        "problems": [problem.text for problem in problems],
        "remarks": [text for text in rec.provenance.get("import_remarks", "").split("; ") if text],
        "fault": fault,
    }


_RAW = "column "


def _key(column: str) -> str:
    """Return the name of the signal that shows a column as it is."""
    return _RAW + column.replace("/", " ")


def _recording(path: Path, mapping: Mapping[str, Any], channels: Sequence[FileChannel], time: str | None) -> Recording:
    """Return the whole file with the signals of a mapping and all columns that these do not use, as they are."""
    used = {column for signal in mapping["signals"].values() for column in signal["columns"]}
    used |= {mapping.get("time") or time}
    longest = max((channel.n_samples for channel in channels), default=0)
    names = [c.name for c in channels if not c.remark and c.n_samples == longest and c.name not in used]
    others = {_key(name): {"columns": [name], "scale": 1.0, "unit": ""} for name in names}
    whole = {key: value for key, value in mapping.items() if key not in _CUT}
    stated = any(channel.sample_time for channel in channels)
    if not whole.get("sample_time_s") and not whole.get("time") and not stated:
        whole |= {"time": time} if time else {"sample_time_s": 1.0}
    return repair_overloads(import_recording(path, {**whole, "signals": {**others, **mapping["signals"]}}))


def _cut(rec: Recording, mapping: Mapping[str, Any]) -> Recording:
    """Return the part of a recording that a mapping uses."""
    first, last = (round((mapping.get(key) or 0.0) / rec.sample_time) for key in ("from_s", "to_s"))
    first, last = mapping.get("samples") or (first, last)
    return rec.slice(min(first, rec.n_samples - 1), min(last or rec.n_samples, rec.n_samples))


def _short(values: FloatArray) -> list[float | None]:
    """Return values with six digits for JSON; None for a missing one."""
    known = np.isfinite(values)
    factor = 10.0 ** (5 - np.floor(np.log10(np.where(known & (values != 0), np.abs(values), 1.0))))
    return [
        value if value == value else None
        for value in np.where(known, np.round(values * factor) / factor, np.nan).tolist()
    ]


def _blocks(values: FloatArray) -> tuple[list[float | None], list[float | None]]:
    """Return minimum and maximum of each of at most `POINTS` equal blocks."""
    starts = np.arange(0, len(values), -(-len(values) // POINTS))
    return _short(np.fmin.reduceat(values, starts)), _short(np.fmax.reduceat(values, starts))


def _extremes(values: FloatArray) -> dict[str, list[float | None]]:
    return dict(zip(("low", "high"), _blocks(values), strict=True))


def _spectrum(values: FloatArray) -> list[float | None]:
    """Return the amplitude spectrum up to half the sampling rate: the largest line of each block."""
    known = np.where(np.isfinite(values), values, np.nanmean(values))
    window = np.hanning(len(known))
    lines = 2 * np.abs(np.fft.rfft(window * (known - known.mean()))) / max(window.sum(), 1.0)
    return _blocks(lines)[1]


def _speed(rec: Recording) -> list[float | None]:
    """Return the shaft speed over the recording [rpm], averaged over blocks; empty without a turning shaft."""
    increments = turning_increments(rec)
    size = 0 if increments is None else max(1, round(BLOCK / rec.sample_time), len(increments) // POINTS)
    if increments is None or size > len(increments):
        return []
    blocks = np.abs(increments[: len(increments) // size * size].reshape(-1, size).mean(axis=1))
    return _short(30 / np.pi / rec.sample_time * blocks)
