"""Optimum of a posed problem: solved, from other disturbance gains too, with steps and weights that it needs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.notes import FitNote
from gbid.identify.pose import PosedProblem
from gbid.identify.problem.hessian import in_one_window, in_windows, neighbours
from gbid.identify.problem.integration import integrated_finely
from gbid.identify.problem.nlp import Shooting
from gbid.identify.problem.solve import Solution, solve
from gbid.identify.robust import Reweighted, reweighted_solution


@dataclass(frozen=True, eq=False)
class Optimum:
    """Solution of a posed problem.

    Attributes
    ----------
    problem : PosedProblem
        The problem.
    shooting : Shooting
        Its shooting problem, with as many steps of the integrator as the estimates need.
    solution : Solution
        Last iterate of the solver, with its status.
    integration_shift : (n_theta,) array or None
        How far the estimates move when the step of the integrator is halved; None for a linear structure.
    reweighted : Reweighted or None
        Weights of a robust loss; None for squared errors.
    notes : tuple of str
        Notes on other minima.
    """

    problem: PosedProblem
    shooting: Shooting
    solution: Solution
    integration_shift: FloatArray | None
    reweighted: Reweighted | None
    notes: tuple[str, ...]

    @property
    def rate(self) -> float:
        """Largest growth of the predictor in a sample."""
        return self.shooting.rate(*self.shooting.unpack(self.solution.unknowns))

    @property
    def strongly_coloured(self) -> bool:
        """Whether neighbouring errors are strongly correlated, as at a minimum that is not the lowest."""
        return strongly_coloured(self.shooting, self.solution.unknowns)


def minimise(problem: PosedProblem) -> Optimum:
    """Return the optimum of a posed problem.

    The disturbance gain begins anew where that leads lower; a nonlinear structure is integrated as finely as its
    estimates need; last come the weights of a robust loss.
    """
    options, loss, box = problem.task.options, problem.task.loss, problem.box

    def run(start: FloatArray, shooting: Shooting = problem.shooting) -> Solution:
        return solve(shooting, start, *box, options)

    solution, notes = lowest_of_several(problem, run(np.clip(problem.unknowns, *box)))
    shooting, solution, shift = integrated_finely(problem.shooting, solution, box, run)
    reweighted = None
    if loss is not None and solution.status.success:
        reweighted, solution = reweighted_solution(shooting, solution, loss, run)
    return Optimum(problem, shooting, solution, shift, reweighted, notes)


# ---- Other minima of the disturbance gain: where errors are strongly coloured, the first one found need not be the
# lowest.
#
# With errors that the structure cannot whiten (a stiffening film, process noise) the criterion has several minima, far
# apart along the disturbance gain. At such a minimum a coarse grid of gains is looked over, all else held. Where the
# criterion is lower already, the fit begins again.

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


def lowest_of_several(problem: PosedProblem, first: Solution) -> tuple[Solution, tuple[str, ...]]:
    """Return the lowest solution from other disturbance gains, as long as these lead lower, and notes.

    `first` is the solution from the start of the problem; the lowest has the iterations of all.
    """
    shooting, notes = problem.shooting, tuple[str, ...]()
    best, iterations = first, first.iterations
    for _ in range(_ROUNDS):
        start = lower_elsewhere(shooting, best.unknowns, problem.box) if best.status.success else None
        if start is None:
            break
        other = solve(shooting, start, *problem.box, problem.task.options)
        iterations += other.iterations
        if not (other.status.success and shooting.at(other.unknowns).cost < shooting.at(best.unknowns).cost):
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
