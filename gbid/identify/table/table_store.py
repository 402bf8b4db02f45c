"""Tables of fits in HDF5 and CSV; docs/file-formats.md describes tree and columns."""

from __future__ import annotations

from pathlib import Path

from gbid import hdf5
from gbid.identify.table.fit_table import FitTable
from gbid.tables.table import Table, plain_table

KIND = hdf5.FileKind("table", "make the table anew with `gbid batch` or `gbid run`")


def save_table(table: FitTable, path: str | Path, overwrite: bool = False) -> None:
    """Write a table of fits to an HDF5 file.

    Parameters
    ----------
    table : FitTable
        The table.
    path : path
        The file.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When the file cannot be written.
    """
    hdf5.save(table, path, KIND, overwrite)


def load_table(path: str | Path) -> FitTable:
    """Return the table of a campaign, ``results/<name>/table.h5``.

    Parameters
    ----------
    path : path
        The HDF5 file. The CSV file has no covariances and cannot be loaded.

    Returns
    -------
    FitTable
        The table.

    Raises
    ------
    DataError
        When the file is missing, damaged, incomplete or of another kind.
    """
    return hdf5.load(path, KIND, FitTable)


def csv_table(fits: FitTable) -> Table:
    """Return the columns of a table of fits for a CSV file, with a note on units; nan becomes a missing value."""
    columns = fits.columns()
    units = ", ".join(f"{name} [{unit}]" for name, (_, unit) in columns.items() if unit)
    values = [[None if value != value else value for value in array.tolist()] for array, _ in columns.values()]
    rows = list(zip(*values, strict=True))
    return plain_table(list(columns), rows, [f"units, SI where none is given: {units}"])
