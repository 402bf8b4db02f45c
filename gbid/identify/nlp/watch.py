"""Watch over the iterations of the solver: progress, stopping rules, Ctrl-C."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.nlp.optimality import distance_from_rest, in_standard_deviations
from gbid.identify.nlp.shooting import Shooting

Stop = Literal["tolerance", "paper"]
PAPER_TOLERANCE = 1e-4
_GAP_TOLERANCE = 1e-6  # of the scaled states, before the paper's stopping rule is believed
_STEP_TOLERANCE = 1e-4  # of the estimates' joint standard deviation: nothing that the data could tell is left
PATIENCE = 5  # iterations that a predictor may be unstable on the way, where its start was so too, or stand still
_STEP_AHEAD = 1e-2  # of the same: what Gauss-Newton may still want, which is a part of what is needed or more
_NEAR = 50.0  # standard deviations, and the gap that goes with it: the basin of the minimum is reached
_NEAR_GAP = 0.1
_AHEAD = 7  # iterations that justify a change of method
_STEP_BEFORE = 1e-2
_LOOKED_AT = [ca.nlpsol_out().index(name) for name in ("f", "x", "g")]
_EXACT_GAP = 1e-9  # the same for a fit without errors, whose gradient is rounding and tells nothing more


@dataclass(frozen=True)
class Progress:
    """One iteration of a solver, for a progress line.

    Attributes
    ----------
    iteration : int
        From zero, the start.
    cost : float
        Scaled cost.
    gap : float
        Largest gap between windows, in units of the states' size.
    step : float
        Relative change of the scaled parameters since the last iteration.
    sigma : float
        The last step of all unknowns in standard deviations of the estimate.
    """

    iteration: int
    cost: float
    gap: float
    step: float
    sigma: float


@dataclass
class Interrupt:
    """Why the solver is to end at once, from outside of it.

    An exception inside of a callback would be printed by CasADi and lost.

    Attributes
    ----------
    error : BaseException or None
        KeyboardInterrupt after Ctrl-C, or what a progress function raised.
    """

    error: BaseException | None = None


class Watch(ca.Callback):
    """Callback of each iteration: it reports progress, applies the stopping rules, and ends the solver on Ctrl-C."""

    def __init__(
        self,
        problem: Shooting,
        stop: Stop,
        progress: Callable[[Progress], None] | None,
        interrupt: Interrupt,
        box: tuple[FloatArray, FloatArray],
        *,
        earlier: Sequence[Progress] = (),
        changes_over: bool = False,
    ) -> None:
        ca.Callback.__init__(self)
        self._problem, self._stop, self._progress, self.interrupt = problem, stop, progress, interrupt
        n, m = (
            problem.n_unknowns,
            problem.n_gaps + len(problem.limits[0]) + (0 if problem.extra is None else len(problem.extra.size)),
        )
        sizes = {"f": 1, "x": n, "g": m, "lam_x": n, "lam_g": m, "lam_p": 0}
        self._shapes = [
            ca.Sparsity.dense(sizes[name], 1) if name != "lam_p" else ca.Sparsity(0, 0)
            for name in map(ca.nlpsol_out, range(ca.nlpsol_n_out()))
        ]
        self.history: list[Progress] = []
        self._box, self._earlier, self._changes_over = box, tuple(earlier), changes_over
        self.settled = False
        self.exact = False
        self.at_rest = False
        self.creeping = False
        self.unstable = 0
        self.stuck = 0
        self.rest = np.zeros(0), np.inf
        self._previous: FloatArray | None = None
        self._sigma = np.inf
        self.construct("watch", {})

    def get_n_in(self) -> int:
        return len(self._shapes)

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return str(ca.nlpsol_out(i))

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return self._shapes[i]

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arguments: Sequence[memoryview | None], results: Sequence[memoryview | None]) -> int:
        """Look at an iterate, in CasADi's own memory, and write whether the solver is to end."""
        f, x, g = (np.frombuffer(own) if own else np.zeros(0) for own in map(arguments.__getitem__, _LOOKED_AT))
        ended = self._look(float(f[0]), x.copy(), g)
        if results[0] is not None:
            np.frombuffer(results[0])[:] = ended
        return 0

    def _look(self, cost: float, x: FloatArray, g: FloatArray) -> bool:
        extra = self._problem.extra
        gaps = g[: self._problem.n_gaps]
        step = sigma = np.inf
        if self._previous is not None:
            moved, n_theta = x - self._previous, self._problem.n_theta
            step = float(np.linalg.norm(moved[:n_theta])) / max(float(np.linalg.norm(x[:n_theta])), 1e-300)
            sigma = in_standard_deviations(self._problem, self._problem.at(x), moved)
        gap = float(np.abs(gaps).max(initial=0.0))
        if extra is not None:
            gap = max(gap, extra.violation(g[len(g) - len(extra.size) :]))
        done = max(len(self._earlier) - 1, 0)  # where the last solver ended is where this one starts
        now = Progress(done + len(self.history), cost, gap, step, sigma)
        self.history.append(now)
        if self._progress is not None and not (self._earlier and len(self.history) == 1):
            try:
                self._progress(now)
            except BaseException as error:  # raised again outside of the solver
                self.interrupt.error = error
                return True
        self.settled = self._stop == "paper" and now.step < PAPER_TOLERANCE and now.gap < _GAP_TOLERANCE
        self.exact = extra is None and now.cost <= self._problem.exact_cost and now.gap < _EXACT_GAP
        # A step may be small by chance, where the solver has just cut it: the one before must have been small, too.
        small = sigma < _STEP_TOLERANCE and self._sigma < _STEP_BEFORE and now.gap < _GAP_TOLERANCE
        still = small and self._stop == "tolerance"
        self.at_rest = still and self._nothing_to_gain(x)
        self.stuck = self.stuck + 1 if still and not self.at_rest else 0
        near = sigma < _NEAR and now.gap < _NEAR_GAP
        self.creeping = self._changes_over and near and _iterations_ahead(sigma, self._sigma) > _AHEAD
        self.creeping = self.creeping and self._radius(x) < 1
        self._previous, self._sigma = x, sigma
        self.unstable = self.unstable + 1 if self._problem.noise and self._radius(x) > 1 else 0
        ended = self.settled or self.exact or self.at_rest or self.creeping
        given_up = max(self.unstable, self.stuck) >= PATIENCE
        return self.interrupt.error is not None or ended or given_up

    def _nothing_to_gain(self, x: FloatArray) -> bool:
        """Return whether a Gauss-Newton step from here would be very small.

        Small steps of the solver may mean a wrong Hessian or a line search that stalls, not a minimum. Near an unstable
        predictor there is no minimum, which the result reports.
        """
        if any(self._problem.parts_at_edge(self._problem.unpack(x)[0])):
            return True
        self.rest = x, distance_from_rest(self._problem, x, self._box)
        return self.rest[1] < _STEP_AHEAD

    def _radius(self, x: FloatArray) -> float:
        return self._problem.at(x).rate


def _iterations_ahead(sigma: float, before: float) -> float:
    """Return the number of iterations until steps are below the tolerance, at the rate of the last step."""
    if not sigma < before:
        return np.inf
    return float(np.log(max(sigma / _STEP_TOLERANCE, 1.0)) / np.log(before / max(sigma, 1e-300)))
