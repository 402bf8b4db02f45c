"""Terms over pressure and speed as well-conditioned regressors, and whether operating points determine them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import DataError, UsageError
from gbid.lpv.basis import EXPONENTS, TERMS

Exponents = tuple[tuple[int, int], ...]
HIGHEST_ORDER = 3  # highest order that is compared; the model itself has the six terms of Eq. 16 only
_DARK = 1e-9  # terms are not determined when a singular value is below this share of the largest


class Orthonormal(NamedTuple):
    """Regressors made orthogonal over the operating points.

    Attributes
    ----------
    columns : (n_points, n_terms) array
        Regressors of mean square one, orthogonal to each other.
    back : (n_terms, n_terms) array
        ``coefficients of the terms in bar and rpm = back @ coefficients of the columns``.
    """

    columns: FloatArray
    back: FloatArray


def exponents_of(order: int) -> Exponents:
    """Return the powers of (P, Omega) up to a total order; up to order 2 in the order of `gbid.lpv.TERMS`."""
    higher = [(i, total - i) for total in range(3, order + 1) for i in range(total, -1, -1)]
    return (*(e for e in EXPONENTS if sum(e) <= order), *higher)


def chosen_exponents(order: int | Sequence[str]) -> Exponents:
    """Return the powers of (P, Omega) of an order 0 to 2, or of terms by name.

    Raises
    ------
    UsageError
        When the model does not have this order or term.
    """
    if isinstance(order, int):
        if isinstance(order, bool) or not 0 <= order <= 2:
            raise UsageError(f"order = {order}; choose 0, 1, 2, 'auto', or terms out of {', '.join(TERMS)}")
        return exponents_of(order)
    names = (order,) if isinstance(order, str) else tuple(order)
    unknown = [name for name in names if name not in TERMS]
    if unknown or not names or len(set(names)) < len(names):
        problem = f"{unknown[0]!r} is not a term" if unknown else "give each term once, and at least one"
        raise UsageError(f"order = {order!r}: {problem}; there are {', '.join(TERMS)}, or 0, 1, 2, 'auto'")
    return tuple(EXPONENTS[TERMS.index(name)] for name in sorted(names, key=TERMS.index))


def monomials(points: FloatArray, exponents: Exponents) -> FloatArray:
    """Return the columns ``P^i Omega^j`` of points (n, 2) in bar and rpm, shape (n, n_terms)."""
    return np.stack([points[:, 0] ** i * points[:, 1] ** j for i, j in exponents], axis=-1)


def orthonormal(points: FloatArray, exponents: Exponents) -> Orthonormal:
    """Return terms that are orthogonal over the points, because the numbers in bar and rpm differ by large factors.

    Parameters
    ----------
    points : (n, 2) array
        Pressure [bar] and speed [rpm].
    exponents : tuple of (int, int)
        Powers of (P, Omega) of each term.

    Returns
    -------
    Orthonormal

    Raises
    ------
    DataError
        When there are fewer operating points than terms, or when they do not determine the terms.
    """
    check_points(points, exponents)
    raw = monomials(points, exponents)
    size = np.linalg.norm(raw, axis=0)
    Q, R = np.linalg.qr(raw / size)
    sign = np.where(np.diag(R) < 0, -1.0, 1.0)
    root = np.sqrt(len(points))
    back = np.linalg.solve(R, np.eye(len(R))) * (sign * root) / size[:, None]
    return Orthonormal(Q * (sign * root), back)


def check_points(points: FloatArray, exponents: Exponents) -> None:
    """Refuse operating points that do not determine the terms; see `orthonormal`."""
    names = [term_name(e) for e in exponents]
    distinct = distinct_points(points)
    if len(distinct) < len(exponents):
        raise DataError(
            f"{len(distinct)} operating points for {len(exponents)} terms ({', '.join(names)}); "
            "add operating points or choose a lower order"
        )
    raw = monomials(distinct, exponents)
    size = np.linalg.norm(raw, axis=0)
    empty = [name for name, s in zip(names, size, strict=True) if s == 0]
    if empty:
        raise DataError(
            f"operating points: some terms are zero at all of them: {', '.join(empty)}; add points or leave these "
            "terms out"
        )
    _, s, vectors = np.linalg.svd(raw / size)
    dark = vectors[s < _DARK * s[0]]
    if len(dark):
        involved = np.abs(dark).max(axis=0)
        together = ", ".join(name for name, v in zip(names, involved, strict=True) if v > 1e-3)
        levels = "; ".join(
            f"{len(np.unique(distinct[:, i]))} {what} ({', '.join(f'{v:g}' for v in np.unique(distinct[:, i])[:8])})"
            for i, what in enumerate(("pressures", "speeds"))
        )
        raise DataError(
            f"operating points do not determine {together} separately: there are {levels}; "
            "add operating points or choose a lower order"
        )


def distinct_points(points: FloatArray) -> FloatArray:
    """Return the distinct operating points, (n_distinct, 2), sorted by pressure, then speed."""
    return np.unique(points, axis=0)


def term_name(exponent: tuple[int, int]) -> str:
    """Return the name of a term, as in `gbid.lpv.TERMS`."""
    if exponent in EXPONENTS:
        return TERMS[EXPONENTS.index(exponent)]
    letters = zip(("P", "Omega"), exponent, strict=True)
    return " ".join(f"{letter}^{power}" if power > 1 else letter for letter, power in letters if power)
