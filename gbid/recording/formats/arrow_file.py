"""Reader of Parquet and Feather files, by pyarrow."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from gbid.core.errors import DataError
from gbid.core.extras import extra_package
from gbid.recording.readers import FileChannel, FileFormat, array_channels
from gbid.recording.text_files import FileColumn, find_heading, name_and_unit, pick_column, seconds, split_reference

_PARQUET = (".parquet", ".pq")
_UNITS = (b"unit", b"units")


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
        table = _table(path)
        for reference in references:
            index = find_heading(path, table.column_names, split_reference(reference)[0])
            if missing := table.column(index).null_count:
                raise DataError(
                    f"{path}: column {reference!r}: {missing} values are missing; leave them out or repair them"
                )
            values = pick_column(path, reference, _values(table.column(index)))
            columns[reference] = FileColumn(values, _unit(table.schema.field(index)))
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
        table = _table(path)
        names = [name_and_unit(heading)[0] for heading in table.column_names]
        for i, heading in enumerate(table.column_names):
            name = names[i] if names.count(names[i]) == 1 else heading
            unit = _unit(table.schema.field(i))
            if missing := table.column(i).null_count:
                channels.append(FileChannel(name, table.num_rows, unit, remark=f"{missing} values are missing"))
            else:
                channels += array_channels(name, _values(table.column(i)), unit=unit)
    return channels


def _table(path: Path) -> Any:
    what = f"{path}: a {'Parquet' if path.suffix.lower() in _PARQUET else 'Feather'} file"
    if path.suffix.lower() in _PARQUET:
        return extra_package("pyarrow.parquet", "arrow", what).read_table(path)
    return extra_package("pyarrow.feather", "arrow", what).read_table(path)


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """Return a context in which what a damaged file raises becomes a DataError."""
    with path.open("rb"):  # the library wraps the error of a file that is not there
        pass
    arrow = extra_package("pyarrow", "arrow", f"{path}: a file of columns")
    try:
        yield
    except (arrow.ArrowException, OSError) as error:
        text = str(error).strip().splitlines()[0]
        raise DataError(f"{path}: not readable (truncated or of another format): {text}") from None


def _values(column: Any) -> Any:
    """Return a column as an array; times in seconds, lists of fixed length as (n_samples, n_channels)."""
    values = column.to_numpy()
    if values.dtype.kind in "mM":
        return seconds(values)
    if hasattr(column.type, "list_size") and len(values):
        return np.stack(list(values))
    return values


def _unit(field: Any) -> str | None:
    """Return the unit in the metadata of a column, or in its heading."""
    metadata = field.metadata or {}
    stated = next((metadata[key].decode("utf-8", "replace") for key in _UNITS if key in metadata), None)
    return name_and_unit(field.name)[1] if stated is None else stated


FORMAT = FileFormat((".parquet", ".pq", ".feather", ".arrow"), read_arrow, arrow_channels, may_crash=True)
