"""The polynomial in pressure and speed that every key parameter is: paper, Eq. 16."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.errors import UsageError

TERMS = ("1", "P", "Omega", "Omega P", "P^2", "Omega^2")
"""Terms in the order of the coefficients; P in bar, Omega in rpm."""

EXPONENTS = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2))
"""Powers of (P, Omega) of each term."""


def basis(pressure_bar: Any, speed_rpm: Any) -> tuple[Any, ...]:
    """Values of the six terms of Eq. 16.

    Parameters
    ----------
    pressure_bar, speed_rpm : float, array or CasADi symbol
        Injection pressure P [bar] and rotational speed Omega [rpm]; arrays broadcast against each other.

    Returns
    -------
    tuple
        In the order of `TERMS`, each of the kind of the arguments; the first is the number 1.
    """
    return tuple(_power(pressure_bar, i) * _power(speed_rpm, j) for i, j in EXPONENTS)


def regressors(pressure_bar: npt.ArrayLike, speed_rpm: npt.ArrayLike) -> FloatArray:
    """Terms as columns: the matrix of the least-squares problem behind Eq. 16.

    Parameters
    ----------
    pressure_bar, speed_rpm : (n_points,) array
        Operating points.

    Returns
    -------
    (n_points, 6) array
    """
    P, Omega = np.broadcast_arrays(np.asarray(pressure_bar, float), np.asarray(speed_rpm, float))
    return np.stack([term * np.ones(P.shape) for term in basis(P, Omega)], axis=-1)


def polynomial(coefficients: Sequence[Any] | FloatArray, terms: Sequence[Any]) -> Any:
    """Sum of coefficients times terms.

    Parameters
    ----------
    coefficients : sequence of 6
        In the order of `TERMS`; numbers or symbols.
    terms : sequence of 6
        What `basis` returns.

    Returns
    -------
    float, array or CasADi expression

    Raises
    ------
    UsageError
        When there are not as many coefficients as terms.
    """
    if len(coefficients) != len(terms):
        raise UsageError(f"{len(coefficients)} coefficients for {len(terms)} terms ({', '.join(TERMS)})")
    return sum(c * t for c, t in zip(coefficients, terms, strict=True))


def _power(variable: Any, exponent: int) -> Any:
    """Return a small power; products keep floats, arrays and symbols alike, and 0 gives a plain 1."""
    result: Any = 1.0
    for _ in range(exponent):
        result = result * variable
    return result
