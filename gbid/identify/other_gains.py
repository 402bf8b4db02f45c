"""Other minima of the disturbance gain: where errors are strongly coloured, the first one found need not be the lowest.

With errors that the structure cannot whiten (a stiffening film, process noise) the criterion has several minima, far
apart along the disturbance gain. At such a minimum a coarse grid of gains is looked over, all else held. Where the
criterion is lower already, the fit begins again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.nlp.hessian import neighbours
from gbid.identify.nlp.one_window import in_one_window, in_windows
from gbid.identify.nlp.shooting import Shooting
from gbid.identify.nlp.solver import Solution
from gbid.notes.fit_notes import FitNote

_STRONGLY = 0.5  # correlation of neighbouring errors
_MOST_GAINS = 4  # 16 combinations of signs
_ROUNDS = 3
FOUND = FitNote.OTHER_MINIMUM(
    "the criterion has several minima along the disturbance gain: this is the lowest of those met"
)
SUSPECTED = FitNote.OTHER_MINIMUM(
    "the criterion has several minima along the disturbance gain: another start did not converge to a lower one, but "
    "there may be one; try fit_multistart"
)


def lowest_of_several(
    problem: Shooting, first: Solution, box: tuple[FloatArray, FloatArray], again: Callable[[FloatArray], Solution]
) -> tuple[Solution, tuple[str, ...]]:
    """Solve again from other disturbance gains as long as that leads lower.

    Parameters
    ----------
    problem : Shooting
    first : Solution
    box : (n_unknowns,) array, (n_unknowns,) array
        Bounds of the unknowns, scaled.
    again : callable
        Solves the problem from a start.

    Returns
    -------
    Solution
        The lowest, with the iterations of all.
    tuple of str
        Notes for the reader.
    """
    notes: tuple[str, ...] = ()
    best, iterations = first, first.iterations
    for _ in range(_ROUNDS):
        start = lower_elsewhere(problem, best.unknowns, box) if best.status.success else None
        if start is None:
            break
        other = again(start)
        iterations += other.iterations
        if not (other.status.success and problem.at(other.unknowns).cost < problem.at(best.unknowns).cost):
            notes = (*notes, SUSPECTED)
            break
        best, notes = other, (FOUND,)
    return replace(best, iterations=iterations), notes


def strongly_coloured(problem: Shooting, unknowns: FloatArray) -> bool:
    """Return whether neighbouring errors are strongly correlated, as at a minimum that is not the lowest."""
    return not neighbours(problem, unknowns) < _STRONGLY


def lower_elsewhere(problem: Shooting, unknowns: FloatArray, box: tuple[FloatArray, FloatArray]) -> FloatArray | None:
    """Return a point of lower cost with another disturbance gain and all else as it is.

    Each gain is plus or minus the largest of them: sixteen points for the four gains of a bearing.

    Returns
    -------
    (n_unknowns,) array or None
        None where errors are not strongly coloured, or no point of the grid is lower.
    """
    lower, upper = box
    gains = [i for i in problem.noise if lower[i] < upper[i] and problem.prior.information[i] == 0]
    if not 0 < len(gains) <= _MOST_GAINS:
        return None
    if not strongly_coloured(problem, unknowns):
        return None
    joined, kept = in_one_window(problem)
    theta, starts = joined.unpack(unknowns[kept])
    values = joined.values(theta)
    least, found = joined.cost(joined.error_products(values, starts)), None
    size = np.abs(theta[gains]).max()
    for signs in product((-1.0, 1.0), repeat=len(gains)):
        moved = theta.copy()
        moved[gains] = np.clip(size * np.array(signs), *(edge[gains] * problem.theta_scale[gains] for edge in box))
        there = joined.valid_values(moved)
        cost = joined.cost(joined.error_products(there, starts)) if there is not None else np.inf
        if cost < least:
            least, found = cost, moved
    return None if found is None else in_windows(problem, joined, joined.pack(found, starts))
