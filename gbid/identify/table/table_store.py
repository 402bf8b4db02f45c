"""Tables of fits in HDF5 and CSV. The tree and the columns are documented in docs/file-formats.md."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from gbid import hdf5
from gbid.errors import DataError
from gbid.identify.table.fit_table import FitTable
from gbid.tables.table import Table, plain_table

KIND = "table"
_TEXT = h5py.string_dtype()

# Of each dataset of numbers, its unit and its name in words.
_NUMBERS = {
    "pressure_bar": ("bar", "supply pressure"),
    "speed_rpm": ("rpm", "shaft speed"),
    "values": ("as attribute units of the root", "estimates, fits by parameters"),
    "std": ("as attribute units of the root", "standard deviations; 0 fixed, nan none"),
    "covariance": ("as attribute units of the root", "covariance to trust, fits by parameters by parameters"),
    "mode_frequency_hz": ("Hz", "natural frequencies"),
    "mode_frequency_std_hz": ("Hz", "standard deviations of the natural frequencies"),
    "mode_damping": ("1", "damping factors"),
    "mode_damping_std": ("1", "standard deviations of the damping factors"),
    "static_gain": ("", "static gains, fits by gains"),
    "static_gain_std": ("", "standard deviations of the static gains"),
    "fit_percent": ("%", "fit, fits by outputs"),
    "success": ("1", "whether the fit is there and converged"),
    "iterations": ("1", "iterations of the solver"),
    "wall_time_s": ("s", "time that the fit took"),
}
_TEXTS = {
    "fit": "name of the fit",
    "model": "which model of the fit",
    "structure": "name of the structure",
    "status": "status of the fit, or why it failed",
}
_LISTS = {"recordings": "recordings fitted to, one a line", "notes": "what a reader should know, one a line"}
_NAMES = ("parameter_names", "units", "gain_names", "output_names")


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
    with hdf5.writing(path, KIND, overwrite) as file:
        for name in _NAMES:
            texts = getattr(table, name)
            file.attrs.create(name, list(texts), shape=(len(texts),), dtype=_TEXT)
        for name, long_name in _TEXTS.items():
            _add_texts(file, name, list(getattr(table, name)), long_name)
        for name, long_name in _LISTS.items():
            _add_texts(file, name, ["\n".join(each) for each in getattr(table, name)], long_name)
        for name, (unit, long_name) in _NUMBERS.items():
            values = getattr(table, name)
            options: dict[str, Any] = {"compression": "gzip"} if name == "covariance" and values.size else {}
            hdf5.add_dataset(file, name, values, unit, long_name, **options)


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
    with hdf5.reading(path, KIND) as file:
        numbers = {name: hdf5.read_dataset(file, name) for name in _NUMBERS}
        texts = {name: np.array(_read_texts(file, name), dtype=str) for name in _TEXTS}
        lists = {
            name: tuple(tuple(text.split("\n")) if text else () for text in _read_texts(file, name)) for name in _LISTS
        }
        names = {name: tuple(str(text) for text in hdf5.read_attribute(file, name)) for name in _NAMES}
    numbers["success"] = numbers["success"].astype(bool)
    _check_shapes(path, numbers, texts, lists, names)
    found: dict[str, Any] = {**numbers, **texts, **lists, **names}
    return FitTable(**found)


def csv_table(fits: FitTable) -> Table:
    """Columns of a table of fits for a CSV file, a note tells their units. What a fit does not have is missing."""
    columns = fits.columns()
    units = ", ".join(f"{name} [{unit}]" for name, (_, unit) in columns.items() if unit)
    values = [[None if value != value else value for value in array.tolist()] for array, _ in columns.values()]
    rows = list(zip(*values, strict=True))
    return plain_table(list(columns), rows, [f"units, SI where none is given: {units}"])


def _add_texts(file: h5py.File, name: str, texts: list[str], long_name: str) -> None:
    dataset = file.create_dataset(name, data=np.array(texts, dtype=object), shape=(len(texts),), dtype=_TEXT)
    dataset.attrs["units"], dataset.attrs["long_name"] = "", long_name


def _read_texts(file: h5py.File, name: str) -> list[str]:
    dataset = file.get(name)
    if not isinstance(dataset, h5py.Dataset) or h5py.check_string_dtype(dataset.dtype) is None:
        raise DataError(f"{file.filename}: /{name} is missing or holds no texts")
    return [str(text) for text in dataset.asstr()[()]]


def _check_shapes(
    path: str | Path,
    numbers: dict[str, npt.NDArray[Any]],
    texts: dict[str, npt.NDArray[Any]],
    lists: dict[str, tuple[tuple[str, ...], ...]],
    names: dict[str, tuple[str, ...]],
) -> None:
    """Refuse a table whose columns do not fit together."""
    n, k = len(texts["fit"]), len(names["parameter_names"])
    across = {
        **dict.fromkeys(("values", "std"), (k,)),
        "covariance": (k, k),
        **dict.fromkeys(("static_gain", "static_gain_std"), (len(names["gain_names"]),)),
        "fit_percent": (len(names["output_names"]),),
        **{name: numbers["mode_damping"].shape[1:2] for name in numbers if name.startswith("mode_")},
    }
    for name, values in {**numbers, **texts}.items():
        expected = (n, *across.get(name, ()))
        if values.shape != expected:
            raise DataError(f"{path}: /{name} has shape {values.shape}, expected {expected}; make the table anew")
    for name, each in lists.items():
        if len(each) != n:
            raise DataError(f"{path}: /{name} has {len(each)} rows, expected {n}; make the table anew")
