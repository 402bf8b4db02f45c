"""Coloured residuals: autoregressive error models, whitening, and the covariance of the gradient."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

import numpy as np
import scipy

from gbid.core.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from gbid.identify.predictor import PredictorValues

_LONGEST = 150  # largest order of the model
_FLOOR = 1e-9  # power of white noise added to the past, as a part of the whole; it keeps smooth residuals regular
_SAMPLES_A_COEFFICIENT = 20  # samples for each coefficient of the largest order, and for each output


class ErrorModel(NamedTuple):
    """Vector autoregression ``e[k] = sum_i a[i] e[k-i] + w[k]`` with white w.

    Attributes
    ----------
    coefficients : (order, n_y, n_y) array
        Matrices a of the lags 1, 2, ...
    innovation : (n_y, n_y) array
        Covariance of w.
    """

    coefficients: FloatArray
    innovation: FloatArray

    @property
    def order(self) -> int:
        """Number of lags."""
        return len(self.coefficients)

    def root(self, size: int) -> FloatArray:
        """Return spectral factors L with ``S = L L*``, at the frequencies of a real FFT of `size` samples.

        Returns
        -------
        (size // 2 + 1, n_y, n_y) complex array
            ``L = (1 - sum_i a[i] exp(-j w i))^-1 chol(innovation)``.
        """
        n_y = len(self.innovation)
        lags = np.concatenate([np.eye(n_y)[None], -self.coefficients])
        inverses = _inverses(scipy.fft.rfft(lags, size, axis=0))
        return np.asarray(np.tensordot(inverses, np.linalg.cholesky(self.innovation), 1))

    def spectrum(self, frequencies: FloatArray) -> FloatArray:
        """Return the spectrum at frequencies (n,) in radians per sample, (n, n_y, n_y) complex."""
        lags = np.concatenate([np.eye(len(self.innovation))[None], -self.coefficients])
        turns = np.vander(np.exp(-1j * frequencies), len(lags), increasing=True)
        root = np.tensordot(_inverses(np.tensordot(turns, lags, 1)), np.linalg.cholesky(self.innovation), 1)
        return np.asarray(root @ root.conj().transpose(0, 2, 1))


def longest_order(n_samples: int, n_y: int) -> int:
    """Return the largest order to try for a given number of samples."""
    return int(np.clip(n_samples // (_SAMPLES_A_COEFFICIENT * n_y), 0, _LONGEST))


def lag_products(stretches: list[FloatArray], longest: int) -> tuple[FloatArray, int]:
    """Return ``sum_k e[k-i] e[k-j]'`` for all pairs of lags up to the longest, over gap-free stretches.

    Parameters
    ----------
    stretches : list of (n_samples, n_y) or (n_signals, n_samples, n_y) array
        Residuals, or several signals over which the sums are added; stretches that are not longer than `longest` do not
        count.
    longest : int
        Largest lag.

    Returns
    -------
    (longest + 1, longest + 1, n_y, n_y) array
        The sums, each over the same samples k.
    int
        Number of these samples.
    """
    n_y = stretches[0].shape[-1]
    total, count = np.zeros((longest + 1, longest + 1, n_y, n_y)), 0
    for e in stretches:
        n = e.shape[-2]
        if n > longest:
            total, count = total + _stretch_products(e.reshape(-1, n, n_y), longest), count + n - longest
    return total, count


def _stretch_products(e: FloatArray, longest: int) -> FloatArray:
    """Return the `lag_products` of one stretch, summed over signals (n_signals, n_samples, n_y)."""
    n_signals, n, n_y = e.shape
    M = np.empty((longest + 1, longest + 1, n_y, n_y))
    size = scipy.fft.next_fast_len(n + longest, real=True)
    now, all_of = (
        scipy.fft.rfft(np.ascontiguousarray(part.transpose(0, 2, 1)), size)
        for part in (np.concatenate([np.zeros((n_signals, longest, n_y)), e[:, longest:]], axis=1), e)
    )
    both = np.einsum("saf,sbf->abf", now, all_of.conj())
    M[0] = scipy.fft.irfft(both, size)[:, :, : longest + 1].transpose(2, 0, 1)
    M[1:, 0] = M[0, 1:].transpose(0, 2, 1)
    # One lag more in both: one sample enters in front, and one leaves at the end.
    first = e[:, longest - 1 :: -1] if longest else e[:, :0]
    last = e[:, : n - longest - 1 : -1] if longest else e[:, :0]
    every = np.concatenate([first, last]).reshape(2 * n_signals, -1)
    signed = np.concatenate([first, -last]).transpose(1, 2, 0)
    for i, rows in enumerate(signed):
        change = (rows @ every).reshape(n_y, longest, n_y).transpose(1, 0, 2)
        np.add(M[i, :-1], change, out=M[i + 1, 1:])
    return M


def error_model(products: FloatArray, count: int, order: int | None = None) -> ErrorModel:
    """Return the autoregressive model by least squares, with the order of the corrected AIC.

    Parameters
    ----------
    products : (longest + 1, longest + 1, n_y, n_y) array
        Sums from `lag_products`.
    count : int
        Number of samples in the sums.
    order : int, optional
        Order, in place of that of the criterion.

    Returns
    -------
    ErrorModel
        The model. The residuals of a single output are used in both directions of time.

    Raises
    ------
    numpy.linalg.LinAlgError
        When the sums are not finite.

    Notes
    -----
    One Cholesky factor gives all orders (Luetkepohl, New Introduction to Multiple Time Series Analysis, Secs. 3.2 and
    4.3; Hurvich and Tsai, 1989, for the criterion).
    """
    if not np.isfinite(products).all():  # residuals so large that their squares overflow
        raise np.linalg.LinAlgError("the residuals overflow")
    longest, n_y = len(products) - 1, products.shape[2]
    if n_y == 1:
        products = (products + products[::-1, ::-1]) / 2
    covariances = [products[0, 0] / count]
    whitened = factor = np.zeros((0, n_y))
    if longest:
        past = products[1:, 1:].transpose(0, 2, 1, 3).reshape(longest * n_y, longest * n_y)
        present = products[1:, 0].reshape(longest * n_y, n_y)
        past = past + _FLOOR * np.diag(np.diag(past) + np.finfo(float).tiny)
        factor = scipy.linalg.cho_factor(past, lower=True)[0]
        whitened = scipy.linalg.solve_triangular(factor, present, lower=True)
        explained = np.cumsum(np.einsum("mka,mkb->mab", *2 * [whitened.reshape(longest, n_y, n_y)]), axis=0)
        covariances += list((products[0, 0] - explained) / count)
    orders = np.arange(longest + 1)
    spare = count - n_y * (orders + 1) - 1
    _, logs = np.linalg.slogdet(np.array(covariances))
    with np.errstate(invalid="ignore"):
        criterion = count * logs + 2 * orders * n_y**2 * count / np.maximum(spare, 1e-3)
    if order is None:
        order = int(np.nanargmin(np.where(np.isfinite(criterion), criterion, np.inf)))
    k = order * n_y
    solved = whitened[:0]
    if order:
        solved = scipy.linalg.solve_triangular(factor[:k, :k], whitened[:k], lower=True, trans="T")
    return ErrorModel(solved.reshape(order, n_y, n_y).transpose(0, 2, 1), covariances[order])


def _inverses(matrices: FloatArray) -> FloatArray:
    """Return the inverses of many small matrices, in closed form for one or two rows."""
    n = matrices.shape[-1]
    if n == 1:
        return 1 / matrices
    if n > 2:
        return np.asarray(np.linalg.inv(matrices))
    (a, b), (c, d) = matrices.transpose(1, 2, 0)
    return np.asarray((np.array([[d, -b], [-c, a]]) / (a * d - b * c)).transpose(2, 0, 1))


_UNIFORM = 256  # frequencies from 0 to pi
_NEAR = np.geomspace(0.1, 100.0, 14)  # distances of further frequencies from a pole, in units of its half width


def feedback_term(v: PredictorValues, model: ErrorModel, weight: FloatArray) -> FloatArray | None:
    """Return the additional covariance of the gradient from the feedback of errors, per sample.

    Parameters
    ----------
    v : PredictorValues
        One-step predictor whose last regressors are the measured outputs.
    model : ErrorModel
        Model of the errors.
    weight : (n_y, n_y) array
        Weight W of the errors.

    Returns
    -------
    (n_p, n_p) array or None
        The term; None for a model that is unstable without its predictor.

    Notes
    -----
    A disturbance gain feeds the errors back into the sensitivities, ``psi_i = G_i e + ...``. The gradient is then
    quadratic in the errors. For Gaussian errors with spectrum S its covariance is, besides the sum over
    ``psi_i' W E[e e'] W psi_j``, the mean over frequencies of ``trace(W G_i S W G_j S)`` (Isserlis, 1918). It is zero
    for white errors, because G_i contains only earlier errors.
    """
    n, n_y = v.F.shape[0], v.C.shape[0]
    gain, gain_slopes = v.G[:, -n_y:], v.dG[:, :, -n_y:]
    closed = v.F + gain @ v.C
    poles = np.concatenate([np.linalg.eigvals(closed), np.linalg.eigvals(v.F)])
    if np.abs(poles).max() >= 1:
        return None
    w = _frequencies(poles)
    z = np.exp(1j * w)[:, None, None]
    state = np.linalg.solve(z * np.eye(n) - closed, np.broadcast_to(gain + 0j, (len(w), n, n_y)))
    output = v.C @ state + np.eye(n_y)
    onto = np.linalg.solve(z * np.eye(n) - v.F.T, np.broadcast_to(v.C.T + 0j, (len(w), n, n_y))).transpose(0, 2, 1)
    spectrum = model.spectrum(w)
    terms = []
    for dF, dG, dC in zip(v.dF, gain_slopes, v.dC, strict=True):
        response = dC @ state + onto @ (dF @ state + dG @ output)
        terms.append(weight @ response @ spectrum)
    weighted = np.array(terms)
    steps = np.diff(w, prepend=w[0]) / 2 + np.diff(w, append=w[-1]) / 2
    return np.asarray(np.einsum("ifab,jfba,f->ij", weighted, weighted, steps, optimize=True).real / np.pi)


def _frequencies(poles: FloatArray) -> FloatArray:
    """Return frequencies from 0 to pi, denser near the poles."""
    angles, widths = np.abs(np.angle(poles)), 1 - np.abs(poles)
    near = angles[:, None] + widths[:, None] * np.concatenate([-_NEAR, [0.0], _NEAR])
    grid = np.concatenate([np.linspace(0, np.pi, _UNIFORM), near.ravel()])
    return np.unique(grid[(grid >= 0) & (grid <= np.pi)])


class RecordSensitivities(NamedTuple):
    """Errors and prediction sensitivities of a record.

    Attributes
    ----------
    columns : (n_columns,) integer array
        Unknowns on which the record depends, among all parameters and, after them, the initial states of all records.
    psi : (n_y, n_columns, n_samples) array
        Derivatives of the predictions; zero for samples that are left out.
    errors : (n_samples, n_y) array
        Prediction errors; zero for samples that are left out.
    counted : (n_samples,) boolean array
        Whether a sample is in the cost.
    feedback : (PredictorValues, (n_p,) integer array) or None
        Predictor that feeds measured outputs back, and its parameters among `columns`; None without feedback.
    """

    columns: IntArray
    psi: FloatArray
    errors: FloatArray
    counted: BoolArray
    feedback: tuple[PredictorValues, IntArray] | None = None


# ---- Whitening: errors and sensitivities of a record, filtered by the autoregressive model of the errors.


class Whitening(NamedTuple):
    """Whitening filter of an autoregressive error model: the filtered errors are white with unit power.

    Attributes
    ----------
    model : ErrorModel
        Stable model of the errors.
    root : (n_y, n_y) array
        Root of the covariance of the innovation.
    first : (order * n_y, order * n_y) array
        Root of the covariance of the first `order` samples of a stretch.
    """

    model: ErrorModel
    root: FloatArray
    first: FloatArray

    def filtered(self, values: FloatArray) -> FloatArray:
        """Return filtered rows of a stretch, (n_y, m, n_samples).

        The first samples are whitened by their covariance, so that none is lost and the likelihood is exact.
        """
        n_y, m, n = values.shape
        p = min(self.model.order, n)
        result = values[:, :, p:].copy()
        for lag, a in enumerate(self.model.coefficients[: n - p if p < self.model.order else p], 1):
            result -= np.tensordot(a, values[:, :, p - lag : n - lag], 1)
        result = scipy.linalg.solve_triangular(self.root, result.reshape(n_y, -1), lower=True).reshape(result.shape)
        rows = values[:, :, :p].transpose(2, 0, 1).reshape(p * n_y, m)
        begin = scipy.linalg.solve_triangular(self.first[: p * n_y, : p * n_y], rows, lower=True) if p else rows
        return np.concatenate([begin.reshape(p, n_y, m).transpose(1, 2, 0), result], axis=2)

    def log_det(self, n: int) -> float:
        """Return the log-determinant of the errors' covariance over `n` samples."""
        n_y = len(self.root)
        p = min(self.model.order, n)
        roots = np.concatenate([np.diag(self.first)[: p * n_y], np.tile(np.diag(self.root), n - p)])
        return float(2 * np.log(roots).sum())


def whitening(model: ErrorModel, n_samples: int) -> Whitening:
    """Return the whitening filter of an error model for a record of a given number of samples.

    Least squares can give an autoregression with a pole outside of the unit circle. A record says nothing of memory
    longer than itself, so all poles are drawn in to a memory of its length at most.
    """
    n_y, order = len(model.innovation), model.order
    size = order * n_y
    root = np.asarray(np.linalg.cholesky(model.innovation), float)
    if not order:
        return Whitening(model, root, np.zeros((0, 0)))
    companion = np.eye(size, k=-n_y)
    companion[:n_y] = model.coefficients.transpose(1, 0, 2).reshape(n_y, size)
    shrink = min(1.0, (1 - 1 / n_samples) / float(np.abs(np.linalg.eigvals(companion)).max()))
    lags = shrink ** np.arange(1, order + 1)
    model = ErrorModel(model.coefficients * lags[:, None, None], model.innovation)
    companion[:n_y] *= np.repeat(lags, n_y)
    drive = np.zeros((size, size))
    drive[:n_y, :n_y] = model.innovation
    latest_first = scipy.linalg.solve_discrete_lyapunov(companion, drive, method="bilinear")
    blocks = latest_first.reshape(order, n_y, order, n_y)[::-1, :, ::-1]
    first = blocks.reshape(size, size)
    return Whitening(model, root, np.asarray(np.linalg.cholesky((first + first.T) / 2), float))


def whitened(record: RecordSensitivities, filter_: Whitening) -> RecordSensitivities:
    """Return a record with whitened errors and sensitivities; the filter restarts after a left-out stretch."""
    both = np.concatenate([record.psi, record.errors.T[:, None]], axis=1)
    for some in _stretches(record.counted):
        both[:, :, some] = filter_.filtered(both[:, :, some])
    return record._replace(psi=both[:, :-1], errors=np.ascontiguousarray(both[:, -1].T))


def log_likelihood(record: RecordSensitivities, filter_: Whitening) -> float:
    """Return the Gaussian log-likelihood of the errors of a whitened record."""
    n, n_y = int(record.counted.sum()), record.errors.shape[1]
    spread = sum(filter_.log_det(some.stop - some.start) for some in _stretches(record.counted))
    return float(-0.5 * (n * n_y * np.log(2 * np.pi) + spread + (record.errors**2).sum()))


def _stretches(counted: BoolArray) -> list[slice]:
    """Return the stretches in which all samples are in the cost."""
    edges = [0, *(np.flatnonzero(np.diff(counted)) + 1).tolist(), len(counted)]
    return [slice(a, b) for a, b in pairwise(edges) if counted[a]]


# ---- Covariance of the gradient for coloured errors.

_ROUNDS = 2  # rounds in which the part of the errors that the fit took away is given back
_LEAST = 0.1  # part of the covariance of the gradient that feedback of errors leaves at least
_APART = 4096  # samples, beyond which errors are not correlated
_AT_ONCE = 4096  # frequencies whose products are made together, in memory that is soon used again
_LONG = 10_000  # samples of a record for which this part is negligible
_ROOM = 32 * 2**20  # bytes of transforms of shorter records that are held between the rounds; others are made again


def score_covariance(
    transforms: Sequence[Transform], weight: FloatArray, root: FloatArray, information: FloatArray | None = None
) -> tuple[FloatArray, list[ErrorModel]]:
    """Return the covariance of ``sum psi' W e`` for coloured errors with the spectrum of the residuals.

    Parameters
    ----------
    transforms : sequence of Transform
        Residuals of each record, and the transform of its sensitivities; may be an `OnDemand`.
    weight : (n_y, n_y) array
        Weight W of the errors.
    root : (n_kept, n) array
        Root R of the inverse of the Gauss-Newton Hessian, ``R R' = H^-1``.
    information : (n_kept, n_kept) array, optional
        Receives the information of generalised least squares with these models.

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
    n_kept = len(root)
    models, short, room = list[ErrorModel](), dict[int, tuple[Transform, FloatArray, int] | None](), _ROOM
    long, total = np.zeros((2, 2, n_kept, n_kept))  # of sensitivities as they are, and what feedback of errors changes
    for i in range(len(transforms)):
        transform = transforms[i]
        products, count = _products(transform)
        models.append(error_model(products, count))
        if len(transform.errors) > _LONG:
            _add(long, transform, models[i], weight)
            if information is not None:
                _add_information(information, transform, models[i])
        else:
            _add(total, transform, models[i], weight)
            room -= transform.psi.nbytes + products.nbytes
            short[i] = (transform, products, count) if room > 0 else None
    for again in range(_ROUNDS if short else 0):
        C = root @ _joined(long + total, root) @ root.T
        total[:] = 0.0
        for i, kept in short.items():
            if kept is None:
                transform = transforms[i]
                products, count = _products(transform)
            else:
                transform, products, count = kept
            models[i] = error_model(products + _taken(transform, C, len(products) - 1), count)
            _add(total, transform, models[i], weight)
            if information is not None and again == _ROUNDS - 1:
                _add_information(information, transform, models[i])
    return _joined(long + total, root), models


def error_models(
    transforms: Iterable[Transform], C: FloatArray, orders: Sequence[int] | None = None
) -> list[ErrorModel]:
    """Return the error model of each record, corrected for the degrees of freedom that the fit used.

    Parameters
    ----------
    transforms : iterable of Transform
        Residuals of each record, and the transform of its sensitivities.
    C : (n_kept, n_kept) array
        Covariance of the estimates.
    orders : sequence of int, optional
        Orders, in place of those of Akaike's criterion.
    """
    models = []
    for i, transform in enumerate(transforms):
        products, count = _products(transform)
        if len(transform.errors) <= _LONG:
            products = products + _taken(transform, C, len(products) - 1)
        models.append(error_model(products, count, None if orders is None else orders[i]))
    return models


def _joined(total: FloatArray, root: FloatArray) -> FloatArray:
    """Return the covariance of the gradient: linear plus feedback term, limited to stay positive definite.

    The sum is a covariance where the residuals are what their model says. At a point that is no minimum they are not.
    """
    linear = root.T @ total[0] @ root
    if not np.isfinite(linear).all():
        raise np.linalg.LinAlgError("the covariance of the gradient overflows")
    if not total[1].any():
        return np.asarray(linear)
    change = root.T @ total[1] @ root
    share, axes = scipy.linalg.eigh(change, linear + 1e-12 * np.trace(linear) * np.eye(len(linear)))
    onto = linear @ axes
    return np.asarray(linear + (onto * np.maximum(share, _LEAST - 1)) @ onto.T)


Value = TypeVar("Value")


@dataclass(frozen=True)
class OnDemand(Sequence[Value]):
    """Sequence of values computed at each access, to save memory."""

    make: Callable[[int], Value]
    size: int

    def __len__(self) -> int:
        return self.size

    def __getitem__(self, i: Any) -> Any:
        return self.make(range(self.size)[i])


class Transform(NamedTuple):
    """Errors of a record, and the Fourier transform of its prediction sensitivities.

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
    """Return the Fourier transform of the sensitivities to the estimated unknowns, `kept` (n_kept,)."""
    place = np.searchsorted(kept, record.columns)
    chosen = np.flatnonzero(kept[np.minimum(place, len(kept) - 1)] == record.columns)
    n = len(record.errors)
    size = scipy.fft.next_fast_len(n + min(n, _APART), real=True)
    psi = record.psi if len(chosen) == len(place) else record.psi[:, chosen]
    feedback = None
    if record.feedback is not None:
        v, columns = record.feedback
        which = np.flatnonzero(np.isin(columns, chosen))
        feedback = v, which, place[columns[which]]
    spectrum = np.fft.rfft(psi, size)  # pads row by row; that of scipy copies all rows first
    return Transform(spectrum, place[chosen], size, feedback, record.errors, record.counted)


def _products(record: Transform) -> tuple[FloatArray, int]:
    """Return lag products of residuals over the stretches in the cost, at all pairs of lags."""
    stretches = [record.errors[some] for some in _stretches(record.counted)]
    longest = longest_order(int(record.counted.sum()), record.errors.shape[1])
    longest = min(longest, max(map(len, stretches)) // 2)
    return lag_products(stretches, longest)


def _add(total: FloatArray, transform: Transform, model: ErrorModel, weight: FloatArray) -> None:
    """Add a record's contribution to the covariance of the gradient."""
    psi, columns, size = transform.psi, transform.columns, transform.size
    products = np.zeros((len(columns), len(columns)))
    factors = _weighted(model, weight, size)
    for first in range(0, psi.shape[2], _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        for row in factors[:, :, some]:
            parts = _filtered(psi[:, :, some], row).view(float)
            products += parts @ parts.T
    total[0][np.ix_(columns, columns)] += 2 / size * products
    if transform.feedback is not None and model.order:
        v, which, places = transform.feedback
        term = feedback_term(v, model, weight)
        if term is not None:
            total[1][np.ix_(places, places)] += transform.counted.sum() * term[np.ix_(which, which)]


def _add_information(total: FloatArray, transform: Transform, model: ErrorModel) -> None:
    """Add a record's information in generalised least squares, without its first samples."""
    psi, columns, size, n = transform.psi, transform.columns, transform.size, len(transform.errors)
    n_y = len(psi)
    lags = np.concatenate([np.eye(n_y)[None], -model.coefficients])
    inverse_root = scipy.linalg.solve_triangular(np.linalg.cholesky(model.innovation), np.eye(n_y), lower=True)
    whitened = inverse_root @ scipy.fft.rfft(lags, size, axis=0)
    for row in whitened.transpose(1, 2, 0):
        filtered = scipy.fft.irfft(_filtered(psi, row), size)[:, model.order : n]
        total[np.ix_(columns, columns)] += filtered @ filtered.T


def _filtered(psi: ComplexArray, row: ComplexArray) -> ComplexArray:
    """Return transforms (n_y, n_columns, n_f) times factors (n_y, n_f), summed over outputs."""
    total: ComplexArray = row[0] * psi[0]
    for factor, slopes in zip(row[1:], psi[1:], strict=True):
        total += factor * slopes
    return total


def _weighted(model: ErrorModel, weight: FloatArray, size: int) -> ComplexArray:
    """Return ``L* W`` at each frequency, (n_y, n_y, n_frequencies), with half the power at frequency zero."""
    weights = np.einsum("fba,bc->acf", model.root(size).conj(), weight, optimize=True)
    weights[:, :, 0] /= np.sqrt(2)
    if size % 2 == 0:
        weights[:, :, -1] /= np.sqrt(2)
    return np.asarray(weights)


def _taken(transform: Transform, C: FloatArray, longest: int) -> FloatArray:
    """Return expected lag products of the error part that the fit explained, at all pairs of lags."""
    psi, columns, size = transform.psi, transform.columns, transform.size
    scale = np.sqrt(np.maximum(np.diag(C)[columns], np.finfo(float).tiny))
    values, axes = np.linalg.eigh(C[np.ix_(columns, columns)] / np.outer(scale, scale))
    part = (scale[:, None] * axes * np.sqrt(np.maximum(values, 0.0))).T @ psi
    in_time = scipy.fft.irfft(part, size)[..., : len(transform.counted)].transpose(1, 2, 0)
    return lag_products([in_time[:, some] for some in _stretches(transform.counted)], longest)[0]
