"""A fit of surfaces on disk: the model as YAML, its uncertainty as HDF5 beside it."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np

from gbid import hdf5
from gbid.arrays import FloatArray
from gbid.errors import DataError, UsageError
from gbid.lpv.basis import TERMS
from gbid.lpv.load import load_model, save_model
from gbid.lpv.surface_fit.estimates import Estimates
from gbid.lpv.surface_fit.lpv_fit import LPVFit
from gbid.lpv.surface_fit.order import OrderScore
from gbid.lpv.surface_fit.outliers import Outlier
from gbid.structure import KEY_PARAMETERS

KIND = "lpv_fit"
_TEXT = h5py.string_dtype()


def save_lpv_fit(fit: LPVFit, path: str | Path, overwrite: bool = False, key: str = "") -> None:
    """Write a fit of surfaces: the model to ``path``, which `gbid.load_model` reads, the rest to an .h5 beside it.

    Parameters
    ----------
    fit : LPVFit
    path : path
        The model file, ending in .yaml; the other gets the same name ending in .h5.
    overwrite : bool
        Whether existing files may be replaced.
    key : str
        What the fit was made from, as a caller may want to know it again.

    Raises
    ------
    UsageError
        When a file exists and `overwrite` is not set, or the ending is another.
    DataError
        When a file cannot be written.
    """
    path = Path(path)
    beside = path.with_suffix(".h5")
    if beside.exists() and not overwrite:
        raise UsageError(f"{beside} exists already; choose another name or ask for overwriting")
    save_model(fit.model, path, overwrite)
    with hdf5.writing(beside, KIND, overwrite) as file:
        write_uncertainty(fit, file, key)


def write_uncertainty(fit: LPVFit, file: h5py.File, key: str) -> None:
    """Write all of a fit but its model."""
    file.attrs.update(
        {
            "key": key,
            "model": fit.model.name,
            "status": fit.status,
            "success": fit.success,
            "options": json.dumps(dict(fit.options)),
            "outliers": json.dumps([vars(o) for o in fit.outliers]),
        }
    )
    texts = {
        "parameters": KEY_PARAMETERS,
        "terms": TERMS,
        "recordings": fit.estimates.recordings,
        "left_out": fit.estimates.left_out,
        "notes": fit.notes,
        "why_not": tuple(score.why_not for score in fit.orders),
    }
    for name, values in texts.items():
        file.attrs.create(name, list(values), shape=(len(values),), dtype=_TEXT)
    mixed = "SI per kg, bar, rpm"
    estimates = fit.estimates
    for name, numbers, unit, long_name in (
        ("coefficients", fit.coefficients, mixed, "coefficients, parameters by terms"),
        ("covariance", fit.covariance, mixed, "covariance of the coefficients, parameter by parameter its terms"),
        ("scatter", fit.scatter, "SI per kg", "covariance of recordings about the surfaces beside their own error"),
        ("lack_of_fit", fit.lack_of_fit, "1", "probability that right surfaces miss the points' means as far"),
        ("points", estimates.points, "bar and rpm", "operating points of the recordings"),
        ("values", estimates.values, "SI per kg", "estimates, recordings by parameters"),
        ("values_covariance", estimates.covariance, "SI per kg", "their covariances"),
        ("order", [score.order for score in fit.orders], "1", "orders compared"),
        ("order_score", [score.score for score in fit.orders], "1", "prediction of points left out, relative"),
        (
            "order_rms",
            np.reshape([score.rms for score in fit.orders], (-1, len(KEY_PARAMETERS))),
            "SI per kg",
            "rms error of that prediction, orders by parameters",
        ),
    ):
        hdf5.add_dataset(file, name, numbers, unit, long_name)


def load_lpv_fit(path: str | Path) -> LPVFit:
    """Read a fit of surfaces back.

    Parameters
    ----------
    path : path
        The model file or the .h5; the other must stand beside it.

    Returns
    -------
    LPVFit

    Raises
    ------
    UsageError
        When the model file is missing or broken.
    DataError
        When the .h5 is missing, damaged, or belongs to another model.
    """
    path = Path(path)
    if path.suffix == ".h5":
        path = path.with_suffix(".yaml")
    model = load_model(path)
    beside = path.with_suffix(".h5")
    with hdf5.reading(beside, KIND) as file:
        try:
            fit = _read(file, LPVFit(model, *_matrices(file), _estimates(file)))
        except DataError:
            raise
        except (TypeError, ValueError, UsageError) as error:
            raise DataError(f"{beside}: damaged, its entries do not fit together ({error}); fit anew") from None
        stored = hdf5.read_dataset(file, "coefficients")
    if stored.shape != fit.coefficients.shape or not np.allclose(stored, fit.coefficients, rtol=1e-9, atol=0):
        raise DataError(f"{beside}: belongs to other coefficients than {path}; fit anew or keep the two together")
    return fit


def _matrices(file: h5py.File) -> tuple[FloatArray, FloatArray]:
    return hdf5.read_dataset(file, "covariance"), hdf5.read_dataset(file, "scatter")


def _estimates(file: h5py.File) -> Estimates:
    return Estimates(
        _texts(file, "recordings"),
        hdf5.read_dataset(file, "points"),
        hdf5.read_dataset(file, "values"),
        hdf5.read_dataset(file, "values_covariance"),
        _texts(file, "left_out"),
    )


def _read(file: h5py.File, bare: LPVFit) -> LPVFit:
    columns = (hdf5.read_dataset(file, name) for name in ("order", "order_rms", "order_score"))
    rows = zip(*columns, _texts(file, "why_not"), strict=True)
    attribute = hdf5.read_attribute
    return LPVFit(
        bare.model,
        bare.covariance,
        bare.scatter,
        bare.estimates,
        tuple(Outlier(**o) for o in json.loads(str(attribute(file, "outliers")))),
        tuple(OrderScore(int(order), rms, float(score), why) for order, rms, score, why in rows),
        hdf5.read_dataset(file, "lack_of_fit"),
        json.loads(str(attribute(file, "options"))),
        str(attribute(file, "status")),
        bool(attribute(file, "success")),
        _texts(file, "notes"),
    )


def _texts(file: h5py.File, name: str) -> tuple[str, ...]:
    return tuple(str(text) for text in np.atleast_1d(hdf5.read_attribute(file, name)))
