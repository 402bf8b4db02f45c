"""Covariance of the gradient for coloured errors: exact for a model of the errors of each record."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len
from scipy.linalg import eigh

from gbid.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from gbid.identify.predictor import PredictorValues
from gbid.identify.uncertainty.error_model import ErrorModel, error_model, lag_products, longest_order
from gbid.identify.uncertainty.feedback_term import feedback_term
from gbid.identify.uncertainty.sensitivities import RecordSensitivities

_ROUNDS = 2  # rounds in which the part of the errors that the fit took away is given back
_LEAST = 0.1  # part of the covariance of the gradient that feedback of errors leaves at least
_APART = 4096  # samples, beyond which errors are not correlated
_AT_ONCE = 4096  # frequencies whose products are made together, in memory that is soon used again
_LONG = 10_000  # samples of a record for which this part is negligible


def score_covariance(
    records: Iterable[RecordSensitivities], weight: FloatArray, root: FloatArray, kept: IntArray
) -> tuple[FloatArray, list[ErrorModel]]:
    """Return the covariance of ``sum psi' W e`` for errors of the colour that the residuals have.

    Parameters
    ----------
    records : iterable of RecordSensitivities
        Sensitivities and residuals.
    weight : (n_y, n_y) array
        Weight W of the errors.
    root : (n_kept, n) array
        Root R of the inverse of the Gauss-Newton Hessian, ``R R' = H^-1``.
    kept : (n_kept,) integer array
        The unknowns that count as estimated.

    Returns
    -------
    (n, n) array
        The covariance of the gradient J in coordinates in which the Hessian is one, ``R' J R``.
    list of ErrorModel
        The model of each record.

    Notes
    -----
    With the spectrum S of an autoregressive model, and the transforms Psi of the sensitivities, the covariance is
    ``mean over frequencies of Psi* W S W Psi``: it has no longest lag, as sums of products of neighbouring gradients
    have. The residuals lack what the fit explains of the errors. For narrow-band sensitivities, as those of lightly
    damped modes, this is a notch in their spectrum just where S counts. So the expected products of the part that is
    missing, ``psi C psi'`` with the covariance C of the estimates, are added to those of the residuals.
    """
    return covariance_of(map(partial(transformed, kept=kept), records), weight, root)


def covariance_of(
    transforms: Iterable[Transform], weight: FloatArray, root: FloatArray
) -> tuple[FloatArray, list[ErrorModel]]:
    """Return the same as `score_covariance` from sensitivities that are transformed already."""
    n_kept = len(root)
    models, short = [], []
    long = np.zeros((2, n_kept, n_kept))  # of sensitivities as they are, and what feedback of errors changes
    for i, transform in enumerate(transforms):
        products, count = _products(transform)
        models.append(error_model(products, count))
        if len(transform.errors) > _LONG:
            _add(long, transform, models[i], weight)
        else:
            short.append((i, transform, products, count))
    found = _joined(long, root)
    for again in range(_ROUNDS + 1 if short else 0):
        C, total = root @ found @ root.T, long.copy()
        for i, transform, products, count in short:
            if again:
                models[i] = error_model(products + _taken(transform, C, len(products) - 1), count)
            _add(total, transform, models[i], weight)
        found = _joined(total, root)
    return found, models


def _joined(total: FloatArray, root: FloatArray) -> FloatArray:
    """Return the sum of both parts; of the first, feedback leaves at least a part.

    The sum is a covariance where the residuals are what their model says. At a point that is no minimum they are not.
    """
    linear, change = root.T @ total @ root
    if not np.isfinite(linear).all():
        raise np.linalg.LinAlgError("the covariance of the gradient overflows")
    if not change.any():
        return np.asarray(linear)
    share, axes = eigh(change, linear + 1e-12 * np.trace(linear) * np.eye(len(linear)))
    onto = linear @ axes
    return np.asarray(linear + (onto * np.maximum(share, _LEAST - 1)) @ onto.T)


class Transform(NamedTuple):
    """Errors of a record, and the Fourier transform of the sensitivities of its predictions.

    Attributes
    ----------
    psi : (n_y, n_columns, size // 2 + 1) complex array
    columns : (n_columns,) integer array
        Their places among the unknowns that are kept.
    size : int
        Number of samples with padding.
    feedback : tuple or None
        Predictor with feedback; which of its parameters are kept; their places.
    errors : (n_samples, n_y) array
        Prediction errors; zero for samples that are left out.
    counted : (n_samples,) boolean array
        Whether a sample is in the cost.
    """

    psi: ComplexArray
    columns: IntArray
    size: int
    feedback: tuple[PredictorValues, IntArray, IntArray] | None
    errors: FloatArray
    counted: BoolArray


def transformed(record: RecordSensitivities, kept: IntArray) -> Transform:
    """Return the transform of the sensitivities by the unknowns that count as estimated, (n_kept,) integers."""
    place = np.searchsorted(kept, record.columns)
    own = np.flatnonzero(kept[np.minimum(place, len(kept) - 1)] == record.columns)
    n = len(record.errors)
    size = next_fast_len(n + min(n, _APART), real=True)
    psi = record.psi if len(own) == len(place) else record.psi[:, own]
    feedback = _feedback(record, place, own)
    onto = np.fft.rfft(psi, size)  # pads row by row; that of scipy copies all rows first
    return Transform(onto, place[own], size, feedback, record.errors, record.counted)


def _feedback(
    record: RecordSensitivities, place: IntArray, own: IntArray
) -> tuple[PredictorValues, IntArray, IntArray] | None:
    if record.feedback is None:
        return None
    v, columns = record.feedback
    which = np.flatnonzero(np.isin(columns, own))
    return v, which, place[columns[which]]


def _products(record: Transform) -> tuple[FloatArray, int]:
    """Return the products of residuals at all pairs of lags, over the stretches in which all samples count."""
    edges = np.flatnonzero(np.diff(record.counted)) + 1
    stretches = [
        e
        for e, counted in zip(np.split(record.errors, edges), np.split(record.counted, edges), strict=True)
        if counted[0]
    ]
    longest = longest_order(int(record.counted.sum()), record.errors.shape[1])
    longest = min(longest, max(map(len, stretches)) // 2)
    return lag_products(stretches, longest)


def _add(total: FloatArray, transform: Transform, model: ErrorModel, weight: FloatArray) -> None:
    """Add the covariance of the gradient of a record."""
    psi, own, size = transform.psi, transform.columns, transform.size
    found = np.zeros((len(own), len(own)))
    factors = _weighted(model, weight, size)
    for first in range(0, psi.shape[2], _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        for row in factors[:, :, some]:
            coloured = row[0] * psi[0, :, some]
            for factor, slopes in zip(row[1:], psi[1:, :, some], strict=True):
                coloured += factor * slopes
            parts = coloured.view(float)
            found += parts @ parts.T
    total[0][np.ix_(own, own)] += 2 / size * found
    if transform.feedback is not None and model.order:
        v, which, places = transform.feedback
        term = feedback_term(v, model, weight)
        if term is not None:
            total[1][np.ix_(places, places)] += transform.counted.sum() * term[np.ix_(which, which)]


def _weighted(model: ErrorModel, weight: FloatArray, size: int) -> FloatArray:
    """Return ``L* W`` at each frequency, (n_y, n_y, n_frequencies), of half the power at frequency zero."""
    onto = np.einsum("fba,bc->acf", model.root(size).conj(), weight, optimize=True)
    onto[:, :, 0] /= np.sqrt(2)
    if size % 2 == 0:
        onto[:, :, -1] /= np.sqrt(2)
    return np.asarray(onto)


def _taken(transform: Transform, C: FloatArray, longest: int) -> FloatArray:
    """Return the expected products, at all pairs of lags, of the part of the errors that the fit explained."""
    psi, own, size = transform.psi, transform.columns, transform.size
    scale = np.sqrt(np.maximum(np.diag(C)[own], np.finfo(float).tiny))
    values, axes = np.linalg.eigh(C[np.ix_(own, own)] / np.outer(scale, scale))
    part = (scale[:, None] * axes * np.sqrt(np.maximum(values, 0.0))).T @ psi
    spectrum = np.einsum("amf,bmf->fab", part, part.conj(), optimize=True)
    lags = irfft(spectrum, size, axis=0)[: longest + 1]  # sums of q[k] q[k - lag]'
    i, j = np.indices((longest + 1, longest + 1))
    return np.asarray(np.where((j >= i)[..., None, None], lags[abs(j - i)], lags[abs(j - i)].transpose(0, 1, 3, 2)))
