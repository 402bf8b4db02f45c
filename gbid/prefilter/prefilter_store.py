"""Run-out map and prefilter reports in one HDF5 file; docs/file-formats.md describes the tree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import h5py
import numpy as np

from gbid import hdf5
from gbid.arrays import FloatArray
from gbid.hdf5 import Stored
from gbid.prefilter.prefilter import PrefilterReport
from gbid.prefilter.runout import RunoutMap
from gbid.recording import Recording
from gbid.recording.recording_store import KIND as RECORDING
from gbid.recording.recording_store import write_recording

KIND = hdf5.FileKind("prefilter", "make it again with `gbid run`")


@dataclass(frozen=True, eq=False)
class _Signal:
    """Entries of a report for one signal."""

    channels: Annotated[tuple[str, ...], Stored(shape="channels")]
    rms_before: Annotated[FloatArray, Stored("unit", "rms about the mean before the prefilter", "channels")]
    rms_after: Annotated[FloatArray, Stored("unit", "rms about the mean after the prefilter", "channels")]
    offset: Annotated[FloatArray, Stored("unit", "mean removed", "channels")]


def save_prefilter(
    path: str | Path,
    runout_map: RunoutMap | None,
    reports: Sequence[PrefilterReport] = (),
    *,
    overwrite: bool = False,
) -> None:
    """Write a run-out map and the reports of the recordings that it corrected.

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
        When the file cannot be written.
    """
    with hdf5.writing(path, KIND, overwrite) as file:
        if runout_map is not None:
            _write_map(file.create_group("runout_map"), runout_map)
        group = file.create_group("reports")
        for number, report in enumerate(reports):
            _write_report(group.create_group(f"{number:04d}"), report)


def load_prefilter(path: str | Path) -> tuple[RunoutMap | None, tuple[PrefilterReport, ...]]:
    """Return the run-out map and the reports in a file of `save_prefilter`.

    Parameters
    ----------
    path : str or path
        The file.

    Returns
    -------
    runout_map : RunoutMap or None
        The map; None when the file has none.
    reports : tuple of PrefilterReport
        The reports.

    Raises
    ------
    DataError
        When the file is missing, unreadable, incomplete or of another kind.
    """
    with hdf5.reading(path, KIND) as file:
        runout_map = hdf5.read_fields(file["runout_map"], RunoutMap) if "runout_map" in file else None
        return runout_map, tuple(_read_report(group) for group in hdf5.read_group(file, "reports").values())


def save_prefiltered(filtered: Recording, report: PrefilterReport, path: Path) -> None:
    """Write a prefiltered recording with its report, as group ``prefilter_report``; an earlier file is replaced."""
    with hdf5.writing(path, RECORDING, overwrite=True) as file:
        write_recording(file, filtered)
        _write_report(file.create_group("prefilter_report"), report)


def read_report(path: str | Path) -> PrefilterReport:
    """Return the report in the file of a prefiltered recording.

    Raises
    ------
    DataError
        When the file is missing, unreadable, incomplete or of another kind.
    """
    with hdf5.reading(path, RECORDING) as file:
        return _read_report(hdf5.read_group(file, "prefilter_report"))


def _write_map(group: h5py.Group, made: RunoutMap) -> None:
    hdf5.write_fields(group, made)
    hdf5.add_dataset(group, "amplitudes", made.amplitudes(), "m", "amplitudes of the harmonics 1, 2, ...")
    group.attrs["signal"], axis = ("table", "angles") if made.method == "bins" else ("cosine", "orders")
    hdf5.add_texts(group, "axes", [axis, "."])


def _write_report(group: h5py.Group, report: PrefilterReport) -> None:
    hdf5.write_fields(group, report)
    if report.spike_samples:
        places = np.array([k for samples in report.spike_samples for k in samples], dtype=np.int64)
        hdf5.add_dataset(group, "spike_samples", places, "1", "numbers of the wrong samples, channel by channel")
    hdf5.add_texts(group, "signals", report.channels)
    for name, channels in report.channels.items():
        signal = _Signal(channels, report.rms_before[name], report.rms_after[name], report.offsets[name])
        hdf5.write_fields(group.create_group(name), signal, {"unit": report.units[name]})


def _read_report(group: h5py.Group) -> PrefilterReport:
    names = hdf5.read_texts(group, "signals")
    signals = {name: hdf5.read_fields(hdf5.read_group(group, name), _Signal) for name in names}
    report = hdf5.read_fields(
        group,
        PrefilterReport,
        channels={name: signal.channels for name, signal in signals.items()},
        units={name: hdf5.read_text(group[name]["offset"], "units") for name in names},
        rms_before={name: signal.rms_before for name, signal in signals.items()},
        rms_after={name: signal.rms_after for name, signal in signals.items()},
        offsets={name: signal.offset for name, signal in signals.items()},
    )
    return replace(report, spike_samples=_spike_samples(group, report.spikes))


def _spike_samples(group: h5py.Group, counts: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
    """Return the sample numbers of the spikes of each channel; gbid 0.1.0 stored their number alone."""
    if "spike_samples" not in group:
        return ()
    places = hdf5.read_dataset(group, "spike_samples")
    if places.shape != (sum(counts),):
        raise hdf5.DamagedError(f"{group.name}/spike_samples has shape {places.shape}, expected ({sum(counts)},)")
    parts = np.split(places, np.cumsum(counts)[:-1])
    return tuple(tuple(int(k) for k in part) for part in parts)
