"""Polynomial in pressure and speed for each key parameter (paper, Eq. 16)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.structure.scheduling.monomials import EXPONENTS, SCHEDULING, TERMS

__all__ = ["EXPONENTS", "SCHEDULING", "TERMS", "basis", "polynomial", "regressors"]


def basis(pressure_bar: Any, speed_rpm: Any) -> tuple[Any, ...]:
    """Return the values of the six terms of Eq. 16.

    Parameters
    ----------
    pressure_bar, speed_rpm : float, array or CasADi symbol
        Injection pressure P [bar] and rotational speed Omega [rpm]; arrays broadcast against each other.

    Returns
    -------
    tuple
        Terms in the order of `TERMS`, each of the type of the arguments; the first is the number 1.
    """
    return tuple(_power(pressure_bar, i) * _power(speed_rpm, j) for i, j in EXPONENTS)


def regressors(pressure_bar: npt.ArrayLike, speed_rpm: npt.ArrayLike) -> FloatArray:
    """Return the terms as columns of the regression matrix of Eq. 16.

    Parameters
    ----------
    pressure_bar, speed_rpm : (n_points,) array
        Operating points [bar], [rpm].

    Returns
    -------
    (n_points, 6) array
        Columns in the order of `TERMS`.
    """
    P, Omega = np.broadcast_arrays(np.asarray(pressure_bar, float), np.asarray(speed_rpm, float))
    return np.stack([term * np.ones(P.shape) for term in basis(P, Omega)], axis=-1)


def polynomial(coefficients: Sequence[Any] | FloatArray, terms: Sequence[Any]) -> Any:
    """Return the sum of coefficients times terms.

    Parameters
    ----------
    coefficients : sequence of 6
        Coefficients in the order of `TERMS`; numbers or symbols.
    terms : sequence of 6
        Terms from `basis`.

    Returns
    -------
    float, array or CasADi expression
        Value of the polynomial.

    Raises
    ------
    UsageError
        When the numbers of coefficients and terms differ.
    """
    if len(coefficients) != len(terms):
        raise UsageError(f"{len(coefficients)} coefficients for {len(terms)} terms ({', '.join(TERMS)})")
    return sum(c * t for c, t in zip(coefficients, terms, strict=True))


def _power(variable: Any, exponent: int) -> Any:
    """Return a small power by products, which keep the type of the variable; exponent 0 gives the float 1."""
    result: Any = 1.0
    for _ in range(exponent):
        result = result * variable
    return result
