"""Attempts at a fit: other window lengths, and other start values where the first ones are unstable or lead astray."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import log

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.notes import FitNote
from gbid.identify.problem.hessian import in_one_window, in_windows, neighbours
from gbid.identify.problem.nlp import Shooting
from gbid.identify.problem.solve import Solution
from gbid.identify.result import FitResult
from gbid.identify.status import FitStatus

_GROWTH = 10.0
"""Largest growth of a model that counts as stable over a record, and that a shooting window may contain."""
_RUNAWAY = 1e3  # growth of the solution within a window at which the fit is repeated in shorter ones
_SHORTEST = 4  # samples in a window
_MOST_WINDOWS = 3000
_LOWER = 1e-3  # relative difference of losses that matters

Start = Mapping[str, float]


@dataclass(frozen=True)
class Attempt:
    """One attempt at a fit.

    Attributes
    ----------
    result : FitResult or None
        The result; None when the start is unstable and was to be stable.
    rate : float
        Largest growth of the predictor in a sample, at the solution, or at the start when there is no result.
    doubtful : bool
        Whether the residuals are so strongly correlated that this may be another minimum.
    """

    result: FitResult | None
    rate: float
    doubtful: bool


@dataclass(frozen=True)
class Plan:
    """How to make attempts.

    Attributes
    ----------
    attempt : callable
        ``attempt(start, window, gain_held, unstable)`` fits from start values in windows of this many samples.
        `gain_held` fixes the disturbance gain. Without `unstable` an unstable start is not fitted.
    settle : callable
        ``settle()`` returns start values of a fit with a steady observer; None when there is no observer.
    windows : tuple of int or None
        Lengths of the shooting windows to try in turn; the first one to converge is taken.
    adapts : bool
        Whether windows may become shorter for an unstable model.
    longest, n_samples : int
        Number of samples in the longest record, and in all.
    may_move : bool
        Whether start values may be replaced where the fit does not converge or may have found another minimum.
    """

    attempt: Callable[[Start, int | None, bool, bool], Attempt]
    settle: Callable[[], dict[str, float] | None]
    windows: tuple[int | None, ...]
    adapts: bool
    longest: int
    n_samples: int
    may_move: bool

    def bounded(self, rate: float) -> tuple[int | None, ...]:
        """Return the windows, shortened so that a model that grows at this rate grows tenfold in one."""
        if not (self.adapts and rate > 1):
            return self.windows
        most = max(_SHORTEST, int(log(_GROWTH) / log(rate))) if np.isfinite(rate) else _SHORTEST
        return tuple(dict.fromkeys(most if samples is None else min(samples, most) for samples in self.windows))

    def grows(self, rate: float) -> bool:
        """Return whether a predictor is unstable over the longest record."""
        return not log(max(rate, 1e-300)) * self.longest <= log(_GROWTH)


def best_attempt(plan: Plan, begin: Start) -> FitResult:
    """Return the result of the attempt that converges, else the one with the smallest loss; notes tell of the others.

    Parameters
    ----------
    plan : Plan
        How to make attempts.
    begin : dict of str to float
        Start values.
    """
    first = _in_turn(plan, begin, plan.windows, unstable=False)
    result = first.result
    if result is not None and plan.grows(first.rate):  # the plant is unstable, or a part of it went astray
        first = _shorter(plan, first)
        result = first.result
    if result is not None and (not plan.may_move or (result.success and not first.doubtful)):
        return result
    if result is not None and result.status is FitStatus.NOT_DETERMINED:
        return result
    moved = plan.settle()
    found = [first] if result is not None else []
    if moved is not None:
        other = _in_turn(plan, moved, plan.windows, unstable=False)
        if other.result is None:  # the plant itself is unstable
            other = _in_turn(plan, moved, plan.bounded(other.rate), unstable=True)
        elif plan.grows(other.rate):
            other = _shorter(plan, other)
        stable = "" if not plan.grows(other.rate) else ", and the plant is unstable as well"
        why = f"the start values are unstable{stable}: " if result is None else ""
        found.append(
            _noted(
                other,
                FitNote.BEGUN_ELSEWHERE(
                    f"{why}the fit began at values of a fit with a steady observer (Kalman filter)"
                ),
            )
        )
    good = [a for a in found if a.result is not None and a.result.success and not a.doubtful]
    if result is None and not good and plan.n_samples / _first(plan.bounded(first.rate)) < _MOST_WINDOWS:
        own = _in_turn(plan, begin, plan.bounded(first.rate), unstable=True)
        found.append(
            _noted(
                own,
                FitNote.WINDOWS_CHANGED("the start values are unstable: shooting windows were bounded by their growth"),
            )
        )
    return _lowest([a for a in found if a.result is not None], plan, begin)


def _first(windows: Sequence[int | None]) -> float:
    return np.inf if windows[0] is None else windows[0]


def _in_turn(plan: Plan, start: Start, windows: Sequence[int | None], *, unstable: bool) -> Attempt:
    """Return the first attempt in windows of these lengths that converges, else that with the smallest loss."""
    tried: list[Attempt] = []
    for samples in windows:
        made = plan.attempt(start, samples, False, unstable)
        if made.result is None:
            return made
        tried.append(made)
        if made.result.success:
            break
        if made.result.status is FitStatus.UNSTABLE_PREDICTOR and len(windows) > 1:
            held = plan.attempt(start, samples, True, True)
            if held.result is None:
                return made
            status = FitStatus.CONVERGED_GAIN_HELD if held.result.success else held.result.status
            note = "a free disturbance gain led to an almost unstable predictor: it is fixed at its start value"
            return _noted(replace(held, result=replace(held.result, status=status)), FitNote.GAIN_HELD(note))
    best = tried[-1]
    if best.result is not None and not best.result.success:
        best = min(tried, key=lambda a: a.result.loss if a.result and np.isfinite(a.result.loss) else np.inf)
    if len(tried) == 1:
        return best
    others = ", ".join(str(a.result.options.window) for a in tried if a.result and a is not best)
    length = best.result.options.window if best.result else None
    return _noted(
        best, FitNote.WINDOWS_CHANGED(f"windows of {others} samples did not converge; this is the result with {length}")
    )


def _shorter(plan: Plan, made: Attempt) -> Attempt:
    """Return a fit from a solution that grows, in windows that bound its growth; the solution where it is no better."""
    result = made.result
    if result is None or not plan.adapts or not np.isfinite(made.rate):
        return made
    length = plan.longest if result.options.window is None else result.options.window
    if log(made.rate) * length <= log(_RUNAWAY):
        return made
    windows = plan.bounded(made.rate)
    own = {name: v for name, v in result.parameters.items() if "[" not in name}
    again = plan.attempt({**result.start, **own}, windows[0], False, True)
    if again.result is None or not (again.result.success or again.result.loss < result.loss):
        return made
    return _noted(again, FitNote.WINDOWS_CHANGED("the model is unstable: shooting windows were bounded by its growth"))


def _lowest(found: Sequence[Attempt], plan: Plan, begin: Start) -> FitResult:
    """Return the lowest result of those that converged, else the lowest; notes tell of one that is lower still."""
    if not found:  # no observer, and too many windows for the start itself
        found = [plan.attempt(begin, plan.windows[0], False, True)]
    made = [(a, a.result) for a in found if a.result is not None]
    finite = [(a, r) for a, r in made if np.isfinite(r.loss)] or made
    lowest = min(finite, key=lambda pair: pair[1].loss)
    converged = [pair for pair in finite if pair[1].success]
    best = min(converged, key=lambda pair: pair[1].loss) if converged else lowest
    notes: list[str] = []
    if best[1].loss > lowest[1].loss + _LOWER * abs(lowest[1].loss):
        text = f"another attempt ended lower, at a loss of {lowest[1].loss:.6g}, but did not converge"
        notes.append(FitNote.OTHER_MINIMUM(text))
    if best[1].success and best[0].doubtful:
        notes.append(
            FitNote.OTHER_MINIMUM(
                "neighbouring residuals are strongly correlated: this may be a minimum that is not the lowest; try "
                "other start values (fit_multistart)"
            )
        )
    return replace(best[1], notes=(*best[1].notes, *notes))


def _noted(made: Attempt, note: str) -> Attempt:
    if made.result is None:
        return made
    return replace(made, result=replace(made.result, notes=(*made.result.notes, note)))


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
