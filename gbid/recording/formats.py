"""File formats for the import of recordings: a `FileFormat` for each.

A format is one constant of this file. The import, the check of an experiment, the patterns of a folder and the messages
find it by `file_formats`.
"""

from __future__ import annotations

import re
import struct
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from math import isfinite
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeGuard

import h5py
import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError, UsageError, nearest
from gbid.core.extras import extra_package, offered
from gbid.recording.clock import even_step
from gbid.recording.columns import FileColumn, find_heading, name_and_unit, seconds, short_names
from gbid.recording.hdf5_links import HDF5_ENDINGS, linked, refuse_links
from gbid.recording.iddata import IddataExperiment, experiments_of
from gbid.recording.mapping import FilePart, TextOptions
from gbid.recording.readers import (
    ALL,
    FileChannel,
    FileFormat,
    OpenFile,
    StoredArray,
    StoredReader,
    array_format,
    index_of,
    rows_of,
    with_values,
)
from gbid.recording.text_files import CUT, TextTable, holds_text, is_large, read_rows, read_table
from gbid.recording.universal import open_universal, read_responses


def format_of(path: Path) -> FileFormat | None:
    """Return the format for a file's ending; for an unknown ending the text format, if the file is text."""
    known = format_of_ending(path.suffix.lower())
    return CSV if known is None and (not path.is_file() or holds_text(path)) else known


def format_of_ending(ending: str) -> FileFormat | None:
    """Return the format for a file ending (``.mat``): from gbid, else from another package.

    A package offers a format by an entry point of the group ``gbid.formats``, whose name is the ending without the dot
    and whose value is a `FileFormat`.

    Raises
    ------
    UsageError
        When the package fails on its import, or offers something else.
    """
    return file_formats().get(ending) or _offered_format(ending)


@cache
def _offered_format(ending: str) -> FileFormat | None:
    match offered("gbid.formats", ending[1:]) if ending[1:] else None:
        case None:
            return None
        case FileFormat() as found, _:
            return found
        case other, package:
            raise UsageError(f"{ending!r} (gbid.formats): {package} offers a {type(other).__name__}, no FileFormat")


@cache
def file_formats() -> Mapping[str, FileFormat]:
    """Return the formats defined in this module, by file ending."""
    formats = [value for value in globals().values() if isinstance(value, FileFormat)]
    return MappingProxyType({ending: each for each in formats for ending in each.endings})


# ---- Parquet and Feather files, by pyarrow.

_PARQUET = (".parquet", ".pq")
_ARROW_UNITS = (b"unit", b"units")


@contextmanager
def open_arrow(path: Path, _names: Sequence[str] | None) -> Iterator[OpenFile]:
    """Return a context with a Parquet or Feather file.

    The unit is in the metadata of a column (``unit``), or in its heading, ``u_x [um]``. The column is then named
    ``u_x``. A column of lists of fixed length is an array with several columns.
    """
    is_parquet = path.suffix.lower() in _PARQUET
    kind = "Parquet" if is_parquet else "Feather"
    pyarrow, ipc, parquet = (
        extra_package(f"pyarrow{module}", "arrow", f"{path}: a {kind} file") for module in ("", ".ipc", ".parquet")
    )
    opened: Any = (
        parquet.ParquetFile(path, page_checksum_verification=True) if is_parquet else pyarrow.OSFile(str(path))
    )
    with opened as file:
        schema = file.schema_arrow if is_parquet else ipc.open_file(file).schema

        def read(index: int, part: FilePart) -> tuple[Any, int, int | None]:
            """Return values, their total number, and the first index; only the needed pieces stay in memory."""
            rows, first = rows_of(ALL if part.axis else part)  # channels as rows are read as a whole
            if not is_parquet:
                pieces, total = _feather_rows(ipc, file, index, rows)
                return pyarrow.chunked_array(pieces, schema.field(index).type), total, first
            heading, total = schema.names[index], file.metadata.num_rows
            if first is None:
                return file.read(columns=[heading]).column(0), total, None
            sizes = [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)]
            ends = np.cumsum(sizes)
            chosen = np.flatnonzero((ends > first) & (ends - sizes < rows.stop)).tolist()
            before = int(ends[chosen[0]]) - sizes[chosen[0]] if chosen else 0
            values = file.read_row_groups(chosen, columns=[heading]).column(0)
            return values[first - before : rows.stop - before], total, first

        def stored(index: int, part: FilePart = ALL) -> StoredArray:
            field = schema.field(index)
            column, total, first = read(index, part)
            metadata = field.metadata or {}
            stated = next((metadata[key].decode("utf-8", "replace") for key in _ARROW_UNITS if key in metadata), None)
            values = column.to_numpy()  # nan for null
            if values.dtype.kind in "mM":
                values = seconds(values)
            elif values.dtype == object and len(values) and len({np.shape(each) for each in values}) == 1:
                values = np.stack(list(values))  # of lists of one length; texts stay texts
            unit = name_and_unit(field.name)[1] if stated is None else stated
            return StoredArray(values, unit, first=first, total=None if first is None else total)

        headings = schema.names
        yield OpenFile(
            lambda name, part: stored(find_heading(path, headings, name), part),
            lambda: ((name, partial(stored, i)) for i, name in enumerate(short_names(headings))),
        )


def _feather_rows(ipc: Any, file: Any, index: int, rows: slice) -> tuple[list[Any], int]:
    """Return rows of a Feather column and the total number of rows; the file is read piece by piece."""
    reader = ipc.open_file(file, options=ipc.IpcReadOptions(included_fields=[index]))
    kept, total = [], 0
    for i in range(reader.num_record_batches):
        column = reader.get_batch(i).column(0)
        first, stop = max((rows.start or 0) - total, 0), len(column) if rows.stop is None else rows.stop - total
        if first < len(column) and stop > 0:
            kept.append(column[first:stop])
        total += len(column)
    return kept, total


ARROW = array_format((".parquet", ".pq", ".feather", ".arrow"), "Parquet or Feather file", open_arrow, "pyarrow")


# ---- Tables in text files (csv) with names, and often units, above the numbers.


SHOWN_FIRST = 200
"""Number of first rows that are read to judge a file."""


def read_csv(
    path: Path, references: Sequence[str], options: TextOptions | None = None, part: FilePart | None = None
) -> dict[str, FileColumn]:
    """Return named columns of a csv file.

    Encoding, delimiter, decimal sign and the lines of names and units are found in the file, or given. A cell such as
    ``u_x [um]`` or ``u_x (um)`` gives name and unit. A column can be named with or without its unit.

    Raises
    ------
    DataError
        When the file is not text, when it has no header line or rows of different length, when a column is
        missing or occurs twice, or when a cell of a requested column is not a number.
    """
    if part is None or part.samples is None or not is_large(path):
        return _columns(_complete_table(path, options), references)
    columns = _columns(read_rows(path, options, *part.samples), references)
    return {name: column._replace(first=part.samples[0]) for name, column in columns.items()}


def _complete_table(path: Path, options: TextOptions | None, *, ends: bool = False) -> TextTable:
    """Return a table without an incomplete last row; `ends` reads only the ends of a large file."""
    table = read_table(path, options, ends=ends)
    return replace(table, rows=table.rows[:-1]) if table.is_cut else table


def peek_csv(
    path: Path, references: Sequence[str], options: TextOptions | None = None
) -> tuple[int, dict[str, FileColumn]]:
    """Return the number of rows of a csv file, and the first rows and last row of its columns.

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
    table = _complete_table(path, options, ends=True)
    if len(table.rows) < 2:
        raise DataError(f"{path}: expected a header line and rows of numbers, found one row; record longer")
    ends = replace(table, rows=(*table.rows[: min(SHOWN_FIRST, len(table.rows) - 1)], table.rows[-1]))
    return len(table.rows) + table.n_left_out, _columns(ends, references)


def csv_channels(path: Path, options: TextOptions | None = None) -> list[FileChannel]:
    """Return the columns of a csv file with units and first numbers; of a large file only the first rows are read.

    Raises
    ------
    DataError
        When the file is not text, or when it has no header line or no rows.
    """
    table = _complete_table(path, options, ends=True)
    count, first = len(table.rows) + table.n_left_out, replace(table, rows=table.rows[: table.n_first])
    columns = zip(short_names(table.headings), table.units, _listed_csv(first), strict=True)
    channels = ((FileChannel(name, count, unit), values) for name, unit, values in columns)
    return [
        replace(channel, remark="not all cells are numbers") if values is None else with_values(channel, values)
        for channel, values in channels
    ]


def _listed_csv(table: TextTable) -> list[FloatArray | None]:
    """Return each column as numbers; None for a column with other cells."""
    try:
        return list(table.columns(range(len(table.headings))).T)
    except DataError:
        _ = table.cells  # a damaged row is an error, a column of text is none
    columns: list[FloatArray | None] = []
    for i in range(len(table.headings)):
        try:
            columns.append(table.columns([i])[:, 0])
        except DataError:
            columns.append(None)
    return columns


def csv_layout(path: Path, options: TextOptions | None = None) -> dict[str, Any]:
    """Return encoding, delimiter, decimal sign and header lines of a csv file, as plain values."""
    table = read_table(path, options, ends=True)
    return {**table.layout.stated(), **({"last_line": CUT} if table.is_cut else {})}


def _columns(table: TextTable, references: Sequence[str]) -> dict[str, FileColumn]:
    indices = [table.index(reference) for reference in references]
    values = table.columns(indices) if indices else np.zeros((len(table.rows), 0))
    return {
        reference: _with_times(
            FileColumn(np.ascontiguousarray(values[:, k]), table.units[i], remark=table.remark), table, i
        )
        for k, (reference, i) in enumerate(zip(references, indices, strict=True))
    }


def _with_times(column: FileColumn, table: TextTable, index: int) -> FileColumn:
    """Return a column with the clock of its time column, in a table with several different time columns."""
    if not table.clocks:
        return column
    clock = max((i for i in table.clocks if i <= index), default=min(table.clocks))
    times = table.clocks[clock]
    step = even_step(times)
    start = None if step is None else round(1e9 * times[0])
    return column._replace(values=column.values[: len(times)], sample_time=step, clock=clock, start_ns=start)


CSV = FileFormat((".csv",), read_csv, csv_channels, peek_csv, may_crash=True, takes_part=True, layout=csv_layout)


# ---- HDF5 files of other programs: datasets and fields of tables by their paths.

_MOST_LISTED = 4000  # entries: each takes up to a millisecond
_UNIT_ATTRIBUTES = ("units", "unit", "Units", "Unit", "Unit_string", "unit_string")


@contextmanager
def open_hdf5(path: Path, _names: Sequence[str] | None) -> Iterator[OpenFile]:
    """Return a context with an HDF5 file.

    A column is the path of a dataset, ``run1/p_x`` or ``run1/p[0]``, or the path of a table with one of its fields,
    ``run1/table/p_x``. The unit is that of the attribute ``units`` or ``unit``.
    """
    with linked(path) as file:

        def get(name: str, part: FilePart = ALL) -> StoredArray:
            name = name.strip("/")
            parent, _, field = name.rpartition("/")
            dataset = file.dataset(name)
            if dataset is not None:
                return _stored_hdf5(dataset, None, part)
            table = file.dataset(parent) if parent else None
            if table is not None and field in (table.dtype.names or ()):
                return _stored_hdf5(table, field, part)
            raise DataError(f"{path}: no dataset {name!r}; {nearest(name, [known for known, _ in every()])}")

        def every() -> Iterator[tuple[str, StoredReader]]:
            """Yield the path of each dataset or table field, with a function that reads it."""
            for name, dataset in file.datasets(_MOST_LISTED):
                if isinstance(dataset, DataError):
                    yield name, partial(_fail, dataset)
                elif dataset.dtype.names:
                    yield from (
                        (f"{name}/{field}", partial(_stored_hdf5, dataset, field)) for field in dataset.dtype.names
                    )
                else:
                    yield name, partial(_stored_hdf5, dataset, None)

        yield OpenFile(get, every)


def _fail(error: Exception) -> StoredArray:
    raise error


def _stored_hdf5(dataset: Any, field: str | None, part: FilePart = ALL) -> StoredArray:
    """Return a dataset or table field with its unit; tables may state a unit for each field."""
    keys = _UNIT_ATTRIBUTES if field is None else (f"{field}_units", f"{field}_unit")
    stated = (dataset.attrs.get(key) for key in keys) if h5py.h5a.get_num_attrs(dataset.id) else ()
    unit = next((each for each in stated if isinstance(each, str | bytes)), None)
    if dataset.shape is None:
        return StoredArray(np.zeros(0))
    where, first, total = index_of(dataset.shape, part)
    values = dataset[where] if field is None else dataset.fields(field)[where]
    unit = unit.decode("utf-8", "replace") if isinstance(unit, bytes) else unit
    return StoredArray(
        np.asarray(values), unit, first=first, total=total, unscaled="" if field else _unscaled_hdf5(dataset)
    )


_FACTORS = ("scale", "scale_factor", "scaling", "scaling_factor", "slope", "gain", "calibration_factor")
_OFFSETS = ("add_offset", "offset", "intercept")


def _unscaled_hdf5(dataset: Any) -> str:
    """Return a text on the scale that an HDF5 dataset states but h5py does not apply; empty if it has none."""
    if not h5py.h5a.get_num_attrs(dataset.id):
        return ""
    for neutral, keys in ((1, _FACTORS), (0, _OFFSETS)):
        for key in (spelled for each in keys for spelled in (each, each.capitalize(), each.upper())):
            value = np.asarray(dataset.attrs.get(key, neutral))  # to iterate fails where storage is external
            if value.dtype.kind in "fiu" and value.size and not np.all(value == neutral):
                return f"{key} = {value.flat[0]:g}"
    return ""


HDF5 = array_format(HDF5_ENDINGS, "HDF5 file", open_hdf5)


# ---- MATLAB files of all versions, with their objects, by mat-io.


SAVE_PLAIN = "save plain arrays in MATLAB: u = data.u; y = data.y; save('plain.mat','u','y','-v7')"
"""What helps with every object: arrays and structs are read from all files."""


class MatObject(Mapping[str, Any]):
    """MATLAB object: properties by name, and class name.

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
    """Return a struct, object or table as a mapping, times in seconds, and other values unchanged.

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
        fields = value.properties
        return _timed(MatObject(str(value.classname), fields)) if isinstance(fields, Mapping) else value
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
    """Return the MATLAB class of an object, such as "table object"; empty for arrays, structs and cells."""
    kind = value.kind if isinstance(value, MatObject) else getattr(value, "classname", None)
    return f"{kind} object" if kind else ""


def _timed(series: MatObject) -> MatObject:
    """Return a `timeseries` with its times, computed from start and increment if necessary."""
    if series.kind != "timeseries" or ("Time" in series and np.size(series["Time"])) or "TimeInfo" not in series:
        return series
    info = matlab_value(series["TimeInfo"])
    if not isinstance(info, MatObject):
        return series
    if "Time" in info and np.size(info["Time"]):
        time = info["Time"]
    elif {"Start", "Increment", "Length"} <= set(info):
        start, step, length = (np.asarray(info[name]).item() for name in ("Start", "Increment", "Length"))
        time = start + step * np.arange(int(length))[:, None]
    else:
        return series
    return MatObject(series.kind, {**{name: series[name] for name in series}, "Time": time})


def _in_series(stored: StoredArray, series: Any) -> StoredArray:
    """Return data or times of a `timeseries` with their start and step, where the times are even and in seconds."""
    if not isinstance(series, MatObject) or series.kind != "timeseries" or "Time" not in series:
        return stored
    info, times = matlab_value(series["TimeInfo"]) if "TimeInfo" in series else {}, np.ravel(series["Time"])
    unit = info["Units"] if isinstance(info, Mapping) and "Units" in info else "seconds"
    step = even_step(times) if times.dtype.kind in "fiu" and np.all(np.asarray(unit) == "seconds") else None
    return stored if step is None else stored._replace(sample_time=step, start_ns=round(1e9 * float(times[0])))


def _matlab_table(frame: Any) -> tuple[str, dict[str, Any]]:
    """Return class and variables of a MATLAB table; times of a timetable are in seconds."""
    fields = {str(name): frame[name].to_numpy()[:, None] for name in frame.columns}
    if frame.index.dtype.kind not in "mM":
        return "table", fields
    return "timetable", {str(frame.index.name or "Time"): seconds(frame.index.to_numpy()[:, None]), **fields}


_DEPTH = 5  # of nested structs that are listed


@contextmanager
def open_mat(path: Path, names: Sequence[str] | None) -> Iterator[OpenFile]:
    """Return a context with an open MATLAB file of any version.

    Arrays have the shape that MATLAB shows, also those of v7.3 files, which store them transposed; a row is a vector.
    Fields of structs, properties of objects (`timeseries`, `iddata`, classes of one's own) and variables of tables have
    dotted names.
    """
    roots = None if names is None else {name.partition(".")[0] for name in names}
    load = cache(lambda: _load(path, roots))

    def get(name: str, part: FilePart = ALL) -> StoredArray:
        if part.samples is not None and (rows := _rows_of_mat73(path, name, part)) is not None:
            return rows
        root, *fields = name.split(".")
        variables, classes = load()
        if root not in classes:
            raise DataError(f"{path}: no variable {root!r}; {nearest(root, classes)}")
        value = matlab_value(variables[root])
        if _is_iddata(value) and name not in (root, *(f"{root}.{p}" for p in value)):
            channels = _channels_of_iddata(value, f"{path}: {root}")
            if (rest := name.partition(".")[2]) in channels:
                return channels[rest]
        series = None
        for depth, field in enumerate(fields, start=1):
            where, series = f"{path}: column {name!r}: {'.'.join([root, *fields][:depth])}", value
            value = _field(value, field, where)
        return _in_series(_stored_mat(name, value), series)

    def leaves(name: str, value: Any, inside: Any = None, depth: int = 0) -> Iterator[tuple[str, StoredReader]]:
        try:
            value = matlab_value(value, inside)
            channels = _channels_of_iddata(value, f"{path}: {name}") if _is_iddata(value) else None
        except Exception:  # which the reading of this variable tells
            yield name, lambda: _stored_mat(name, matlab_value(value, inside))
            return
        if channels is not None:
            yield from ((f"{name}.{channel}", lambda each=each: each) for channel, each in channels.items())
        elif not isinstance(value, Mapping) or depth == _DEPTH:
            yield name, lambda: _stored_mat(name, value)
        else:
            for field in value:
                yield from leaves(f"{name}.{field}", value[field], value, depth + 1)

    def every() -> Iterator[tuple[str, StoredReader]]:
        try:
            variables, classes = load()
        except DataError:  # of one variable, perhaps: the others are listed
            variables, classes = _load(path, set())
        for name in classes:
            try:
                value = variables[name] if variables else _load(path, {name})[0][name]
            except DataError as error:
                yield name, partial(_fail, error)
            else:
                yield from leaves(name, value)

    yield OpenFile(get, every)


_NUMBERS = {f"{kind}{bits}".encode() for kind in ("int", "uint") for bits in (8, 16, 32, 64)} | {b"double", b"single"}


def _rows_of_mat73(path: Path, name: str, part: FilePart) -> StoredArray | None:
    """Return selected samples of a matrix in a v7.3 file; None for other variables, which are loaded whole."""
    if not h5py.is_hdf5(path):
        return None
    with linked(path, alone=True) as file:
        dataset = file.dataset(name.replace(".", "/"))
        if dataset is None or dataset.attrs.get("MATLAB_class") not in _NUMBERS:
            return None
        if dataset.ndim != 2 or dataset.dtype.names or "MATLAB_empty" in dataset.attrs:
            return None
        is_vector = min(dataset.shape) == 1
        where, first, total = index_of((dataset.size,) if is_vector else dataset.shape[::-1], part)
        if is_vector:
            return StoredArray(dataset[(0, *where) if len(dataset) == 1 else (*where, 0)], first=first, total=total)
        return StoredArray(dataset[(*where, slice(None), slice(None))[1::-1]].T, first=first, total=total)


def _is_iddata(value: Any) -> TypeGuard[MatObject]:
    return isinstance(value, MatObject) and value.kind == "iddata"


def _channels_of_iddata(value: MatObject, where: str) -> dict[str, StoredArray]:
    """Return the channels of an `iddata` object by name: ``force``, or ``Exp2.force`` with several experiments."""
    experiments, channels = experiments_of(value, where), dict[str, StoredArray]()
    for each in experiments:
        prefix = f"{each.name}." if len(experiments) > 1 else ""
        clock = (each.sample_time, None if each.start is None or each.sample_time is None else round(1e9 * each.start))
        for name, channel in (each.inputs | each.outputs).items():
            channels[f"{prefix}{name}"] = StoredArray(channel.values, channel.unit or None, clock[0], start_ns=clock[1])
        if each.time is not None:
            channels[f"{prefix}time"] = StoredArray(each.time, "s")
    return channels


def iddata_in(path: Path, variable: str | None = None) -> list[IddataExperiment]:
    """Return the experiments of an `iddata` object in a MATLAB file; `variable` chooses among several objects.

    Raises
    ------
    DataError
        When the file cannot be read or has no such object.
    UsageError
        When it has several and none is named.
    """
    variables, _ = _load(path, None if variable is None else {variable})
    values = {name: matlab_value(value) for name, value in variables.items()}
    objects = {name: value for name, value in values.items() if _is_iddata(value)}
    if not objects:
        raise DataError(f"{path}: has no iddata object{f' {variable!r}' if variable else ''}; import its arrays")
    if len(objects) > 1:
        raise UsageError(f"{path}: has the iddata objects {', '.join(objects)}; name one")
    ((name, data),) = objects.items()
    return experiments_of(data, f"{path}: {name}")


def _stored_mat(name: str, value: Any) -> StoredArray:
    if kind := class_of(value):
        fields = (
            f"name one of its fields, such as {', '.join(list(value)[:30])}; or "
            if isinstance(value, MatObject)
            else ""
        )
        return StoredArray(
            np.zeros(0), fault=f"{name} is a MATLAB {kind}; {fields}{SAVE_PLAIN}", remark=f"MATLAB {kind}: not read"
        )
    if isinstance(value, np.ndarray) and value.dtype == np.uint32 and value.size > 1 and value.flat[0] == _OBJECT:
        text = f"{name} is a MATLAB object of which mat-io gives the reference alone; {SAVE_PLAIN}"
        return StoredArray(np.zeros(0), fault=text, remark="MATLAB object: not read")
    if isinstance(value, np.ndarray) and value.ndim == 2 and len(value) == 1 and value.size > 1:
        value = value[0]
    return StoredArray(value)


_OBJECT = 0xDD000000  # first number of a reference to an object


def _field(struct: Any, field: str, where: str) -> Any:
    """Return a field of a MATLAB struct or object."""
    if not isinstance(struct, Mapping):
        kind = class_of(struct)
        rather = f", but a MATLAB {kind}; {SAVE_PLAIN}" if kind else ""
        raise DataError(f"{where} is not a struct with fields{rather}")
    if field not in struct:
        rather = f" (MATLAB {struct.kind}; {SAVE_PLAIN})" if isinstance(struct, MatObject) else ""
        raise DataError(f"{where} has no field {field!r}; {nearest(field, struct)}{rather}")
    return matlab_value(struct[field], inside=struct)


def _load(path: Path, roots: set[str] | None) -> tuple[dict[str, Any], dict[str, str]]:
    """Return variables (all if no roots are given), and the classes of all variables by name."""
    classes: dict[str, str] = {}
    if h5py.is_hdf5(path):
        refuse_links(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of an option of pandas, and of objects returned as they are stored
        from matio import load_from_mat, whosmat  # imported here, because the import takes half a second

        try:
            classes = {name: str(kind) for name, (_, kind) in whosmat(str(path)).items()}
            wanted = [name for name in classes if roots is None or name in roots]
            return (load_from_mat(str(path), variable_names=wanted) if wanted else {}), classes
        except Exception as error:  # a damaged file can raise any kind of error in the reader
            named = ", ".join(f"{name} ({classes[name]})" for name in classes if roots and name in roots)
            which = f" at {named}" if named else ""
            raise DataError(
                f"{path}: not a readable MATLAB file{which} (truncated or of another format): {error}; {SAVE_PLAIN}"
            ) from None


MATLAB = array_format((".mat",), "MATLAB file", open_mat, "matio", states_sample_time=True)


# ---- MDF files of vehicle and test-bench loggers, versions 3 and 4, by asammdf.


@contextmanager
def open_mdf(path: Path, _names: Sequence[str] | None) -> Iterator[OpenFile]:
    """Return a context with an open MDF file; channels have physical values.

    A channel is named ``group/channel``, where the group is its number from 0 or its acquisition name, or by its own
    name where only one group has it.
    """
    asammdf = extra_package("asammdf", "mdf", f"{path}: an MDF file")
    with path.open("rb") as handle:
        if handle.read(3) not in (b"MDF", b"UnF"):
            raise DataError(f"{path}: not an MDF file (empty or of another format)")
        handle.seek(0)
        try:
            with asammdf.MDF(handle) as file:
                yield _open_mdf(path, file)
        except Exception as error:
            _close_half_opened(error)
            raise


def _open_mdf(path: Path, file: Any) -> OpenFile:
    known = _places(file)

    def stored(place: tuple[int, int], part: FilePart = ALL) -> StoredArray:
        rows, first = rows_of(part)
        chosen = {} if first is None else {"record_offset": first, "record_count": rows.stop - first}
        signal = file.get(group=place[0], index=place[1], ignore_invalidation_bits=True, **chosen)
        bits, values = signal.invalidation_bits, signal.samples
        if bits is not None and np.any(bits) and values.dtype.kind in "fiub":
            values = np.where(bits, np.nan, values)
        total, step = file.groups[place[0]].channel_group.cycles_nr, even_step(signal.timestamps)
        start = None if step is None else round(1e9 * (signal.timestamps[0] - (first or 0) * step))
        clock = {"first": first, "total": total, "clock": place[0], "start_ns": start}
        return StoredArray(values, signal.unit or None, step, **clock)

    def get(name: str, part: FilePart = ALL) -> StoredArray:
        places = known.get(name, [])
        if len(places) > 1:
            last = name.rpartition("/")[2]
            listed = ", ".join(f"{group}/{last}" for group, _ in places)
            raise DataError(f"{path}: channel {name!r} may be any of {listed}; give group and channel")
        if not places:
            raise DataError(f"{path}: no channel {name!r}; {nearest(name, known)}")
        return stored(places[0], part)

    names: dict[tuple[int, int], str] = {}
    for name, places in known.items():
        if len(places) == 1:
            names.setdefault(places[0], name)  # the shortest name that stands for one channel
    return OpenFile(get, lambda: ((name, partial(stored, place)) for place, name in sorted(names.items())))


def _close_half_opened(error: Exception) -> None:
    """Close readers whose opening failed, so that their finalizers print no further error.

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
    """Return the positions (group, channel) of each channel, by name, by group/name and by group number/name."""
    named: dict[str, list[tuple[int, int]]] = {}
    by_group: dict[str, list[tuple[int, int]]] = {}
    for g, group in enumerate(file.groups):
        acquisition = getattr(group.channel_group, "acq_name", "") or ""
        for c, channel in enumerate(group.channels):
            named.setdefault(channel.name, []).append((g, c))
            for prefix in (acquisition, str(g)):
                if prefix:
                    by_group.setdefault(f"{prefix}/{channel.name}", []).append((g, c))
    return {**named, **by_group}


MDF = array_format((".mf4", ".mdf"), "MDF file", open_mdf, "asammdf", states_sample_time=True)


# ---- Archives of numpy (npz).


@contextmanager
def open_npz(path: Path, _names: Sequence[str] | None) -> Iterator[OpenFile]:
    """Return a context with an npz archive; pickled objects are refused."""
    with path.open("rb") as handle, np.lib.npyio.NpzFile(handle, allow_pickle=False) as archive:
        if twice := [name for name, count in Counter(archive.files).items() if count > 1]:
            raise DataError(f"{path}: holds variable {twice[0]!r} more than once; save it again with each name once")

        def get(name: str, part: FilePart = ALL) -> StoredArray:
            if name not in archive.files:
                raise DataError(f"{path}: no variable {name!r}; {nearest(name, archive.files)}")
            try:
                if part.samples is not None and (mapped := _mapped_member(archive, name)) is not None:
                    where, first, total = index_of(mapped.shape, part)
                    return StoredArray(np.array(mapped[where]), first=first, total=total)
                return StoredArray(archive[name])
            except ValueError as error:
                if "pickle" not in str(error):
                    raise
            text = (
                f"variable {name!r} holds pickled Python objects, which are not loaded; save it as an array of numbers"
            )
            return StoredArray(np.zeros(0), fault=text, remark="pickled Python objects: not loaded")

        yield OpenFile(get, lambda: ((name, partial(get, name)) for name in archive.files))


def _mapped_member(archive: Any, name: str) -> Any:
    """Return an array of an archive mapped into memory; None if it is compressed."""
    info, handle = archive.zip.getinfo(f"{name}.npy"), archive.zip.fp
    if info.compress_type:
        return None
    handle.seek(info.header_offset + 26)  # lengths of name and extra field (PKWARE, APPNOTE.TXT, Sec. 4.3.7)
    handle.seek(info.header_offset + 30 + sum(struct.unpack("<HH", handle.read(4))))
    version = np.lib.format.read_magic(handle)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, columns_first, dtype = read(handle)
    if dtype.hasobject or 0 in shape:
        return None
    return np.memmap(handle, dtype, "r", handle.tell(), shape, "F" if columns_first else "C")


NPZ = array_format((".npz",), "npz archive", open_npz)


# ---- TDMS files of LabVIEW and FlexLogger, by nptdms.

_TDMS_UNITS = ("unit_string", "NI_UnitDescription", "Unit", "unit")


@contextmanager
def open_tdms(path: Path, _names: Sequence[str] | None) -> Iterator[OpenFile]:
    """Return a context with a TDMS file; channels are scaled.

    A channel is named ``group/channel``, or by its own name where only one group has it.
    """
    nptdms = extra_package("nptdms", "tdms", f"{path}: a TDMS file")
    with path.open("rb") as handle:
        if handle.read(4) != b"TDSm":
            raise DataError(f"{path}: not a TDMS file (empty or of another format)")
        handle.seek(0)
        with nptdms.TdmsFile.open(handle) as file:
            if file.file_status.incomplete_final_segment:
                raise DataError(f"{path}: truncated: its last segment is not complete; copy or record it again")
            known = {f"{group.name}/{channel.name}": channel for group in file.groups() for channel in group.channels()}
            if not known:
                raise DataError(f"{path}: holds no channels; is it truncated?")

            def get(name: str, part: FilePart = ALL) -> StoredArray:
                full = [each for each, channel in known.items() if name in (each, channel.name)]
                if len(full) > 1 and name not in known:
                    raise DataError(f"{path}: channel {name!r} may be any of {', '.join(full)}; give group and channel")
                if not full:
                    raise DataError(f"{path}: no channel {name!r}; {nearest(name, known)}")
                channel = known.get(name, known[full[0]])
                levels = (channel.properties, file[channel.group_name].properties, file.properties)
                return _stored_tdms(channel, part)._replace(unscaled=_unscaled_tdms(levels))

            yield OpenFile(get, lambda: ((name, partial(get, name)) for name in known))


def _stored_tdms(channel: Any, part: FilePart = ALL) -> StoredArray:
    """Return a channel's values with unit, and its increment as sample time (none for an untimed channel).

    The first sample was taken `wf_start_offset` after `wf_start_time`.
    """
    rows, first = rows_of(part)
    values, step = channel[rows], channel.properties.get("wf_increment")
    if getattr(values, "dtype", np.dtype(object)).kind in "mM":
        values = seconds(values)
    unit = next((str(channel.properties[key]) for key in _TDMS_UNITS if key in channel.properties), None)
    sample_time = float(step) if isinstance(step, float | int) and step > 0 else None
    begin, offset = (channel.properties.get(f"wf_start_{key}") for key in ("time", "offset"))
    start = None
    if sample_time is not None and (begin is not None or offset is not None):
        start = 0 if begin is None else int(np.datetime64(begin, "ns").astype(int))
        start += round(1e9 * offset) if isinstance(offset, float | int) and isfinite(offset) else 0
    return StoredArray(values, unit, sample_time, first=first, total=len(channel), start_ns=start)


_TDMS_SCALE = re.compile(r"NI_Scale\[\d+\]_Scale_Type")
_TDMS_SCALES = (
    *("Linear", "Polynomial", "RTD", "Strain", "Table", "Thermistor", "Thermocouple"),
    *("Add", "Subtract", "AdvancedAPI"),
)


def _unscaled_tdms(levels: Iterable[Mapping[str, Any]]) -> str:
    """Return a text on a scale in the properties that nptdms does not apply; empty if there is none."""
    for properties in levels:
        kinds = [str(value) for key, value in properties.items() if _TDMS_SCALE.fullmatch(key)]
        unknown = [kind for kind in kinds if kind not in _TDMS_SCALES]
        if unknown and properties.get("NI_Scaling_Status") != "scaled":
            return f"a scale of the type {unknown[0]!r}"
    return ""


TDMS = array_format((".tdms",), "TDMS file", open_tdms, "nptdms", states_sample_time=True)


# ---- WAV files of sound cards and acoustic front ends, by scipy.


@contextmanager
def open_wav(path: Path, _names: Sequence[str] | None) -> Iterator[OpenFile]:
    """Return a context with a WAV file; its array `data` (n_samples, n_channels) is relative to full scale.

    Whole numbers are divided by their full scale (of 24 bits, which are read as 32, too); floating-point numbers stay.
    """
    from scipy.io import wavfile

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", wavfile.WavFileWarning)  # chunks that are not understood
        warnings.filterwarnings("error", "Reached EOF", wavfile.WavFileWarning)
        rate, values = wavfile.read(path)
    offset, scale = (128, 128) if values.dtype == np.uint8 else (0, 1)
    if values.dtype.kind == "i":
        scale = -int(np.iinfo(values.dtype).min)
    data = StoredArray((values.astype(float) - offset) / scale, "", 1 / rate)

    def get(name: str, _part: FilePart) -> StoredArray:
        if name != "data":
            raise DataError(f"{path}: no channel {name!r}; a WAV file has data[0], data[1], ...")
        return data

    yield OpenFile(get, lambda: [("data", lambda: data)])


WAV = array_format((".wav",), "WAV file", open_wav, "scipy.io", states_sample_time=True)


# ---- Universal files of modal analysis, by pyuff.

UNIVERSAL = replace(
    array_format((".uff", ".unv", ".uf"), "universal file", open_universal, "pyuff", states_sample_time=True),
    responses=read_responses,
)
