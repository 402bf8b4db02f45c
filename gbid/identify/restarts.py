"""Attempts at a fit: other window lengths, and other start values where the first ones are unstable or lead astray.

===  ===============================  ===============================  =====  ==========================================
no   start values                     windows                          gain   tried
===  ===============================  ===============================  =====  ==========================================
1    stated, or from the data         usual, half, four times as long  free   always, each where the last fails
1a   as 1                             as 1                             held   where its predictor is almost unstable
1b   solution of 1                    tenfold growth at most           free   where it runs away within its windows
2    of a fit with a steady observer  as 1, 1a, 1b                     free   where 1 is unstable, fails or is doubtful
2a   as 2                             tenfold growth at most           free   where the plant itself is unstable
3    as 1                             tenfold growth at most           free   where 1 is unstable and 2 is not good
===  ===============================  ===============================  =====  ==========================================

Each attempt looks for other minima along the disturbance gain as well (`gbid.identify.optimum`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import log

import numpy as np

from gbid.core.notes import FitNote
from gbid.identify.judge import judge
from gbid.identify.optimum import minimise
from gbid.identify.pose import FitTask
from gbid.identify.problem.assemble import automatic_window
from gbid.identify.result import FitResult
from gbid.identify.start.start import settled_start
from gbid.identify.status import FitStatus
from gbid.structure import kind_of, symbolic_matrices


@dataclass(frozen=True)
class Policy:
    """Limits that decide on further attempts.

    Attributes
    ----------
    growth : float
        Largest growth of a model that counts as stable over a record, and that a shooting window may contain: with
        more, the end of a window says nothing about its start.
    runaway : float
        Growth of a solution within its windows at which it is solved again in shorter ones.
    shortest : int
        Samples in the shortest window.
    most_windows : int
        Largest number of windows for an unstable start: each has its own states, and more take minutes.
    lower : float
        Relative difference of losses that a note tells.
    enough_iterations : int
        With fewer, what the caller wants is the way from the start, not another start.
    """

    growth: float = 10.0
    runaway: float = 1e3
    shortest: int = 4
    most_windows: int = 3000
    lower: float = 1e-3
    enough_iterations: int = 50


POLICY = Policy()


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
    doubtful: bool = False

    @property
    def good(self) -> bool:
        """Whether it converged, and to no doubtful minimum."""
        return self.result is not None and self.result.success and not self.doubtful

    def noted(self, note: str) -> Attempt:
        """Return the attempt with one more note."""
        if self.result is None:
            return self
        return replace(self, result=replace(self.result, notes=(*self.result.notes, note)))


def grows(rate: float, n_samples: int) -> bool:
    """Return whether a predictor that grows at this rate in a sample is unstable over so many samples."""
    return not log(max(rate, 1e-300)) * n_samples <= log(POLICY.growth)


def bounded(windows: Sequence[int | None], rate: float) -> tuple[int | None, ...]:
    """Return the windows, shortened so that a model that grows at this rate grows tenfold in one."""
    if not rate > 1:
        return tuple(windows)
    most = max(POLICY.shortest, int(log(POLICY.growth) / log(rate))) if np.isfinite(rate) else POLICY.shortest
    return tuple(dict.fromkeys(most if samples is None else min(samples, most) for samples in windows))


def best_attempt(task: FitTask) -> FitResult:
    """Return the result of the attempt that converges, else the one with the smallest loss; notes tell of others."""
    restarts, stated = Restarts(task), task.begin.values
    first = restarts.settled(restarts.in_turn(stated, restarts.windows))
    result = first.result
    may_restart = task.options.max_iterations >= POLICY.enough_iterations and (
        "data" not in task.begin.origin.values() or bool(task.begin.notes)
    )
    if result is not None and (first.good or not may_restart or result.status is FitStatus.NOT_DETERMINED):
        return result
    made = [first]
    if (start := restarts.observer_start()) is not None:
        other = restarts.in_turn(start, restarts.windows)
        if other.result is None:  # the plant itself is unstable
            other = restarts.in_turn(start, restarts.bounded(other.rate), unstable=True)
        else:
            other = restarts.settled(other)
        stable = ", and the plant is unstable as well" if restarts.grows(other.rate) else ""
        why = f"the start values are unstable{stable}: " if result is None else ""
        text = f"{why}the fit began at values of a fit with a steady observer (Kalman filter)"
        made.append(other.noted(FitNote.BEGUN_ELSEWHERE(text)))
    windows = restarts.bounded(first.rate)
    few = windows[0] is None or task.data.n_samples / windows[0] < POLICY.most_windows
    if result is None and few and not any(attempt.good for attempt in made):
        text = "the start values are unstable: shooting windows were bounded by their growth"
        made.append(restarts.in_turn(stated, windows, unstable=True).noted(FitNote.WINDOWS_CHANGED(text)))
    if all(attempt.result is None for attempt in made):  # no observer, and too many windows for the start itself
        made.append(restarts.attempt(stated, restarts.windows[0], unstable=True))
    return _lowest(made)


@dataclass(frozen=True, eq=False)
class Restarts:
    """Attempts at the fit of a task."""

    task: FitTask

    @property
    def windows(self) -> tuple[int | None, ...]:
        """Lengths of the shooting windows to try in turn; the first one to converge is taken."""
        options = self.task.options
        if options.window != "auto":
            return (options.window,)
        usual = automatic_window(self.task.data, options.focus)
        return usual, max(16, usual // 2), 4 * usual

    @property
    def longest(self) -> int:
        """Number of samples in the longest record."""
        return max(record.n_samples for record in self.task.data.records)

    def bounded(self, rate: float) -> tuple[int | None, ...]:
        """Return the windows for a model that grows at this rate in a sample; those of the caller stay."""
        return bounded(self.windows, rate) if self.task.options.window == "auto" else self.windows

    def grows(self, rate: float) -> bool:
        """Return whether a predictor is unstable over the longest record."""
        return grows(rate, self.longest)

    def attempt(
        self, start: Mapping[str, float], window: int | None, *, gain_held: bool = False, unstable: bool = False
    ) -> Attempt:
        """Return a fit from start values in windows of this many samples; without `unstable` an unstable start is left.

        `gain_held` fixes the disturbance gain.
        """
        problem = self.task.problem(start, window, gain_held=gain_held)
        rate = problem.shooting.rate(*problem.shooting.unpack(problem.unknowns))
        if self.grows(rate) and not unstable:
            return Attempt(None, rate)
        optimum = minimise(problem)
        result = judge(optimum)
        return Attempt(result, optimum.rate, result.trusted != "white" and optimum.strongly_coloured)

    def in_turn(self, start: Mapping[str, float], windows: Sequence[int | None], *, unstable: bool = False) -> Attempt:
        """Return the first attempt in windows of these lengths that converges, else that with the smallest loss."""
        tried: list[tuple[Attempt, FitResult]] = []
        for window in windows:
            made = self.attempt(start, window, unstable=unstable)
            if made.result is None:
                return made
            tried.append((made, made.result))
            if made.result.success:
                break
            if made.result.status is FitStatus.UNSTABLE_PREDICTOR and len(windows) > 1:
                held = self.attempt(start, window, gain_held=True, unstable=True)
                if held.result is None:
                    return made
                status = FitStatus.CONVERGED_GAIN_HELD if held.result.success else held.result.status
                note = "a free disturbance gain led to an almost unstable predictor: it is fixed at its start value"
                return replace(held, result=replace(held.result, status=status)).noted(FitNote.GAIN_HELD(note))
        best, result = tried[-1]
        if not result.success:
            best, result = min(tried, key=lambda pair: pair[1].loss if np.isfinite(pair[1].loss) else np.inf)
        others = ", ".join(str(r.options.window) for _, r in tried if r is not result)
        text = f"windows of {others} samples did not converge; this is the result with {result.options.window}"
        return best.noted(FitNote.WINDOWS_CHANGED(text)) if others else best

    def settled(self, made: Attempt) -> Attempt:
        """Return a fit from a solution that runs away, in windows that bound its growth; else the solution.

        The plant is unstable then, or a part of it went astray.
        """
        result = made.result
        if result is None or not self.grows(made.rate):
            return made
        if self.task.options.window != "auto" or not np.isfinite(made.rate):
            return made
        length = self.longest if result.options.window is None else result.options.window
        if log(made.rate) * length <= log(POLICY.runaway):
            return made
        estimates = {name: v for name, v in result.parameters.items() if "[" not in name}
        again = self.attempt({**result.start, **estimates}, self.bounded(made.rate)[0], unstable=True)
        if again.result is None or not (again.result.success or again.result.loss < result.loss):
            return made
        return again.noted(
            FitNote.WINDOWS_CHANGED("the model is unstable: shooting windows were bounded by its growth")
        )

    def observer_start(self) -> dict[str, float] | None:
        """Return start values of a fit with a steady observer; None where there is no observer.

        An observer is for linear models in continuous time, with constant parameters.
        """
        task, linear = self.task, kind_of(self.task.structure).linear
        if linear is None or symbolic_matrices(linear)[1].feedback is not None:
            return None
        values = settled_start(
            linear,
            task.parameters,
            task.begin.values,
            task.undisturbed,
            intersample=task.hold,
            left_out=task.options.left_out or {},
        )
        return values and {q.name: float(np.clip(values[q.name], q.lower, q.upper)) for q in task.parameters}


def _lowest(made: Sequence[Attempt]) -> FitResult:
    """Return the lowest result of those that converged, else the lowest; notes tell of one that is lower still."""
    pairs = [(attempt, attempt.result) for attempt in made if attempt.result is not None]
    finite = [(attempt, r) for attempt, r in pairs if np.isfinite(r.loss)] or pairs
    lowest = min(finite, key=lambda pair: pair[1].loss)
    converged = [pair for pair in finite if pair[1].success]
    best, result = min(converged, key=lambda pair: pair[1].loss) if converged else lowest
    notes = result.notes
    if result.loss > lowest[1].loss + POLICY.lower * abs(lowest[1].loss):
        text = f"another attempt ended lower, at a loss of {lowest[1].loss:.6g}, but did not converge"
        notes = (*notes, FitNote.OTHER_MINIMUM(text))
    if result.success and best.doubtful:
        text = (
            "neighbouring residuals are strongly correlated: this may be a minimum that is not the lowest; try "
            "other start values (fit_multistart)"
        )
        notes = (*notes, FitNote.OTHER_MINIMUM(text))
    return replace(result, notes=notes)
