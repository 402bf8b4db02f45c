"""Formats of files that recordings are imported from: a `FileFormat` for each, with its reader and its listing.

A format is one constant of this file. The import, the check of an experiment, the patterns of a folder and the messages
find it by `file_formats`.
"""

from __future__ import annotations

import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError
from gbid.core.extras import extra_package
from gbid.recording.clock import even_step
from gbid.recording.mapping import TextOptions, nearest
from gbid.recording.readers import FileChannel, FileFormat, array_channels, with_values
from gbid.recording.text_files import (
    FileColumn,
    TextTable,
    find_heading,
    name_and_unit,
    pick_column,
    read_table,
    seconds,
    split_reference,
)


@cache
def file_formats() -> Mapping[str, FileFormat]:
    """Return the formats of this file by file ending."""
    formats = [value for value in globals().values() if isinstance(value, FileFormat)]
    return MappingProxyType({ending: each for each in formats for ending in each.endings})


# ---- Parquet and Feather files, by pyarrow.

_PARQUET = (".parquet", ".pq")
_ARROW_UNITS = (b"unit", b"units")


def read_arrow(path: Path, references: Sequence[str]) -> dict[str, FileColumn]:
    """Return the named columns of a Parquet or Feather file.

    The unit is in the metadata of a column (``unit``), or in its heading, ``u_x [um]``. The column is then named
    ``u_x``. A column of lists of fixed length is an array with several columns.

    Raises
    ------
    DataError
        When the file is damaged or of another format, or when a column is missing, has missing values or holds no
        numbers.
    UsageError
        When pyarrow is not installed.
    """
    columns = {}
    with _damage_named(path):
        table = _arrow_table(path)
        for reference in references:
            index = find_heading(path, table.column_names, split_reference(reference)[0])
            if missing := table.column(index).null_count:
                raise DataError(
                    f"{path}: column {reference!r}: {missing} values are missing; leave them out or repair them"
                )
            values = pick_column(path, reference, _values_arrow(table.column(index)))
            columns[reference] = FileColumn(values, _unit_arrow(table.schema.field(index)))
    return columns


def arrow_channels(path: Path) -> list[FileChannel]:
    """Return the columns of a Parquet or Feather file.

    Raises
    ------
    DataError
        When the file is damaged or of another format.
    UsageError
        When pyarrow is not installed.
    """
    channels: list[FileChannel] = []
    with _damage_named(path):
        table = _arrow_table(path)
        names = [name_and_unit(heading)[0] for heading in table.column_names]
        for i, heading in enumerate(table.column_names):
            name = names[i] if names.count(names[i]) == 1 else heading
            unit = _unit_arrow(table.schema.field(i))
            if missing := table.column(i).null_count:
                channels.append(FileChannel(name, table.num_rows, unit, remark=f"{missing} values are missing"))
            else:
                channels += array_channels(name, _values_arrow(table.column(i)), unit=unit)
    return channels


def _arrow_table(path: Path) -> Any:
    what = f"{path}: a {'Parquet' if path.suffix.lower() in _PARQUET else 'Feather'} file"
    if path.suffix.lower() in _PARQUET:
        return extra_package("pyarrow.parquet", "arrow", what).read_table(path)
    return extra_package("pyarrow.feather", "arrow", what).read_table(path)


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """Return a context in which errors of Arrow on a damaged file become a DataError."""
    with path.open("rb"):  # the library wraps the error of a file that is not there
        pass
    arrow = extra_package("pyarrow", "arrow", f"{path}: a file of columns")
    try:
        yield
    except (arrow.ArrowException, OSError) as error:
        text = str(error).strip().splitlines()[0]
        raise DataError(f"{path}: not readable (truncated or of another format): {text}") from None


def _values_arrow(column: Any) -> Any:
    """Return a column as an array; times in seconds, lists of fixed length as (n_samples, n_channels)."""
    values = column.to_numpy()
    if values.dtype.kind in "mM":
        return seconds(values)
    if hasattr(column.type, "list_size") and len(values):
        return np.stack(list(values))
    return values


def _unit_arrow(field: Any) -> str | None:
    """Return the unit in the metadata of a column, or in its heading."""
    metadata = field.metadata or {}
    stated = next((metadata[key].decode("utf-8", "replace") for key in _ARROW_UNITS if key in metadata), None)
    return name_and_unit(field.name)[1] if stated is None else stated


ARROW = FileFormat((".parquet", ".pq", ".feather", ".arrow"), read_arrow, arrow_channels, may_crash=True)


# ---- Tables in text files (csv) with names, and often units, above the numbers.


SHOWN_FIRST = 200
"""Number of first rows that are read to judge a file."""


def read_csv(path: Path, references: Sequence[str], options: TextOptions | None = None) -> dict[str, FileColumn]:
    """Return the named columns of a csv file.

    Encoding, delimiter, decimal sign and the lines of names and units are found in the file, or given. A cell such as
    ``u_x [um]`` or ``u_x (um)`` gives name and unit. A column can be named with or without its unit.

    Raises
    ------
    DataError
        When the file is not text, when it has no header line or rows of different length, when a column is
        missing or occurs twice, or when a cell of a requested column is not a number.
    """
    return _columns(read_table(path, options), references)


def peek_csv(
    path: Path, references: Sequence[str], options: TextOptions | None = None
) -> tuple[int, dict[str, FileColumn]]:
    """Return the number of rows of a csv file, and its columns in the first rows and the last one only.

    Returns
    -------
    int
        Number of rows.
    dict of str to FileColumn
        The values of each requested column.

    Raises
    ------
    DataError
        As for `read_csv`, as far as these rows show it.
    """
    table = read_table(path, options)
    if len(table.rows) < 2:
        raise DataError(f"{path}: expected a header line and rows of numbers, found one row; record longer")
    ends = replace(table, rows=(*table.rows[: min(SHOWN_FIRST, len(table.rows) - 1)], table.rows[-1]))
    return len(table.rows), _columns(ends, references)


def csv_channels(path: Path, options: TextOptions | None = None) -> list[FileChannel]:
    """Return the columns of a csv file, with their units and first numbers.

    Raises
    ------
    DataError
        When the file is not text, or when it has no header line or no rows.
    """
    table = read_table(path, options)
    names = [name_and_unit(heading)[0] for heading in table.headings]
    channels = []
    for i, (heading, values) in enumerate(zip(table.headings, _listed_csv(table), strict=True)):
        channel = FileChannel(names[i] if names.count(names[i]) == 1 else heading, len(table.rows), table.units[i])
        if values is None:
            channels.append(replace(channel, remark="not all cells are numbers"))
        else:
            channels.append(with_values(channel, values))
    return channels


def _listed_csv(table: TextTable) -> list[FloatArray | None]:
    """Return each column as numbers; None where not all cells are numbers."""
    try:
        return list(table.columns(range(len(table.headings))).T)
    except DataError:
        _ = table.cells  # a damaged row is an error, a column of text is none
    found: list[FloatArray | None] = []
    for i in range(len(table.headings)):
        try:
            found.append(table.columns([i])[:, 0])
        except DataError:
            found.append(None)
    return found


def csv_layout(path: Path, options: TextOptions | None = None) -> dict[str, Any]:
    """Return encoding, delimiter, decimal sign and header of a csv file, as plain values."""
    return read_table(path, options).layout.stated()


def _columns(table: TextTable, references: Sequence[str]) -> dict[str, FileColumn]:
    indices = [find_heading(table.path, table.headings, reference) for reference in references]
    values = table.columns(indices) if indices else np.zeros((len(table.rows), 0))
    return {
        reference: FileColumn(np.ascontiguousarray(values[:, k]), table.units[i])
        for k, (reference, i) in enumerate(zip(references, indices, strict=True))
    }


CSV = FileFormat((".csv",), read_csv, csv_channels, peek_csv, layout=csv_layout)


# ---- HDF5 files of other programs: datasets and fields of tables by their paths.

_UNIT_ATTRIBUTES = ("units", "unit", "Units", "Unit", "Unit_string", "unit_string")


def read_hdf5(path: Path, references: Sequence[str]) -> dict[str, FileColumn]:
    """Return the named columns of an HDF5 file.

    A column is the path of a dataset, ``run1/p_x`` or ``run1/p[0]``, or the path of a table with one of its fields,
    ``run1/table/p_x``. The unit is that of the attribute ``units`` or ``unit``.

    Raises
    ------
    DataError
        When the file is damaged or not HDF5, when a dataset is missing, or when it is not an array of numbers with
        that column.
    """
    columns = {}
    with _opened_hdf5(path) as file:
        for reference in references:
            name, _ = split_reference(reference)
            dataset, field = _find_hdf5(path, file, name)
            columns[reference] = FileColumn(
                pick_column(path, reference, _values_hdf5(path, dataset, field)), _unit_hdf5(dataset, field)
            )
    return columns


def hdf5_channels(path: Path) -> list[FileChannel]:
    """Return the channels of an HDF5 file: its datasets, and the fields of its tables.

    Raises
    ------
    DataError
        When the file is damaged or not HDF5.
    """
    channels: list[FileChannel] = []

    def visit(name: str, entry: Any) -> None:
        if isinstance(entry, h5py.Dataset):
            for field in entry.dtype.names or (None,):
                value = _values_hdf5(path, entry, field) if entry.shape is not None else np.zeros(0)
                full = name if field is None else f"{name}/{field}"
                channels.extend(array_channels(full, value, unit=_unit_hdf5(entry, field)))

    with _opened_hdf5(path) as file:
        file.visititems(visit)
    return channels


def _opened_hdf5(path: Path) -> h5py.File:
    with path.open("rb"):  # the library wraps the error of a file that is not there
        pass
    try:
        return h5py.File(path, "r")
    except OSError as error:
        raise DataError(f"{path}: not a readable HDF5 file (truncated or of another format): {error}") from None


def _find_hdf5(path: Path, file: h5py.File, name: str) -> tuple[Any, str | None]:
    """Return the dataset of a path, and the field of it that the last part of the path names."""
    parent, _, last = name.strip("/").rpartition("/")
    if name.strip("/") and isinstance(file.get(name), h5py.Dataset):
        return file[name], None
    table = file.get(parent) if parent else None
    if isinstance(table, h5py.Dataset) and last in (table.dtype.names or ()):
        return table, last
    known: list[str] = []

    def visit(here: str, entry: Any) -> None:
        if isinstance(entry, h5py.Dataset):
            known.extend(f"{here}/{field}" for field in entry.dtype.names or ())
            known.extend([] if entry.dtype.names else [here])

    file.visititems(visit)
    raise DataError(f"{path}: no dataset {name!r}; {nearest(name, known)}")


def _values_hdf5(path: Path, dataset: Any, field: str | None) -> Any:
    """Return a dataset, or one field of it, as an array."""
    try:
        values = dataset[()] if field is None else dataset.fields(field)[()]
    except (OSError, TypeError) as error:
        raise DataError(f"{path}: dataset {dataset.name}: cannot be read: {error}") from None
    return np.asarray(values)


def _unit_hdf5(dataset: Any, field: str | None) -> str | None:
    """Return the unit in the attributes of a dataset; a table has one for all its fields, or none."""
    for key in (f"{field}_units", f"{field}_unit_hdf5", *(() if field else _UNIT_ATTRIBUTES)):
        value = dataset.attrs.get(key)
        if isinstance(value, bytes | np.bytes_):
            return value.decode("utf-8", "replace")
        if isinstance(value, str):
            return value
    return None


HDF5 = FileFormat((".h5", ".hdf5"), read_hdf5, hdf5_channels, may_crash=True)


# ---- MATLAB files of all versions, with their objects, by mat-io.


SAVE_PLAIN = "save plain arrays in MATLAB: u = data.u; y = data.y; save('plain.mat','u','y','-v7')"
"""What helps with every object: arrays and structs are read from all files."""


class MatObject(Mapping[str, Any]):
    """A MATLAB object: its properties by name, and its class.

    MATLAB stores some properties under a name with an underscore at its end (`Data_` of a `timeseries`, `InputData_`).
    They are found by the name that MATLAB shows, too.
    """

    def __init__(self, kind: str, properties: Mapping[str, Any]) -> None:
        self.kind = kind
        self._properties = properties

    def __getitem__(self, name: str) -> Any:
        stored = self._properties.get(name)
        return self._properties[f"{name}_"] if stored is None or (not np.size(stored) and self._kept(name)) else stored

    def __contains__(self, name: object) -> bool:
        return name in self._properties or self._kept(name)

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys(name.removesuffix("_") for name in self._properties))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def _kept(self, name: object) -> bool:
        return f"{name}_" in self._properties


def matlab_value(value: Any, inside: Any = None) -> Any:
    """Return a struct, an object or a table as a mapping, times as seconds, and anything else as it is.

    Parameters
    ----------
    value : object
        What mat-io returned.
    inside : object
        What it is a field of. The data of an `iddata` object stand in a cell with one entry for each experiment; that
        of a single experiment is opened.
    """
    from matio.utils.matclass import MatlabObject, MatlabOpaque
    from pandas import DataFrame

    if isinstance(value, MatlabOpaque):
        return _timed(MatObject(str(value.classname), value.properties)) if _has_fields(value) else value
    if isinstance(value, DataFrame):
        return MatObject(*_matlab_table(value))
    if isinstance(value, np.number):
        return np.reshape(value, (1, 1))
    if isinstance(value, np.ndarray):
        if value.dtype.names and value.size == 1:
            fields = {name: value[name].flat[0] for name in value.dtype.names}
            return _timed(MatObject(str(value.classname), fields)) if isinstance(value, MatlabObject) else fields
        if isinstance(inside, MatObject) and value.dtype == object and value.size == 1:
            return matlab_value(value.flat[0])
        if value.dtype.kind in "mM":
            return seconds(value)
    return value


def class_of(value: Any) -> str:
    """Return the MATLAB class of an object, with the word for it; empty for arrays, structs and cells."""
    kind = value.kind if isinstance(value, MatObject) else getattr(value, "classname", None)
    return f"{kind} object" if kind else ""


def _has_fields(value: Any) -> bool:
    return isinstance(value.properties, Mapping)


def _timed(found: MatObject) -> MatObject:
    """Add the times of a `timeseries` that stores them as start and increment."""
    if found.kind != "timeseries" or ("Time" in found and np.size(found["Time"])) or "TimeInfo" not in found:
        return found
    info = matlab_value(found["TimeInfo"])
    if not isinstance(info, MatObject):
        return found
    if "Time" in info and np.size(info["Time"]):
        time = info["Time"]
    elif {"Start", "Increment", "Length"} <= set(info):
        start, step, length = (np.asarray(info[name]).item() for name in ("Start", "Increment", "Length"))
        time = start + step * np.arange(int(length))[:, None]
    else:
        return found
    return MatObject(found.kind, {**{name: found[name] for name in found}, "Time": time})


def _matlab_table(frame: Any) -> tuple[str, dict[str, Any]]:
    """Return class and variables of a table; the times of a timetable are seconds."""
    fields = {str(name): frame[name].to_numpy()[:, None] for name in frame.columns}
    if frame.index.dtype.kind not in "mM":
        return "table", fields
    return "timetable", {str(frame.index.name or "Time"): seconds(frame.index.to_numpy()[:, None]), **fields}


_DEPTH = 5  # of nested structs that are listed


def read_mat(path: Path, references: Sequence[str]) -> dict[str, FileColumn]:
    """Return the named columns of a MATLAB file of any version.

    Arrays have the shape that MATLAB shows. This also holds for v7.3 files, which store arrays transposed. Fields of
    structs, properties of objects (`timeseries`, `iddata`, classes of one's own) and variables of tables have dotted
    names.

    Raises
    ------
    DataError
        When the file is damaged or not a MATLAB file, when a variable or field is missing, or when it is not an array
        of numbers with that column.
    """
    paths = {reference: split_reference(reference)[0].split(".") for reference in references}
    with path.open("rb"):  # the library wraps the error of a file that is not there
        pass
    variables, classes = _load(path, sorted({parts[0] for parts in paths.values()}))
    columns = {}
    for reference, parts in paths.items():
        if parts[0] not in classes:
            raise DataError(f"{path}: no variable {parts[0]!r}; {nearest(parts[0], classes)}")
        value = _walk(path, reference, variables[parts[0]], parts)
        if kind := class_of(value):
            raise DataError(f"{path}: column {reference!r}: {'.'.join(parts)} is a MATLAB {kind}; {_rather(value)}")
        columns[reference] = FileColumn(pick_column(path, reference, value, row_vectors=True))
    return columns


def mat_channels(path: Path) -> list[FileChannel]:
    """Return the channels of a MATLAB file, also those in structs, objects and tables.

    Raises
    ------
    DataError
        When the file is damaged or not a MATLAB file.
    """
    with path.open("rb"):
        pass
    variables, classes = _load(path, None)
    found = [channel for name in classes for channel in _listed_matlab(name, matlab_value(variables[name]))]
    return [channel for channel in found if channel.n_samples or channel.remark]


def _listed_matlab(name: str, value: Any, depth: int = 0) -> list[FileChannel]:
    """Return the channels of a variable; those of structs and objects down to a few levels."""
    if isinstance(value, Mapping) and depth < _DEPTH:
        inside = [
            _listed_matlab(f"{name}.{field}", matlab_value(value[field], inside=value), depth + 1) for field in value
        ]
        return [channel for channels in inside for channel in channels]
    if kind := class_of(value):
        return [FileChannel(name, 0, remark=f"MATLAB {kind}: not read")]
    return array_channels(name, value, row_vectors=True)


def _load(path: Path, roots: list[str] | None) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the variables (all, when no roots are given), and the classes of all variables by name."""
    classes: dict[str, str] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of an option of pandas, and of objects returned as they are stored
        from matio import load_from_mat, whosmat  # imported here, because the import takes half a second

        try:
            classes = {name: str(kind) for name, (_, kind) in whosmat(str(path)).items()}
            wanted = [name for name in classes if roots is None or name in roots]
            return (load_from_mat(str(path), variable_names=wanted) if wanted else {}), classes
        except Exception as error:  # a damaged file can raise any kind of error in the reader
            there = ", ".join(f"{name} ({classes[name]})" for name in classes if roots and name in roots)
            which = f" at {there}" if there else ""
            raise DataError(
                f"{path}: not a readable MATLAB file{which} (truncated or of another format): {error}; {SAVE_PLAIN}"
            ) from None


def _walk(path: Path, reference: str, value: Any, parts: list[str]) -> Any:
    """Return the field of nested structs and objects that the dots of a reference name."""
    value = matlab_value(value)
    for depth, part in enumerate(parts[1:], start=1):
        struct = ".".join(parts[:depth])
        if not isinstance(value, Mapping):
            kind = class_of(value)
            rather = f", but a MATLAB {kind}; {SAVE_PLAIN}" if kind else ""
            raise DataError(f"{path}: column {reference!r}: {struct} is not a struct with fields{rather}")
        if part not in value:
            rather = f" (MATLAB {value.kind}; {SAVE_PLAIN})" if isinstance(value, MatObject) else ""
            known = nearest(part, value)
            raise DataError(f"{path}: column {reference!r}: {struct} has no field {part!r}; {known}{rather}")
        value = matlab_value(value[part], inside=value)
    return value


def _rather(value: Any) -> str:
    """Return advice for a reference to a whole object: its fields, or saving plain arrays."""
    fields = list(value) if isinstance(value, MatObject) else []
    return (f"name one of its fields, there is {', '.join(fields[:30])}; or " if fields else "") + SAVE_PLAIN


MATLAB = FileFormat((".mat",), read_mat, mat_channels, may_crash=True)


# ---- MDF files of vehicle and test-bench loggers, versions 3 and 4, by asammdf.


def read_mdf(path: Path, references: Sequence[str]) -> dict[str, FileColumn]:
    """Return the named channels of an MDF file in their physical values, with units and sample times.

    A channel is named ``group/channel``, where the group is its number from 0 or its acquisition name, or by its own
    name where only one group has it.

    Raises
    ------
    DataError
        When the file is damaged or not MDF, when a channel is missing or holds no numbers, or when samples are marked
        as invalid.
    UsageError
        When asammdf is not installed.
    """
    columns = {}
    with _opened_mdf(path) as file:
        known = _places(file)
        for reference in references:
            signal = _signal(file, _find_mdf(path, known, split_reference(reference)[0]))
            bad = _invalid(signal)
            if bad.size:
                raise DataError(
                    f"{path}: column {reference!r}: {bad.size} samples are marked as invalid, the first at sample "
                    f"{bad[0]}; leave those samples out"
                )
            columns[reference] = FileColumn(
                pick_column(path, reference, signal.samples), signal.unit or None, even_step(signal.timestamps)
            )
    return columns


def mdf_channels(path: Path) -> list[FileChannel]:
    """Return the channels of an MDF file.

    Raises
    ------
    DataError
        When the file is damaged or not MDF.
    UsageError
        When asammdf is not installed.
    """
    channels = []
    with _opened_mdf(path) as file:
        names: dict[tuple[int, int], str] = {}
        for name, places in _places(file).items():
            for place in places if len(places) == 1 else ():
                names.setdefault(place, name)  # the shortest name that stands for one channel
        for place, name in sorted(names.items()):
            signal = _signal(file, place)
            step = even_step(signal.timestamps)
            channels += array_channels(name, signal.samples, unit=signal.unit or None, sample_time=step)
    return channels


@contextmanager
def _opened_mdf(path: Path) -> Iterator[Any]:
    """Return a context with the open file, in which errors of its library become a DataError."""
    asammdf = extra_package("asammdf", "mdf", f"{path}: an MDF file")
    with path.open("rb") as handle:
        if handle.read(3) not in (b"MDF", b"UnF"):
            raise DataError(f"{path}: not an MDF file (empty or of another format)")
        handle.seek(0)
        try:
            with asammdf.MDF(handle) as file:
                yield file
        except DataError:
            raise
        except Exception as error:  # a damaged file can raise any kind of error in the reader
            _close_half_opened(error)
            raise DataError(f"{path}: not a readable MDF file (truncated or damaged): {error}") from None


def _close_half_opened(error: Exception) -> None:
    """Close readers that failed on opening: their finalizer fails otherwise, and prints that on standard error.

    They are in the frames of the error only.
    """
    trace = error.__traceback__
    while trace is not None:
        reader: Any = trace.tb_frame.f_locals.get("self")
        if hasattr(reader, "_closed"):
            reader._closed = True
            if getattr(reader, "_tempfile", None) is not None:
                reader._tempfile.close()
        trace = trace.tb_next


def _places(file: Any) -> dict[str, list[tuple[int, int]]]:
    """Return the places (group, channel) of each name: own names, then with the group's name, then with its number."""
    own: dict[str, list[tuple[int, int]]] = {}
    by_group: dict[str, list[tuple[int, int]]] = {}
    for g, group in enumerate(file.groups):
        named = getattr(group.channel_group, "acq_name", "") or ""
        for c, channel in enumerate(group.channels):
            own.setdefault(channel.name, []).append((g, c))
            for prefix in (named, str(g)):
                if prefix:
                    by_group.setdefault(f"{prefix}/{channel.name}", []).append((g, c))
    return {**own, **by_group}


def _find_mdf(path: Path, known: dict[str, list[tuple[int, int]]], name: str) -> tuple[int, int]:
    places = known.get(name)
    if places is None:
        raise DataError(f"{path}: no channel {name!r}; {nearest(name, known)}")
    if len(places) > 1:
        last = name.rpartition("/")[2]
        listed = ", ".join(f"{group}/{last}" for group, _ in places)
        raise DataError(f"{path}: channel {name!r} may be any of {listed}; give group and channel")
    return places[0]


def _signal(file: Any, place: tuple[int, int]) -> Any:
    return file.get(group=place[0], index=place[1], ignore_invalidation_bits=True)


def _invalid(signal: Any) -> np.ndarray[Any, Any]:
    bits = signal.invalidation_bits
    return np.zeros(0, int) if bits is None else np.flatnonzero(bits)


MDF = FileFormat((".mf4", ".mdf"), read_mdf, mdf_channels, states_sample_time=True, may_crash=True)


# ---- Archives of numpy (npz).


def read_npz(path: Path, references: Sequence[str]) -> dict[str, FileColumn]:
    """Return the named columns of an npz archive; pickled objects are never loaded.

    Raises
    ------
    DataError
        When the file is damaged or not an npz archive, or when a variable is missing, holds pickled objects, or is not
        an array of numbers with that column.
    """
    columns = {}
    with _opened_npz(path) as archive:
        for reference in references:
            name, _ = split_reference(reference)
            if name not in archive.files:
                raise DataError(f"{path}: no variable {name!r}; {nearest(name, archive.files)}")
            try:
                value = archive[name]
            except ValueError as error:
                if "pickle" not in str(error):
                    raise
                raise DataError(
                    f"{path}: variable {name!r} holds pickled Python objects, which are not loaded; "
                    "save it as an array of numbers"
                ) from None
            columns[reference] = FileColumn(pick_column(path, reference, value))
    return columns


def npz_channels(path: Path) -> list[FileChannel]:
    """Return the channels of an npz archive.

    Raises
    ------
    DataError
        When the file is damaged or not an npz archive.
    """
    channels = []
    with _opened_npz(path) as archive:
        for name in archive.files:
            try:
                channels += array_channels(name, archive[name])
            except ValueError as error:
                if "pickle" not in str(error):
                    raise
                channels.append(FileChannel(name, 0, remark="pickled Python objects: not loaded"))
    return channels


@contextmanager
def _opened_npz(path: Path) -> Iterator[Any]:
    """Return a context with the open archive, in which errors of its library become a DataError."""
    if not zipfile.is_zipfile(path):
        with path.open("rb"):  # is_zipfile is also False for a file that cannot be read
            pass
        raise DataError(f"{path}: not an npz archive (truncated or of another format); write it with numpy.savez")
    try:
        with np.load(path, allow_pickle=False) as archive:
            yield archive
    except DataError:
        raise
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise DataError(f"{path}: damaged npz archive: {error}") from None


NPZ = FileFormat((".npz",), read_npz, npz_channels, may_crash=True)


# ---- TDMS files of LabVIEW and FlexLogger, by nptdms.

_TDMS_UNITS = ("unit_string", "NI_UnitDescription", "Unit", "unit")


def read_tdms(path: Path, references: Sequence[str]) -> dict[str, FileColumn]:
    """Return the named channels of a TDMS file, scaled, with their units and sample times.

    A channel is named ``group/channel``, or by its own name where only one group has it.

    Raises
    ------
    DataError
        When the file is damaged, truncated or not TDMS, or when a channel is missing or holds no numbers.
    UsageError
        When nptdms is not installed.
    """
    columns = {}
    with _opened_tdms(path) as file:
        known = _channels(file)
        for reference in references:
            channel = _find_tdms(path, known, split_reference(reference)[0])
            columns[reference] = FileColumn(
                pick_column(path, reference, _values_tdms(channel)), _unit_tdms(channel), _sample_time(channel)
            )
    return columns


def tdms_channels(path: Path) -> list[FileChannel]:
    """Return the channels of a TDMS file.

    Raises
    ------
    DataError
        When the file is damaged, truncated or not TDMS.
    UsageError
        When nptdms is not installed.
    """
    with _opened_tdms(path) as file:
        return [
            listed
            for name, channel in _channels(file).items()
            for listed in array_channels(
                name, _values_tdms(channel), unit=_unit_tdms(channel), sample_time=_sample_time(channel)
            )
        ]


@contextmanager
def _opened_tdms(path: Path) -> Iterator[Any]:
    """Return a context with the open file, in which errors of its library become a DataError."""
    nptdms = extra_package("nptdms", "tdms", f"{path}: a TDMS file")
    with path.open("rb") as handle:
        if handle.read(4) != b"TDSm":
            raise DataError(f"{path}: not a TDMS file (empty or of another format)")
        handle.seek(0)
        try:
            with nptdms.TdmsFile.open(handle) as file:
                if file.file_status.incomplete_final_segment:
                    raise DataError(f"{path}: truncated: its last segment is not complete; copy or record it again")
                if not _channels(file):
                    raise DataError(f"{path}: holds no channels; is it truncated?")
                yield file
        except DataError:
            raise
        except Exception as error:  # a damaged file can raise any kind of error in the reader
            raise DataError(f"{path}: not a readable TDMS file (truncated or damaged): {error}") from None


def _channels(file: Any) -> dict[str, Any]:
    return {f"{group.name}/{channel.name}": channel for group in file.groups() for channel in group.channels()}


def _find_tdms(path: Path, known: dict[str, Any], name: str) -> Any:
    if name in known:
        return known[name]
    found = [full for full, channel in known.items() if channel.name == name]
    if len(found) > 1:
        raise DataError(f"{path}: channel {name!r} may be any of {', '.join(found)}; give group and channel")
    if not found:
        raise DataError(f"{path}: no channel {name!r}; {nearest(name, known)}")
    return known[found[0]]


def _values_tdms(channel: Any) -> Any:
    values = channel[:]
    return seconds(values) if getattr(values, "dtype", None) is not None and values.dtype.kind in "mM" else values


def _unit_tdms(channel: Any) -> str | None:
    return next((str(channel.properties[key]) for key in _TDMS_UNITS if key in channel.properties), None)


def _sample_time(channel: Any) -> float | None:
    """Return the increment of a waveform [s]; channels without time have the increment 0 or none."""
    step = channel.properties.get("wf_increment")
    return float(step) if isinstance(step, float | int) and step > 0 else None


TDMS = FileFormat((".tdms",), read_tdms, tdms_channels, states_sample_time=True, may_crash=True)
