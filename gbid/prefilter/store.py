"""Run-out map and prefilter reports in one HDF5 file (kind ``prefilter``).

Tree: ``runout_map`` (absent without one) with mean, orders, cosine, sine, amplitudes, angles, table,
rms_before and rms_after; ``reports/<number>`` with runout_share, harmonics, spikes and, for each signal,
``<signal>/rms_before``, ``rms_after`` and ``offset``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import h5py
import numpy as np

from gbid.arrays import FloatArray
from gbid.hdf5 import add_dataset, changing, read_attribute, read_dataset, reading, writing
from gbid.prefilter.prefilter import PrefilterReport
from gbid.prefilter.runout import RunoutMap

# Of each dataset, its unit and its name in words.
_MAP = {
    "mean": ("m", "mean disc position"),
    "orders": ("1", "harmonic order"),
    "cosine": ("m", "cosine coefficients of the harmonics"),
    "sine": ("m", "sine coefficients of the harmonics"),
    "angles": ("rad", "shaft angle of the table"),
    "table": ("m", "deviation from the mean over the shaft angle"),
    "rms_before": ("m", "rms of the stationary recordings about their mean"),
    "rms_after": ("m", "rms of what the map leaves of them"),
}
_REPORT = {
    "runout_share": ("1", "part of the variance taken out by the run-out map"),
    "harmonics": ("m", "amplitudes of the harmonics of the map"),
    "spikes": ("1", "samples moved far by the median"),
}
_SIGNAL = {
    "rms_before": ("m", "rms about the mean before the prefilter"),
    "rms_after": ("m", "rms about the mean after the prefilter"),
    "offset": ("m", "mean removed"),
}


def save_prefilter(
    path: str | Path,
    runout_map: RunoutMap | None,
    reports: Sequence[PrefilterReport] = (),
    *,
    overwrite: bool = False,
) -> None:
    """Store a run-out map and the reports of the recordings it was used on.

    Parameters
    ----------
    path : path
        The new file.
    runout_map : RunoutMap or None
        The map.
    reports : sequence of PrefilterReport
        The reports.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When it cannot be written.
    """
    with writing(path, "prefilter", overwrite) as file:
        if runout_map is not None:
            _write_map(file.create_group("runout_map"), runout_map)
        group = file.create_group("reports")
        for number, report in enumerate(reports):
            _write_report(group.create_group(f"{number:04d}"), report)


def load_prefilter(path: str | Path) -> tuple[RunoutMap | None, tuple[PrefilterReport, ...]]:
    """Read what `save_prefilter` stored.

    Parameters
    ----------
    path : str or path

    Raises
    ------
    DataError
        When the file is missing, unreadable, incomplete or of another kind.
    """
    with reading(path, "prefilter") as file:
        runout_map = _read_map(file["runout_map"]) if "runout_map" in file else None
        return runout_map, tuple(_read_report(group) for group in file["reports"].values())


def add_report(path: str | Path, report: PrefilterReport) -> None:
    """Store the report of a prefiltered recording in the recording's own file, as ``prefilter_report``."""
    with changing(Path(path)) as file:
        _write_report(file.create_group("prefilter_report"), report)


def read_report(path: str | Path) -> PrefilterReport:
    """Read the report that a prefiltered recording carries.

    Raises
    ------
    DataError
        When the file is missing, unreadable, incomplete or of another kind.
    """
    with reading(path, "recording") as file:
        return _read_report(file["prefilter_report"])


def _write_map(group: h5py.Group, made: RunoutMap) -> None:
    for name, (unit, long_name) in _MAP.items():
        add_dataset(group, name, getattr(made, name), unit, long_name)
    add_dataset(group, "amplitudes", made.amplitudes(), "m", "amplitudes of the harmonics 1, 2, ...")
    group.attrs["method"], group.attrs["turns"] = made.method, made.turns
    group.attrs["signal"], axis = ("table", "angles") if made.method == "bins" else ("cosine", "orders")
    group.attrs["axes"] = np.array([axis, "."], dtype=h5py.string_dtype())
    _write_texts(group, channels=made.channels, sources=made.sources, notes=made.notes)
    group.create_group("conditions").attrs.update(made.conditions)


def _read_map(group: h5py.Group) -> RunoutMap:
    conditions = {key: float(value) for key, value in group["conditions"].attrs.items()}
    return RunoutMap(
        method=str(read_attribute(group, "method")),
        turns=float(read_attribute(group, "turns")),
        conditions=conditions,
        channels=_texts(group, "channels"),
        sources=_texts(group, "sources"),
        notes=_texts(group, "notes"),
        **{name: _floats(group, name) for name in _MAP},
    )


def _write_report(group: h5py.Group, report: PrefilterReport) -> None:
    for name, (unit, long_name) in _REPORT.items():
        add_dataset(group, name, getattr(report, name), unit, long_name)
    group.attrs["name"], group.attrs["median"] = report.name, report.median
    _write_texts(group, map_sources=report.map_sources, notes=report.notes, signals=tuple(report.channels))
    for signal, channels in report.channels.items():
        part = group.create_group(signal)
        _write_texts(part, channels=channels)
        values = (report.rms_before[signal], report.rms_after[signal], report.offsets[signal])
        for (name, (unit, long_name)), value in zip(_SIGNAL.items(), values, strict=True):
            add_dataset(part, name, value, unit, long_name)


def _read_report(group: h5py.Group) -> PrefilterReport:
    signals = _texts(group, "signals")

    def each(name: str) -> dict[str, FloatArray]:
        return {signal: _floats(group[signal], name) for signal in signals}

    return PrefilterReport(
        name=str(read_attribute(group, "name")),
        channels={signal: _texts(group[signal], "channels") for signal in signals},
        rms_before=each("rms_before"),
        rms_after=each("rms_after"),
        offsets=each("offset"),
        runout_share=_floats(group, "runout_share"),
        harmonics=_floats(group, "harmonics"),
        spikes=tuple(int(n) for n in read_dataset(group, "spikes")),
        median=int(read_attribute(group, "median")),
        map_sources=_texts(group, "map_sources"),
        notes=_texts(group, "notes"),
    )


def _write_texts(group: h5py.Group, **texts: Iterable[str]) -> None:
    for name, values in texts.items():
        group.attrs.create(name, list(values), dtype=h5py.string_dtype(), shape=(len(list(values)),))


def _texts(group: h5py.Group, name: str) -> tuple[str, ...]:
    return tuple(str(text) for text in read_attribute(group, name))


def _floats(group: h5py.Group, name: str) -> FloatArray:
    return np.asarray(read_dataset(group, name), dtype=float)
