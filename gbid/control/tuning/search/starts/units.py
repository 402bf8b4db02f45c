"""Units of the gains: by how much each gain must change to move the eigenvalues of the loops."""

from __future__ import annotations

import numpy as np

from gbid.arrays import ComplexArray, FloatArray
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.spectrum import eigenvalues

_MOVED = 0.5
"""Movement of an eigenvalue, in units of the typical rate, that a change of one unit causes."""
_DECADES = 9
_HALVINGS = 6


def gain_units(problem: GainProblem, x: FloatArray) -> FloatArray:
    """Return the change of each gain that moves an eigenvalue by about the typical rate.

    It is at most the width of the bounds. So bounds that are far too wide do not change where the search begins, or how
    long its first steps are. A gain that moves nothing by itself, as those in a product with a zero, is given the
    median of the others.

    Parameters
    ----------
    problem : GainProblem
        The design problem.
    x : (d,) array
        Gains from which the changes are counted.
    """
    width = problem.upper - problem.lower
    found = np.full(len(x), np.nan)
    places = [eigenvalues(family.states(x)) for family in problem.families]
    if any(np.isnan(values).any() for values in places):
        return width
    for i in range(len(x)):
        sign = 1.0 if problem.upper[i] - x[i] >= x[i] - problem.lower[i] else -1.0
        room = float(max(problem.upper[i] - x[i], x[i] - problem.lower[i]))

        def moved(change: float, i: int = i, sign: float = sign) -> float:
            y = x.copy()
            y[i] += sign * change
            return max(
                _movement(values, eigenvalues(family.states(y)), problem.scale)
                for values, family in zip(places, problem.families, strict=True)
            )

        if moved(room) < _MOVED:
            found[i] = width[i] if moved(room) > 1e-3 * _MOVED else np.nan
            continue
        low, high = np.log(room) - _DECADES * np.log(10), np.log(room)
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            low, high = (low, middle) if moved(float(np.exp(middle))) >= _MOVED else (middle, high)
        found[i] = np.exp(high)
    known = found[np.isfinite(found)]
    found = np.where(np.isfinite(found), found, np.median(known) if len(known) else np.inf)
    return np.asarray(np.minimum(found, width))


def _movement(before: ComplexArray, after: ComplexArray, scale: float) -> float:
    """Return the largest distance of a new eigenvalue from the nearest old one; infinite when it is not finite."""
    if np.isnan(after).any():
        return np.inf
    distance = np.abs(after[:, :, None] - before[:, None, :]).min(axis=2)
    return float(distance.max()) / scale
