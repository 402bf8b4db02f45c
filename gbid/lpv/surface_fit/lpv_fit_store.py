"""Surface fits in files: the model in YAML, its uncertainty in HDF5 beside it."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np

from gbid import hdf5
from gbid.errors import DataError, UsageError
from gbid.identify.fit_store import status_of_text
from gbid.lpv.basis import TERMS
from gbid.lpv.load import load_model, save_model
from gbid.lpv.surface_fit.lpv_fit import LPVFit
from gbid.naming.paths import given_path
from gbid.structure import KEY_PARAMETERS


def _from_schema_1(file: h5py.File) -> None:
    """Move estimates, orders and outliers to their own groups."""
    for name in ("points", "values", "values_covariance"):
        file.move(name, f"estimates/{name.removeprefix('values_')}")
    for name in ("recordings", "left_out"):
        hdf5.add_texts(file["estimates"], name, hdf5.read_texts(file, name))
    file.move("order", "orders/order")
    for name in ("rms", "score"):
        file.move(f"order_{name}", f"orders/{name}")
    hdf5.add_texts(file["orders"], "why_not", hdf5.read_texts(file, "why_not"))
    outliers = json.loads(hdf5.read_attribute(file, "outliers"))
    for name in ("recording", "parameter"):
        hdf5.add_texts(file.require_group("outliers"), name, [outlier[name] for outlier in outliers])
    for name in ("deviation", "standardised"):
        hdf5.add_dataset(file["outliers"], name, [outlier[name] for outlier in outliers], "", name)
    file.attrs["status"] = status_of_text(hdf5.read_text(file, "status"), success=bool(file.attrs["success"])).value


KIND = hdf5.FileKind("lpv_fit", "fit anew with `gbid lpv`", (_from_schema_1,))


def save_lpv_fit(fit: LPVFit, path: str | Path, overwrite: bool = False, key: str = "") -> None:
    """Write a surface fit: the model to ``path``, which `gbid.load_model` reads, the other fields to an .h5 beside it.

    Parameters
    ----------
    fit : LPVFit
        The fit.
    path : path
        The model file, ending in .yaml; the other file has the same name ending in .h5.
    overwrite : bool
        Whether existing files may be replaced.
    key : str
        Text that identifies settings and data of the fit; stored as attribute ``key``.

    Raises
    ------
    UsageError
        When a file exists and `overwrite` is not set, or when `path` has another ending.
    DataError
        When a file cannot be written.
    """
    path = given_path(path)
    beside = path.with_suffix(".h5")
    if beside.exists() and not overwrite:
        raise UsageError(f"{beside} exists already; choose another name or set overwrite")
    save_model(fit.model, path, overwrite)
    with hdf5.writing(beside, KIND, overwrite) as file:
        write_uncertainty(fit, file, key)


def write_uncertainty(fit: LPVFit, file: h5py.File, key: str) -> None:
    """Write all fields of a fit except its model."""
    hdf5.write_fields(file, fit)
    file.attrs.update({"key": key, "model": fit.model.name, "success": fit.success})
    hdf5.add_texts(file, "parameters", KEY_PARAMETERS)
    hdf5.add_texts(file, "terms", TERMS)
    words = "coefficients, parameters by terms"
    hdf5.add_dataset(file, "coefficients", fit.coefficients, "SI per kg, bar, rpm", words)


def load_lpv_fit(path: str | Path) -> LPVFit:
    """Return the surface fit in the files of `save_lpv_fit`.

    Parameters
    ----------
    path : path
        The model file or the .h5; both must be in the same folder.

    Returns
    -------
    LPVFit
        The fit.

    Raises
    ------
    UsageError
        When the model file is missing or faulty.
    DataError
        When the .h5 is missing, damaged, or belongs to another model.
    """
    path = given_path(path)
    if path.suffix == ".h5":
        path = path.with_suffix(".yaml")
    model = load_model(path)
    beside = path.with_suffix(".h5")
    with hdf5.reading(beside, KIND) as file:
        fit = hdf5.read_fields(file, LPVFit, model=model)
        stored = hdf5.read_dataset(file, "coefficients")
    if stored.shape != fit.coefficients.shape or not np.allclose(stored, fit.coefficients, rtol=1e-9, atol=0):
        raise DataError(f"{beside}: belongs to other coefficients than {path}; fit again, or use the files of one fit")
    return fit
