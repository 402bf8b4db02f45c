"""Recordings in HDF5; docs/file-formats.md describes the tree."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from gbid.core import hdf5
from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError
from gbid.core.units import SIGNALS
from gbid.recording.recording import Recording

KIND = hdf5.FileKind("recording", "record or import it again")

CONDITION_UNITS = {"pressure_bar": "bar", "speed_rpm": "rpm"}
"""Units of the conditions that gbid uses; other conditions have ``""``."""


def save_recording(rec: Recording, path: str | Path, overwrite: bool = False) -> None:
    """Write a recording to an HDF5 file, bit for bit.

    The file appears under its name only when it is complete. After a failure an earlier file is unchanged.

    Parameters
    ----------
    rec : Recording
        Recording to write.
    path : path
        The file; missing folders are made.
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
        write_recording(file, rec)


def write_recording(file: h5py.File, rec: Recording) -> None:
    """Write a recording to an open file, to which its maker may add more."""
    file.attrs["name"] = rec.name
    file.attrs["default"] = "signals"
    hdf5.add_dataset(file, "sample_time", rec.sample_time, "s", "time between samples")
    _write_signals(file.create_group("signals", track_order=True), rec)
    conditions = file.create_group("conditions", track_order=True)
    for key, value in rec.conditions.items():
        hdf5.add_dataset(conditions, key, value, CONDITION_UNITS.get(key, ""), key.replace("_", " "))
    provenance = file.create_group("provenance")
    for key, text in rec.provenance.items():
        provenance.attrs[key] = text


def load_recording(path: str | Path) -> Recording:
    """Return the recording in an HDF5 file of `save_recording`.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    Recording
        The same values, bit for bit.

    Raises
    ------
    DataError
        When the file is missing, truncated, incomplete, of another kind or schema, or contains values that a recording
        must not have.
    """
    with hdf5.reading(path, KIND) as file:
        signals, units, channels = {}, {}, {}
        for name, item in hdf5.read_group(file, "signals").items():
            if name == "time":
                continue
            signals[name] = hdf5.read_dataset(file["signals"], name)
            units[name] = hdf5.read_text(item, "units")
            channels[name] = hdf5.read_texts(item, "channels")
        conditions = {key: _scalar(file["conditions"], key) for key in hdf5.read_group(file, "conditions")}
        source = hdf5.read_group(file, "provenance")
        provenance = {key: hdf5.read_text(source, key) for key in source.attrs}
        sample_time = _scalar(file, "sample_time")
        time = hdf5.read_dataset(file["signals"], "time")
        name = hdf5.read_text(file, "name")
    try:
        rec = Recording(signals, sample_time, conditions, name, units, channels, provenance)
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
    _check_time(path, rec, time)
    return rec


def _write_signals(group: h5py.Group, rec: Recording) -> None:
    """Write the signals with the attributes by which NeXus readers find the default plot."""
    first, *others = rec.signals
    group.attrs["NX_class"] = "NXdata"
    group.attrs["signal"] = first
    hdf5.add_texts(group, "auxiliary_signals", others)
    hdf5.add_texts(group, "axes", ["time", "."])
    hdf5.add_dataset(group, "time", rec.time, "s", "time from the first sample")
    for name, values in rec.signals.items():
        known = SIGNALS.get(name)
        long_name = known.long_name if known and known.unit == rec.units[name] else name  # else another rig's
        dataset = hdf5.add_dataset(group, name, values, rec.units[name], long_name)
        hdf5.add_texts(dataset, "channels", rec.channels[name])


def _scalar(group: h5py.Group, name: str) -> float:
    """Return a dataset of one number."""
    values = hdf5.read_dataset(group, name)
    if values.shape != ():
        raise DataError(f"{group.file.filename}: {name} has shape {values.shape}, expected one number")
    return float(values)


def _check_time(path: str | Path, rec: Recording, time: FloatArray) -> None:
    """Refuse a time axis that contradicts sample_time."""
    if time.shape != (rec.n_samples,):
        raise DataError(f"{path}: /signals/time has shape {time.shape}, expected ({rec.n_samples},)")
    wrong = np.flatnonzero(~(np.abs(time - rec.time) <= 1e-3 * rec.sample_time))
    if wrong.size:
        k = wrong[0]
        raise DataError(
            f"{path}: /signals/time is {time[k]} s at sample {k}, but sample_time = {rec.sample_time} s "
            f"gives {rec.time[k]} s; make them agree"
        )
