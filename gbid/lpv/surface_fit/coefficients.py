"""Uncertain coefficients of surfaces: covariance of the parameters at a point, and random draws."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.extras import data_frame

_TRIES = 20  # largest number of draws for each requested model


def coefficient_frame(
    parameters: Sequence[str], terms: Sequence[str], coefficients: FloatArray, covariance: FloatArray
) -> Any:
    """Return coefficients as a pandas.DataFrame: a row for each parameter, for each term a column and one of its std.

    Raises
    ------
    UsageError
        When pandas is not installed.
    """
    std = np.sqrt(np.diag(covariance)).reshape(coefficients.shape)
    columns: dict[str, Any] = {"parameter": list(parameters)}
    for j, term in enumerate(terms):
        columns |= {term: coefficients[:, j], f"{term} std": std[:, j]}
    return data_frame(columns, index="parameter")


def covariance_at(terms: FloatArray, covariance: FloatArray, scatter: FloatArray | None = None) -> FloatArray:
    """Return the covariance of k parameters at operating points.

    Parameters
    ----------
    terms : (..., m) array
        Terms of the polynomials at the points.
    covariance : (k m, k m) array
        Covariance of the coefficients: parameters, for each its terms.
    scatter : (k, k) array, optional
        Covariance of the deviations of recordings, which is added.

    Returns
    -------
    (..., k, k) array
    """
    m = terms.shape[-1]
    k = len(covariance) // m
    found = np.einsum("...i,aibj,...j->...ab", terms, covariance.reshape(k, m, k, m), terms, optimize=True)
    return np.asarray(found if scatter is None else found + scatter)


def draws(
    coefficients: FloatArray,
    covariance: FloatArray,
    scatter: FloatArray | None,
    n: int,
    seed: int,
    accepts: Callable[[FloatArray], bool],
    refusal: tuple[str, str],
) -> list[FloatArray]:
    """Return n random coefficients (k, m) that are possible; others are rejected.

    Parameters
    ----------
    coefficients : (k, m) array
        Mean. The first term is the constant 1.
    covariance : (k m, k m) array
        Covariance of the coefficients.
    scatter : (k, k) array or None
        Covariance of the deviation of one recording, added to the constant term; None for none.
    n, seed : int
        Number of models, and seed of the random numbers.
    accepts : callable
        From coefficients to whether they are possible.
    refusal : (owner, what)
        What is drawn, and what most draws are not, with what to do; for the message.

    Raises
    ------
    UsageError
        When almost all draws are rejected.
    """
    rng = np.random.default_rng(seed)
    root = _root(covariance)
    lift = None if scatter is None else _root(scatter)

    def every() -> Iterator[FloatArray]:
        for _ in range(_TRIES * n):
            drawn = coefficients + (root @ rng.normal(size=root.shape[1])).reshape(coefficients.shape)
            if lift is not None:
                drawn[:, 0] += lift @ rng.normal(size=lift.shape[1])
            yield drawn

    found = list(islice(filter(accepts, every()), n))
    if len(found) < n:
        owner, what = refusal
        raise UsageError(f"{owner}: {len(found)} of {_TRIES * n} draws {what}")
    return found


def _root(covariance: FloatArray) -> FloatArray:
    """Return a matrix R with R R' equal to a covariance, which may be singular and badly scaled."""
    size = np.sqrt(np.diag(covariance))
    scale = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)) * scale[:, None])
