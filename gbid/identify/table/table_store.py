"""Tables of fits in HDF5 and CSV. The tree and the columns are documented in docs/file-formats.md."""

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
    path : path
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When it cannot be written.
    """
    hdf5.save(table, path, KIND, overwrite)


def load_table(path: str | Path) -> FitTable:
    """Read the table of a campaign, ``results/<name>/table.h5``.

    Parameters
    ----------
    path : path
        The HDF5 file, not the CSV one (which leaves the covariances out).

    Returns
    -------
    FitTable

    Raises
    ------
    DataError
        When the file is missing, damaged, incomplete or of another kind.
    """
    return hdf5.load(path, KIND, FitTable)


def csv_table(fits: FitTable) -> Table:
    """Columns of a table of fits for a CSV file, a note tells their units. What a fit does not have is missing."""
    columns = fits.columns()
    units = ", ".join(f"{name} [{unit}]" for name, (_, unit) in columns.items() if unit)
    values = [[None if value != value else value for value in array.tolist()] for array, _ in columns.values()]
    rows = list(zip(*values, strict=True))
    return plain_table(list(columns), rows, [f"units, SI where none is given: {units}"])
