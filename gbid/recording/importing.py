"""Import of files of other programs as recordings, and inspection of such files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gbid.core.apart import read_apart
from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError, UsageError
from gbid.core.files import refuse_special, sha256_of
from gbid.core.names import given_path
from gbid.core.units import SIGNALS
from gbid.recording.clock import has_one_clock, joined, on_grid, read_clock, resampled, times_of, untimed_sample_time
from gbid.recording.columns import FileColumn, file_unit, unit_factor
from gbid.recording.formats import file_formats, format_of, iddata_in
from gbid.recording.hdf5_links import files_beside
from gbid.recording.iddata import IddataChannel, IddataExperiment
from gbid.recording.mapping import FilePart, ImportMapping, SignalMapping, TextOptions
from gbid.recording.readers import FileChannel, FileFormat, PairResponse
from gbid.recording.recording import Recording

_OF_TEXT = ("read", "channels", "peek", "layout")  # functions of a format that take the layout of a text file
_ANSWERS = (FileColumn, FileChannel, PairResponse)  # types in what those functions return


def import_recording(path: str | Path, mapping: ImportMapping | Mapping[str, Any]) -> Recording:
    """Return a recording imported from a file: csv, npz, mat, HDF5, TDMS, MDF, Parquet or Feather.

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
        ``source_sha256``, ``source_rows`` (their number, the first and the last), ``source_samples``,
        ``import_remarks`` on rows left out, gaps, doubled samples and jitter, the ``calibration`` of columns, and
        ``source_linked``: name and SHA-256 of each other file from which an HDF5 file takes data.

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
    file_format(path)  # an unknown ending is reported first
    try:
        mapping = mapping if isinstance(mapping, ImportMapping) else ImportMapping.from_dict(mapping)
    except UsageError as error:
        raise UsageError(f"import mapping of {path}: {error}") from None
    reader = file_format(path, mapping.text_options, mapping.part).read
    try:
        digest = sha256_of(path)
        columns = joined(path, _whole(path, mapping, reader(path, mapping.all_columns())))
        others = {Path(other): sha256_of(Path(other)) for other in files_beside(path)}
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None
    except MemoryError:
        raise DataError(f"{path}: takes more memory than this process can use; cut it into several files") from None
    rows = _rows_in_words(columns)
    start, columns = in_range(path, mapping, columns)
    check_finite(path, columns, start, time=mapping.time)
    clock = read_clock(path, mapping, columns, start)
    columns = {name: c._replace(values=c.values[clock.rows]) for name, c in columns.items()}
    first, last = start + int(clock.rows[0]), start + int(clock.rows[-1])
    signals, units, calibrated = {}, {}, list[str]()
    for name, signal in mapping.signals.items():
        signals[name], units[name] = _signal(path, name, signal, columns)
        calibrated += _calibration_in_words(name, signal, columns)
        if clock.time is not None:
            if np.isnan(signals[name]).any():
                raise DataError(
                    f"{path}: the times jitter, and signal {name!r} has missing samples; samples between them cannot "
                    "be interpolated: leave time out and give sample_time_s, or repair them"
                )
            signals[name] = resampled(signals[name], units[name], clock.time, clock.sample_time)
        if clock.places is not None:
            signals[name] = on_grid(signals[name], clock.places)
    filled = {False: "", True: ", the last value held"}
    missing = [
        f"signal {name!r}: {count} samples missing"
        + (", on straight lines" if mapping.signals[name].interpolate else filled[mapping.signals[name].hold])
        for name, values in signals.items()
        if (count := int(np.isnan(values).sum()))
    ]
    said = [text for text in (*dict.fromkeys(c.remark for c in columns.values()), *clock.remarks, *missing) if text]
    remarks = {"import_remarks": "; ".join(said)} if said else {}
    remarks |= {"source_linked": ", ".join(f"{other.name} {sha}" for other, sha in others.items())} if others else {}
    remarks |= {"calibration": "; ".join(calibrated)} if calibrated else {}
    held = [name for name, signal in mapping.signals.items() if signal.hold]
    on_lines = [name for name, signal in mapping.signals.items() if signal.interpolate]
    try:
        recording = Recording(
            signals,
            clock.sample_time,
            conditions=mapping.conditions,
            name=mapping.name or path.stem,
            units=units,
            channels={name: s.channels for name, s in mapping.signals.items() if s.channels},
            provenance={
                "source_file": path.name,
                "source_sha256": digest,
                "source_rows": rows,
                "source_samples": f"{first} to {last + 1}",
                **remarks,
            },
            stamps=clock.stamps,
        )
        return recording.held(*held).interpolated(*on_lines)
    except DataError as error:
        raise DataError(f"{path}: {error}") from None


def load_iddata(path: str | Path, variable: str | None = None) -> list[Recording]:
    """Return the experiments of a MATLAB `iddata` object, with sample time, names and units.

    Parameters
    ----------
    path : path
        The ``.mat`` file, of any version.
    variable : str, optional
        Name of the object, where the file has several.

    Returns
    -------
    list of Recording
        A recording for each experiment, named as the experiment. Each input and output is a signal, in the unit that
        MATLAB states. The provenance has the inter-sample behaviour of the inputs (``intersample``) and the time of the
        first sample (``start_s``).

    Raises
    ------
    DataError
        When the file cannot be read or has no such object, or when its data are spectra or have no times.
    UsageError
        When the file has several such objects and none is named.
    """
    path = given_path(path)
    refuse_special(path)
    try:
        experiments = read_apart(
            iddata_in, path, variable, types=(IddataExperiment, IddataChannel), packages=("matio",)
        )
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None
    recordings = []
    for each in experiments:
        if twice := each.inputs.keys() & each.outputs.keys():
            raise DataError(f"{path}: experiment {each.name}: {min(twice)!r} is an input and an output; rename one")
        channels = each.inputs | each.outputs
        recordings.append(
            Recording(
                {name: channel.values for name, channel in channels.items()},
                each.sample_time or math.nan,
                name=each.name,
                units={name: channel.unit for name, channel in channels.items()},
                provenance={
                    "source_file": path.name,
                    "source_sha256": sha256_of(path),
                    "intersample": ", ".join(each.hold),
                    "start_s": f"{each.start or 0.0:g}",
                },
                stamps=each.time,
            )
        )
    return recordings


def _whole(path: Path, mapping: ImportMapping, columns: dict[str, FileColumn]) -> dict[str, FileColumn]:
    """Return the columns; columns with different clocks are read again in full, because they are cut by time."""
    if has_one_clock(columns) or all(column.first is None for column in columns.values()):
        return columns
    reader = file_format(path, mapping.text_options, FilePart(mapping.axis)).read
    return reader(path, mapping.all_columns())


def _rows_in_words(columns: Mapping[str, FileColumn]) -> str:
    """Return a text on the number of rows and the first and last numbers, which show an incomplete file."""
    shown = list(columns.items())[:_SHOWN]
    more = ", ..." if len(columns) > _SHOWN else ""
    first, last = (", ".join(f"{name} = {c.values[k]:g}" for name, c in shown) + more for k in (0, -1))
    values, before = shown[0][1].values, shown[0][1].first
    rows = (
        f"rows {before} to {(before or 0) + len(values)}, read alone" if before is not None else f"{len(values)} rows"
    )
    return f"{rows}; the first: {first}; the last: {last}"


_SHOWN = 3  # columns of these rows


def file_format(path: Path, options: TextOptions | None = None, part: FilePart | None = None) -> FileFormat:
    """Return the format for a file's ending, with functions that run in the reader process.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    options : TextOptions, optional
        Layout of a text file, as far as it is given.
    part : FilePart, optional
        What is read of its arrays.

    Raises
    ------
    DataError
        When the ending is unknown, or when the path is that of a directory, a pipe or a device.
    UsageError
        When a layout of text is given for a file of another kind, or an axis for one without arrays.
    """
    kind = format_of(path)
    if kind is None:
        known = ", ".join(file_formats())
        raise DataError(f"{path}: unknown file ending {path.suffix!r}, and no text; expected text or one of {known}")
    refuse_special(path)
    given = options.given() if options else []
    if given and kind.layout is None:
        raise UsageError(f"{path}: {given[0]} is for text files such as csv; leave it out")
    if part is not None and part.axis and (kind.layout is not None or not kind.takes_part):
        raise UsageError(f"{path}: axis is for files of arrays such as HDF5; leave it out")
    if part is not None and kind.takes_part:
        kind = replace(kind, read=partial(kind.read, part=part))
    if options and kind.layout is not None:
        bound: dict[str, Any] = {
            key: partial(each, options=options) for key in _OF_TEXT if (each := getattr(kind, key)) is not None
        }
        kind = replace(kind, **bound)
    if not kind.may_crash:
        return kind
    apart: dict[str, Any] = {
        key: partial(read_apart, each, types=_ANSWERS, packages=kind.packages)
        for key in (*_OF_TEXT, "responses")
        if (each := getattr(kind, key)) is not None
    }
    return replace(kind, **apart)


def in_range(path: Path, mapping: ImportMapping, columns: dict[str, FileColumn]) -> tuple[int, dict[str, FileColumn]]:
    """Return the first imported sample, and the columns from it on; columns must have equal lengths.

    Raises
    ------
    DataError
        When the columns differ in length, or when the range is empty or beyond the end.
    """
    lengths = {name: (column.first or 0) + len(column.values) for name, column in columns.items()}
    n = next(iter(lengths.values()))
    if set(lengths.values()) != {n}:
        text = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise DataError(f"{path}: columns have different numbers of samples: {text}")
    start, stop = mapping.samples or _from_times(path, mapping, columns, n)
    stop = n if stop is None else stop
    if not start < stop <= n:
        raise DataError(f"{path}: samples {start} to {stop} are not within its {n} samples")
    return start, {
        name: c._replace(values=c.values[start - (c.first or 0) : stop - (c.first or 0)]) for name, c in columns.items()
    }


def _from_times(path: Path, mapping: ImportMapping, columns: dict[str, FileColumn], n: int) -> tuple[int, int | None]:
    """Return the first sample at or after `from_s`, and the first sample at or after `to_s`."""
    if mapping.from_s is None and mapping.to_s is None:
        return 0, None
    if mapping.time is None:
        time = untimed_sample_time(path, mapping, columns) * np.arange(n)
    else:
        time, _ = times_of(path, mapping, mapping.time, columns)
        time = np.maximum.accumulate(time - time[0])
    step = float(time[-1]) / max(1, n - 1)
    for key, value in (("from_s", mapping.from_s), ("to_s", mapping.to_s)):
        if value is not None and value > time[-1] + step:
            raise DataError(f"{path}: {key} = {value:g} s is beyond its end at {time[-1]:.6g} s; correct it")
    start, stop = (int(np.searchsorted(time, (t or 0.0) - 1e-6 * step)) for t in (mapping.from_s, mapping.to_s))
    return start, None if mapping.to_s is None else stop


def check_finite(path: Path, columns: dict[str, FileColumn], start: int, *, time: str | None) -> None:
    """Refuse infinite values and missing times; `start` is the index of the first sample."""
    for name, (values, *_) in columns.items():
        bad = np.flatnonzero(~np.isfinite(values) if name == time else np.isinf(values))
        if bad.size:
            raise DataError(
                f"{path}: column {name!r} holds {bad.size} values that are not finite, the first "
                f"{values[bad[0]]} at sample {start + bad[0]}; leave those samples out or repair them"
            )


def _signal(path: Path, name: str, signal: SignalMapping, columns: dict[str, FileColumn]) -> tuple[FloatArray, str]:
    """Return the values (n_samples, n_channels) of a signal in the stored unit, and this unit."""
    known = SIGNALS.get(name)
    stored = known.unit if known and signal.stored_unit is None else signal.stored_unit
    units = {}
    calibrations = dict(zip(signal.columns, signal.calibrations, strict=True))
    for column in signal.columns:
        what = f"signal {name!r}, column {column!r}"
        if columns[column].unscaled and calibrations[column] is None:
            text = f"{path}: {what} has raw numbers: the file states {columns[column].unscaled}, which was not applied"
            raise DataError(f"{text}; give scale and offset in the mapping, scale: 1 where the numbers are in its unit")
        stated = columns[column].unit if calibrations[column] is None else None  # a calibration takes it away
        unit = file_unit(path, what, signal.unit, stated)
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
        calibration, numbers = calibrations[column], columns[column].values
        with np.errstate(over="ignore"):  # the recording refuses what is not finite
            values.append((numbers if calibration is None else calibration.apply(numbers)) * factor)
    return np.column_stack(values), stored


def _calibration_in_words(name: str, signal: SignalMapping, columns: Mapping[str, FileColumn]) -> list[str]:
    """Return a text on the calibration of a signal's columns, and on numbers beyond a calibration table."""
    parts = []
    for column, calibration in zip(signal.columns, signal.calibrations, strict=True):
        if calibration is None:
            continue
        points = [f"{number:g} is {value:g} {signal.unit}" for number, value in calibration.points]
        text = f"{name}, {column}: {', '.join(points[:2] if len(points) == 2 else (points[0], '...', points[-1]))}"
        beyond = 0 if signal.calibration is None else calibration.beyond(columns[column].values)
        parts.append(f"{text}, {beyond} samples beyond these points" if beyond else text)
    return parts


def _another(name: str, unit: str) -> str:
    """Return advice for a signal with a known name but a unit of another quantity."""
    known = SIGNALS[name]
    return f"if it is not the {known.long_name} [{known.unit}], rename the signal, or give stored_unit: {unit or '...'}"


# ---- Inspection of a file before its import: channels, completeness, length and sample time.

_ALIKE = 2e-3  # largest relative difference between the mean step and that of the first rows of a clock without gap


@dataclass(frozen=True)
class Peek:
    """Number of samples and sample time of a file, before its import.

    Attributes
    ----------
    n_samples : int
        Number of samples that the recording will have.
    sample_time : float
        Time between samples [s].
    is_irregular : bool
        Whether it is the mean of irregular times.
    """

    n_samples: int
    sample_time: float
    is_irregular: bool = False


def list_channels(path: Path, options: TextOptions | None = None) -> list[FileChannel]:
    """Return all channels of a file, with names, lengths, units and sample times.

    Parameters
    ----------
    path : pathlib.Path
        The file; its ending decides the reader.
    options : TextOptions, optional
        Layout of a text file, as far as it is given.

    Returns
    -------
    list of FileChannel
        In the order of the file. Names are those that a mapping takes.

    Raises
    ------
    DataError
        When the file cannot be read, is damaged or of another kind.
    UsageError
        When the package that reads the format is not installed.
    """
    path = given_path(path)
    try:
        return file_format(path, options).channels(path)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None


def read_layout(path: Path, options: TextOptions | None = None) -> dict[str, Any]:
    """Return the layout of a text file, given or detected: encoding, delimiter, decimal sign and lines.

    Returns
    -------
    dict
        Empty for a file of another kind.

    Raises
    ------
    DataError
        When the file cannot be read as text.
    """
    layout = file_format(path, options).layout
    return {} if layout is None else layout(path)


def peek(path: Path, mapping: ImportMapping) -> Peek:
    """Return the length and sample time of a file without importing it.

    Of a csv file the header, the first rows and the last one are read, unless they show a gap of the clock. Of other
    files the columns are read.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    mapping : ImportMapping
        The mapping of the import.

    Returns
    -------
    Peek

    Raises
    ------
    DataError
        When the file is truncated or of another kind, or when it lacks a column or the requested samples.
    UsageError
        When the unit of the time column is not a unit of time.
    """
    try:
        kind = file_format(path, mapping.text_options, mapping.part)
        if kind.peek is not None:
            seen = _from_ends(path, mapping, *kind.peek(path, mapping.all_columns()))
            if seen is not None:
                return seen
        columns = joined(path, _whole(path, mapping, kind.read(path, mapping.all_columns())))
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None
    start, columns = in_range(path, mapping, columns)
    if mapping.time is not None:
        check_finite(path, {mapping.time: columns[mapping.time]}, start, time=mapping.time)
    clock = read_clock(path, mapping, columns, start)
    n = len(clock.rows) if clock.places is None else int(clock.places[-1]) + 1
    return Peek(n, clock.sample_time, is_irregular=clock.stamps is not None)


def _from_ends(path: Path, mapping: ImportMapping, n: int, columns: dict[str, FileColumn]) -> Peek | None:
    """Return length and sample time from the first rows and the last row; None if gaps are possible."""
    if any(column.clock is not None for column in columns.values()):
        return None
    if mapping.time is None:
        sample_time = untimed_sample_time(path, mapping, columns)
    else:
        time, _ = times_of(path, mapping, mapping.time, columns)
        sample_time = float(time[-1] - time[0]) / (n - 1)
        steps = np.diff(time[:-1])
        typical = float(np.median(steps)) if steps.size else sample_time
        if mapping.piece is not None or mapping.gaps != "pieces" or not abs(sample_time - typical) <= _ALIKE * typical:
            return None
        sample_time = mapping.sample_time or sample_time
    times = (mapping.from_s or 0.0, math.inf if mapping.to_s is None else mapping.to_s)
    start, stop = mapping.samples or (math.ceil(min(n, t / sample_time - 1e-6)) for t in times)
    stop = n if stop is None else stop
    if not start < stop <= n:
        raise DataError(f"{path}: samples {start} to {stop} are not within its {n} samples; correct them")
    return Peek(stop - start, sample_time)
