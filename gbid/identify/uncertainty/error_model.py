"""Autoregressive model of residuals: their colour, exactly and without a longest lag."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.linalg import cho_factor, solve_triangular

from gbid.arrays import FloatArray

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
        """Return factors L of the spectrum, ``S = L L*``, at the frequencies of a real transform of `size` samples.

        Returns
        -------
        (size // 2 + 1, n_y, n_y) complex array
            ``L = (1 - sum_i a[i] exp(-j w i))^-1 chol(innovation)``.
        """
        n_y = len(self.innovation)
        lags = np.concatenate([np.eye(n_y)[None], -self.coefficients])
        return np.asarray(np.tensordot(_inverses(rfft(lags, size, axis=0)), np.linalg.cholesky(self.innovation), 1))

    def spectrum(self, frequencies: FloatArray) -> FloatArray:
        """Return the spectrum at frequencies (n,) in radians per sample, (n, n_y, n_y) complex."""
        lags = np.concatenate([np.eye(len(self.innovation))[None], -self.coefficients])
        turns = np.vander(np.exp(-1j * frequencies), len(lags), increasing=True)
        root = np.tensordot(_inverses(np.tensordot(turns, lags, 1)), np.linalg.cholesky(self.innovation), 1)
        return np.asarray(root @ root.conj().transpose(0, 2, 1))


def longest_order(n_samples: int, n_y: int) -> int:
    """Return the largest order that is tried for so many samples."""
    return int(np.clip(n_samples // (_SAMPLES_A_COEFFICIENT * n_y), 0, _LONGEST))


def lag_products(stretches: list[FloatArray], longest: int) -> tuple[FloatArray, int]:
    """Return ``sum_k e[k-i] e[k-j]'`` for all pairs of lags up to the longest, over stretches without a gap.

    Parameters
    ----------
    stretches : list of (n_samples, n_y) array
        Residuals; stretches that are not longer than `longest` do not count.
    longest : int
        Largest lag.

    Returns
    -------
    (longest + 1, longest + 1, n_y, n_y) array
        The sums, each over the same samples k.
    int
        Number of these samples.
    """
    n_y = stretches[0].shape[1]
    total, count = np.zeros((longest + 1, longest + 1, n_y, n_y)), 0
    for e in stretches:
        n = len(e)
        if n <= longest:
            continue
        M = np.empty_like(total)
        size = next_fast_len(n + longest, real=True)
        now, all_of = (
            rfft(np.ascontiguousarray(part.T), size) for part in (np.pad(e[longest:], ((longest, 0), (0, 0))), e)
        )
        M[0] = irfft(now[:, None] * all_of.conj(), size)[:, :, : longest + 1].transpose(2, 0, 1)
        first, last = e[longest - 1 :: -1] if longest else e[:0], e[: n - longest - 1 : -1] if longest else e[:0]
        M[1:, 0] = M[0, 1:].transpose(0, 2, 1)
        # One lag more in both: one sample enters in front, and one leaves at the end.
        every = np.stack([first.ravel(), last.ravel()])
        for i, signed in enumerate(np.stack([first, -last], axis=2)):
            change = (signed @ every).reshape(n_y, longest, n_y).transpose(1, 0, 2)
            np.add(M[i, :-1], change, out=M[i + 1, 1:])
        total, count = total + M, count + n - longest
    return total, count


def error_model(products: FloatArray, count: int) -> ErrorModel:
    """Return the model by least squares, its order by the corrected criterion of Akaike.

    Parameters
    ----------
    products : (longest + 1, longest + 1, n_y, n_y) array
        Sums from `lag_products`.
    count : int
        Number of samples in the sums.

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
        factor = cho_factor(past, lower=True)[0]
        whitened = solve_triangular(factor, present, lower=True)
        explained = np.cumsum(np.einsum("mka,mkb->mab", *2 * [whitened.reshape(longest, n_y, n_y)]), axis=0)
        covariances += list((products[0, 0] - explained) / count)
    orders = np.arange(longest + 1)
    spare = count - n_y * (orders + 1) - 1
    _, logs = np.linalg.slogdet(np.array(covariances))
    with np.errstate(invalid="ignore"):
        criterion = count * logs + 2 * orders * n_y**2 * count / np.maximum(spare, 1e-3)
    order = int(np.nanargmin(np.where(np.isfinite(criterion), criterion, np.inf)))
    k = order * n_y
    solved = solve_triangular(factor[:k, :k], whitened[:k], lower=True, trans="T") if order else whitened[:0]
    return ErrorModel(solved.reshape(order, n_y, n_y).transpose(0, 2, 1), covariances[order])


def _inverses(matrices: FloatArray) -> FloatArray:
    """Return the inverses of many small matrices; those of one or two rows written out."""
    n = matrices.shape[-1]
    if n == 1:
        return 1 / matrices
    if n > 2:
        return np.asarray(np.linalg.inv(matrices))
    (a, b), (c, d) = matrices.transpose(1, 2, 0)
    return np.asarray((np.array([[d, -b], [-c, a]]) / (a * d - b * c)).transpose(2, 0, 1))
