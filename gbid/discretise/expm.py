"""Matrix exponential and its integrals, symbolic or numeric, by one algorithm.

With ``phi_1(Z) = int_0^1 e^(Z s) ds`` and ``phi_2(Z) = int_0^1 (1 - s) e^(Z s) ds``, the response of
``xd = A x + B u`` over one sample consists of ``e^(A h)``, ``h phi_1(A h) B`` and ``h phi_2(A h) B``.
All three follow from one Taylor polynomial of ``phi_2`` at ``Z / 2^s`` and `s` doublings:

    phi_1 = I + Z phi_2,   e^Z = I + Z phi_1,
    phi_2(2 Z) = (phi_1(Z)^2 + 2 phi_2(Z)) / 4,   phi_1(2 Z) = (e^Z + I) phi_1(Z) / 2.

The number of doublings must be known when a symbolic graph is built. It is therefore computed before from numeric
samples of the matrix, after Al-Mohy and Higham (2009), from the norms of powers of the balanced matrix. These norms
depend on the fastest pole and not on the scaling of the states.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import factorial, prod
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.linalg.lapack import dgebal

from gbid.arrays import FloatArray
from gbid.discretise.dual import Dual

TAYLOR_ORDER = 15  # 1 / 18! is below the rounding of a double, so this order suffices when the norm is at most one
_BLOCK = 4  # Paterson-Stockmeyer: powers up to Z^4, then Horner in Z^4


class Exponentials(NamedTuple):
    """Exponential of ``Z`` and its first two integrals, each (n, n)."""

    exp: Any
    phi1: Any
    phi2: Any


def _identity_like(Z: Any) -> Any:
    return ca.SX.eye(Z.shape[0]) if isinstance(Z, ca.SX) else np.eye(Z.shape[0])


def exponentials(Z: Any, squarings: int) -> Exponentials:
    """Return ``e^Z``, ``phi_1(Z)`` and ``phi_2(Z)``.

    Parameters
    ----------
    Z : (n, n) casadi.SX, numpy array or Dual
        The matrix, already multiplied by the sample time.
    squarings : int
        Number of doublings, from `squarings_for`.

    Returns
    -------
    Exponentials
        Of the same type as `Z`.
    """
    eye = _identity_like(Z)
    Z = Z / 2.0**squarings
    powers = [eye, Z]
    for _ in range(2, _BLOCK + 1):
        powers.append(powers[-1] @ Z)
    coefficients = [1.0 / factorial(k + 2) for k in range(TAYLOR_ORDER + 1)]
    blocks = [
        _weighted_sum(coefficients[start : start + _BLOCK], powers) for start in range(0, TAYLOR_ORDER + 1, _BLOCK)
    ]
    phi2 = blocks[-1]
    for block in reversed(blocks[:-1]):
        phi2 = block + powers[_BLOCK] @ phi2
    phi1 = eye + Z @ phi2
    exp = eye + Z @ phi1
    for _ in range(squarings):
        phi2 = (phi1 @ phi1 + 2.0 * phi2) / 4.0
        phi1 = (exp + eye) @ phi1 / 2.0
        exp = exp @ exp
    return Exponentials(exp, phi1, phi2)


def _weighted_sum(weights: list[float], matrices: list[Any]) -> Any:
    total = weights[0] * matrices[0]
    for weight, matrix in zip(weights[1:], matrices[1:], strict=False):
        total = total + weight * matrix
    return total


def each(Z: Any) -> FloatArray:
    """Return the values of a matrix or dual at all points, (n_points, n, n)."""
    value = np.asarray(Z.value if isinstance(Z, Dual) else Z, float)
    return value.reshape(prod(value.shape[:-2]), *value.shape[-2:])


def squarings_for(matrices: Iterable[FloatArray]) -> int:
    """Return the number of doublings that makes the Taylor polynomial exact for all given matrices.

    Parameters
    ----------
    matrices : iterable of (n, n) arrays
        Samples of ``A h``: at the start values, at bounds, wherever the graph will be evaluated.

    Returns
    -------
    int
        The largest number that any of them needs.
    """
    return max((_squarings(np.asarray(Z, float)) for Z in matrices), default=0)


def _squarings(Z: FloatArray) -> int:
    if Z.size == 0 or not np.isfinite(Z).all():
        return 0
    Z = dgebal(Z, scale=1)[0]
    squared = Z @ Z
    power = squared @ squared
    reach = max(_norm(power) ** (1 / 4), _norm(power @ Z) ** (1 / 5))
    return max(0, int(np.ceil(np.log2(reach)))) if 0 < reach < np.inf else 0  # beyond, the exponential overflows


def _norm(Z: FloatArray) -> float:
    return float(np.abs(Z).sum(axis=0).max())
