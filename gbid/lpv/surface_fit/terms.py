"""Terms over the scheduling variables as well-conditioned regressors, and whether operating points determine them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import DataError, UsageError
from gbid.structure.scheduling.monomials import SCHEDULING, Exponents, exponents_of, monomials, term_name

Order = int | Literal["auto"] | Sequence[str]
HIGHEST_ORDER = 3  # highest order that is compared; the model of a gas bearing has the six terms of Eq. 16 only
_PLURAL = dict(zip(SCHEDULING, ("pressures", "speeds"), strict=True))
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


def varying_exponents(points: FloatArray, order: int) -> Exponents:
    """Return the powers up to an order, without those of a variable that is the same at all points (n, n_variables)."""
    fixed = np.ptp(points, axis=0) == 0
    powers = exponents_of(order, points.shape[1])
    return tuple(e for e in powers if not any(power and fixed[i] for i, power in enumerate(e)))


def possible_order(points: FloatArray, scheduling: Sequence[str] = SCHEDULING) -> int | tuple[str, ...]:
    """Return the highest order up to 2 that operating points determine, as the argument ``order`` takes it.

    It is a list of terms where a variable is the same at all points. Where several vary, one more operating point
    than terms is asked for, because surfaces through all points would fit noise.
    """
    if not len(points):
        return 0
    varying = int((np.ptp(points, axis=0) > 0).sum())
    for order in (2, 1):
        exponents = varying_exponents(points, order)
        enough = len(exponents) + (varying > 1)
        if len(distinct_points(points)) >= enough > 1 and not _undetermined(points, exponents, scheduling):
            return order if varying == points.shape[1] else tuple(term_name(e, scheduling) for e in exponents)
    return 0


def order_words(order: int | Sequence[str]) -> str:
    """Return an order as it is written in YAML: ``2``, or ``["1", "P", "P^2"]``."""
    return str(order) if isinstance(order, int) else "[" + ", ".join(f'"{term}"' for term in order) + "]"


def chosen_exponents(order: int | Sequence[str], scheduling: Sequence[str] = SCHEDULING) -> Exponents:
    """Return the powers of the scheduling variables of an order, or of terms by name.

    Parameters
    ----------
    order : int or sequence of str
        Order 0 to 2 for a gas bearing, 0 to 3 for other scheduling variables, or names of terms.
    scheduling : sequence of str
        Names of the scheduling variables.

    Raises
    ------
    UsageError
        When there is no such order or term.
    """
    highest = 2 if tuple(scheduling) == SCHEDULING else HIGHEST_ORDER
    there = exponents_of(highest, len(scheduling))
    names = [term_name(e, scheduling) for e in there]
    orders = ", ".join(map(str, range(highest + 1)))
    if isinstance(order, int):
        if isinstance(order, bool) or not 0 <= order <= highest:
            raise UsageError(f"order = {order}; choose {orders}, 'auto', or terms out of {', '.join(names)}")
        return exponents_of(order, len(scheduling))
    chosen = (order,) if isinstance(order, str) else tuple(order)
    unknown = [name for name in chosen if name not in names]
    if unknown or not chosen or len(set(chosen)) < len(chosen):
        problem = f"{unknown[0]!r} is not a term" if unknown else "give each term once, and at least one"
        raise UsageError(f"order = {order!r}: {problem}; there are {', '.join(names)}, or {orders}, 'auto'")
    return tuple(there[names.index(name)] for name in sorted(chosen, key=names.index))


def orthonormal(points: FloatArray, exponents: Exponents, scheduling: Sequence[str] = SCHEDULING) -> Orthonormal:
    """Return terms that are orthogonal over the points, because the numbers in bar and rpm differ by large factors.

    Parameters
    ----------
    points : (n, n_variables) array
        Operating points.
    exponents : tuple of tuple of int
        Powers of the scheduling variables in each term.
    scheduling : sequence of str
        Names of the scheduling variables, for messages.

    Returns
    -------
    Orthonormal

    Raises
    ------
    DataError
        When there are fewer operating points than terms, or when they do not determine the terms.
    """
    check_points(points, exponents, scheduling)
    raw = monomials(points, exponents)
    size = np.linalg.norm(raw, axis=0)
    Q, R = np.linalg.qr(raw / size)
    sign = np.where(np.diag(R) < 0, -1.0, 1.0)
    root = np.sqrt(len(points))
    back = np.linalg.solve(R, np.eye(len(R))) * (sign * root) / size[:, None]
    return Orthonormal(Q * (sign * root), back)


def check_points(points: FloatArray, exponents: Exponents, scheduling: Sequence[str] = SCHEDULING) -> None:
    """Refuse operating points that do not determine the terms; see `orthonormal`."""
    why_not = _undetermined(points, exponents, scheduling)
    if why_not:
        order = order_words(possible_order(points, scheduling))
        raise DataError(f"{why_not}; add operating points, or choose a lower order, such as order: {order}")


def _undetermined(points: FloatArray, exponents: Exponents, scheduling: Sequence[str]) -> str:
    """Return why operating points do not determine the terms; an empty text when they do."""
    names = [term_name(e, scheduling) for e in exponents]
    distinct = distinct_points(points)
    if len(distinct) < len(exponents):
        return f"{len(distinct)} operating points for {len(exponents)} terms ({', '.join(names)})"
    raw = monomials(distinct, exponents)
    size = np.linalg.norm(raw, axis=0)
    empty = [name for name, s in zip(names, size, strict=True) if s == 0]
    if empty:
        return f"operating points: some terms are zero at all of them: {', '.join(empty)}"
    _, s, vectors = np.linalg.svd(raw / size)
    dark = vectors[s < _DARK * s[0]]
    if not len(dark):
        return ""
    involved = np.abs(dark).max(axis=0)
    together = ", ".join(name for name, v in zip(names, involved, strict=True) if v > 1e-3)
    levels = "; ".join(
        f"{len(np.unique(distinct[:, i]))} {what} ({', '.join(f'{v:g}' for v in np.unique(distinct[:, i])[:8])})"
        for i, what in enumerate(_PLURAL.get(name, f"values of {name}") for name in scheduling)
    )
    return f"operating points do not determine {together} separately: there are {levels}"


def distinct_points(points: FloatArray) -> FloatArray:
    """Return the distinct operating points, (n_distinct, 2), sorted by pressure, then speed."""
    return np.unique(points, axis=0)
