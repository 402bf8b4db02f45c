"""Import of a file of another program as a Recording."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import DataError, UsageError
from gbid.files.reader_process import read_apart
from gbid.naming.paths import given_path
from gbid.recording.importers.columns import FileColumn
from gbid.recording.importers.file_format import FileFormat
from gbid.recording.importers.file_units import file_unit, unit_factor
from gbid.recording.importers.formats import file_formats
from gbid.recording.importers.mapping import ImportMapping, SignalMapping
from gbid.recording.importers.sample_time import sample_time_of
from gbid.recording.recording import Recording
from gbid.units import SIGNALS


def import_recording(path: str | Path, mapping: ImportMapping | Mapping[str, Any]) -> Recording:
    """Return a recording read from a file of another program: csv, npz, mat, HDF5, TDMS, MDF, Parquet or Feather.

    Parameters
    ----------
    path : path
        The file; its ending decides the reader.
    mapping : ImportMapping or dict
        Columns, units and sample time of the signals. A dict has the keys of `ImportMapping`, as in an experiment
        YAML.

    Returns
    -------
    Recording
        Known signals in SI units, others in the unit of the file. The provenance has ``source_file``,
        ``source_sha256`` and ``source_samples``.

    Raises
    ------
    UsageError
        When the mapping is malformed or its units do not fit, or when the package that reads the format is not
        installed.
    DataError
        When the file cannot be read or does not contain what the mapping names. The text gives file, column and
        value.
    """
    path = given_path(path)
    reader = file_format(path).read
    try:
        mapping = mapping if isinstance(mapping, ImportMapping) else ImportMapping.from_dict(mapping)
    except UsageError as error:
        raise UsageError(f"import mapping of {path}: {error}") from None
    try:
        with path.open("rb") as handle:
            digest = hashlib.file_digest(handle, "sha256").hexdigest()
        columns = reader(path, mapping.all_columns())
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None
    start, stop = _range(path, mapping, columns)
    columns = {name: c._replace(values=c.values[start:stop]) for name, c in columns.items()}
    _check_finite(path, columns, start)
    sample_time = sample_time_of(path, mapping, columns, start)
    signals, units = {}, {}
    for name, signal in mapping.signals.items():
        signals[name], units[name] = _signal(path, name, signal, columns)
    try:
        return Recording(
            signals,
            sample_time,
            conditions=mapping.conditions,
            name=mapping.name or path.stem,
            units=units,
            channels={name: s.channels for name, s in mapping.signals.items() if s.channels},
            provenance={
                "source_file": path.name,
                "source_sha256": digest,
                "source_samples": f"{start} to {stop}",
            },
        )
    except DataError as error:
        raise DataError(f"{path}: {error}") from None


def file_format(path: Path) -> FileFormat:
    """Return the format of a file, chosen by its ending; libraries that may crash run in a process of their own.

    Raises
    ------
    DataError
        When the ending is unknown.
    """
    known = file_formats()
    found = known.get(path.suffix.lower())
    if found is None:
        raise DataError(f"{path}: unknown file ending {path.suffix!r}; expected one of {', '.join(known)}")
    if not found.may_crash:
        return found
    return replace(found, read=partial(read_apart, found.read), channels=partial(read_apart, found.channels))


def _range(path: Path, mapping: ImportMapping, columns: dict[str, FileColumn]) -> tuple[int, int]:
    """Return the first sample and the one after the last; check that all columns have the same length."""
    lengths = {name: len(column.values) for name, column in columns.items()}
    n = next(iter(lengths.values()))
    if set(lengths.values()) != {n}:
        text = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise DataError(f"{path}: columns have different numbers of samples: {text}")
    start, stop = mapping.samples or (0, None)
    stop = n if stop is None else stop
    if not start < stop <= n:
        raise DataError(f"{path}: samples {start} to {stop} are not within its {n} samples")
    return start, stop


def _check_finite(path: Path, columns: dict[str, FileColumn], start: int) -> None:
    for name, (values, *_) in columns.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise DataError(
                f"{path}: column {name!r} holds {bad.size} values that are not finite, the first "
                f"{values[bad[0]]} at sample {start + bad[0]}; leave those samples out or repair them"
            )


def _signal(path: Path, name: str, signal: SignalMapping, columns: dict[str, FileColumn]) -> tuple[FloatArray, str]:
    """Return the values (n_samples, n_channels) of a signal in the unit to be stored, and that unit."""
    known = SIGNALS.get(name)
    stored = known.unit if known and signal.stored_unit is None else signal.stored_unit
    units = {}
    for column in signal.columns:
        what = f"signal {name!r}, column {column!r}"
        unit = file_unit(path, what, signal.unit, columns[column].unit)
        if unit is None and stored:
            instead = f"; {_another(name, '...')}" if known and signal.stored_unit is None else ""
            text = f"{path}: {what} has no unit; give unit in the mapping (it is stored in {stored}){instead}"
            raise UsageError(text)
        units[column] = unit or ""
    if stored is None:
        stored = units[signal.columns[0]]
    values = []
    for column in signal.columns:
        try:
            factor = unit_factor(path, f"signal {name!r}, column {column!r}", units[column], stored)
        except UsageError as error:
            if known is None or signal.stored_unit is not None:
                raise
            raise UsageError(f"{error}; {_another(name, units[column])}") from None
        values.append(columns[column].values * factor)
    return np.column_stack(values), stored


def _another(name: str, unit: str) -> str:
    """Return what to do when a signal has the name of one of the rig, and is another quantity."""
    known = SIGNALS[name]
    return f"if it is not the {known.long_name} [{known.unit}], rename the signal, or give stored_unit: {unit or '...'}"
