"""Solution of the shooting problem by IPOPT: callbacks, stopping rules, rounds of solutions."""

from __future__ import annotations

import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy

from gbid.core.arrays import FloatArray, IntArray, one_solver
from gbid.core.errors import GbidError, UsageError
from gbid.identify.options import FitArguments
from gbid.identify.problem.hessian import Curvature, ExactHessian, gauss_newton, in_one_window, in_windows
from gbid.identify.problem.nlp import Box, Iterate, Pattern, Shooting
from gbid.identify.result import FitStatus, Phase


@dataclass
class Trouble:
    """Points at which a callback of the solver had no value.

    An exception inside of a callback would be printed with a traceback and all values of the point. A point at which
    the model overflows has no value instead, and the solver steps back. Any other exception is a defect, and kept.

    Attributes
    ----------
    points : int
        Number of points at which the cost has no finite value.
    defect : Exception or None
        First exception that is not numerical.
    most : float
        How many times the largest gap of the first point, or one if that is larger, a gap may become. A point with a
        larger one has no value either.
    first : float or None
        Largest gap of the first point.
    """

    points: int = 0
    defect: Exception | None = None
    most: float = np.inf
    first: float | None = None

    def too_far(self, gap: float) -> bool:
        """Return whether a point's largest gap is too large, compared with the solver's first point."""
        if self.first is None:
            self.first = gap
        return gap > self.most * max(1.0, self.first)


class Oracle(ca.Callback):
    """CasADi callback of a Python function with named arguments of given shapes.

    The function gets the nonzeros of its arguments and returns those of its results, as arrays in column order. They
    are views of CasADi's own memory: copies into its matrices and back took longer than what is between them.
    """

    def __init__(
        self,
        name: str,
        inputs: Sequence[tuple[str, ca.Sparsity]],
        outputs: Sequence[tuple[str, ca.Sparsity]],
        function: Callable[..., Sequence[FloatArray | float]],
        trouble: Trouble,
    ) -> None:
        ca.Callback.__init__(self)
        self._inputs, self._outputs, self._call, self._trouble = inputs, outputs, function, trouble
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self._inputs)

    def get_n_out(self) -> int:
        return len(self._outputs)

    def get_name_in(self, i: int) -> str:
        return self._inputs[i][0]

    def get_name_out(self, i: int) -> str:
        return self._outputs[i][0]

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return self._inputs[i][1]

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return self._outputs[i][1]

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arguments: Sequence[memoryview | None], results: Sequence[memoryview | None]) -> int:
        """Write the requested results; missing arguments are zero."""
        given = [
            np.frombuffer(memory) if memory else np.zeros(sparsity.nnz())
            for memory, (_, sparsity) in zip(arguments, self._inputs, strict=True)
        ]
        values: Sequence[FloatArray | float] = [np.nan] * len(results)
        try:
            values = self._call(*given)
        except (ArithmeticError, np.linalg.LinAlgError, GbidError):  # a model that overflows, a delay below zero
            pass
        except Exception as error:
            self._trouble.defect = self._trouble.defect or error
        for memory, value in zip(results, values, strict=True):
            if memory:
                np.frombuffer(memory)[:] = value
        return 0


class NlpFunctions(NamedTuple):
    """CasADi functions of the scaled unknowns, named as in ``casadi.nlpsol``. They must outlive the solver.

    Attributes
    ----------
    value : casadi.Function
        ``(x) -> (f, g)``: cost and constraints. The constraints are the gaps, the bounds of tied parameters, and those
        of the caller.
    gradient : casadi.Function
        ``(x, p) -> (f, grad_f_x)``.
    jacobian : casadi.Function
        ``(x, p) -> (g, jac_g_x)``.
    hessian : casadi.Function
        ``(x, p, lam_f, lam_g) -> triu_hess_gamma_x_x``: upper triangle of the Hessian.
    lower, upper : (n_constraints,) array
        Bounds of the constraints.
    """

    value: ca.Function
    gradient: ca.Function
    jacobian: ca.Function
    hessian: ca.Function
    lower: FloatArray
    upper: FloatArray

    @property
    def derivatives(self) -> dict[str, Any]:
        """Options of ``casadi.nlpsol`` that replace its derivatives by these functions."""
        return {"no_nlp_grad": True, "grad_f": self.gradient, "jac_g": self.jacobian, "hess_lag": self.hessian}


def nlp_functions(problem: Shooting, curvature: Curvature, trouble: Trouble) -> NlpFunctions:
    """Return the CasADi functions of a problem.

    Parameters
    ----------
    problem : Shooting
        The problem.
    curvature : Curvature
        Hessian of cost and gaps.
    trouble : Trouble
        Notes the points without a value, and defects.
    """
    n, m, extra, (used, _) = problem.n_unknowns, problem.n_gaps, problem.extra, problem.extra_places
    vector, scalar, empty = ca.Sparsity.dense(n, 1), ca.Sparsity.dense(1, 1), ca.Sparsity(0, 0)
    limits, lowest, highest = problem.limits
    n_extra, further = (0, [np.zeros(0)] * 2) if extra is None else (len(extra.lower), [extra.lower, extra.upper])
    lower, upper = (np.concatenate([np.zeros(m), *edges]) for edges in zip((lowest, highest), further, strict=True))
    jacobian, order = _stacked(problem.jacobian_pattern, limits, n_extra, used)
    bounds = limits[limits != 0]
    constraints, hessian = ca.Sparsity.dense(len(lower), 1), _sparsity(problem.hessian_pattern)
    point = [("x", vector), ("p", empty)]

    def held(x: FloatArray) -> FloatArray:
        iterate = problem.at(x)
        return np.concatenate([iterate.gaps, limits @ x[: problem.n_theta], iterate.extra_rows])

    def slopes(x: FloatArray, _p: FloatArray) -> list[FloatArray | float]:
        iterate = problem.at(x)
        return [held(x), np.concatenate([iterate.jacobian, bounds, iterate.extra_slopes.ravel()])[order]]

    def cost(x: FloatArray) -> list[FloatArray | float]:
        value = np.nan
        try:
            iterate = problem.at(x)
            value = np.nan if trouble.too_far(float(np.abs(iterate.gaps).max(initial=0.0))) else iterate.cost
            return [value, held(x)]
        finally:
            trouble.points += not np.isfinite(value)

    def gradient(x: FloatArray, _p: FloatArray) -> list[FloatArray | float]:
        iterate = problem.at(x)
        return [iterate.cost, iterate.gradient]

    def second(x: FloatArray, _p: FloatArray, lam_f: FloatArray, lam_g: FloatArray) -> list[FloatArray | float]:
        entries = curvature(x, float(lam_f[0]), lam_g[:m])
        if extra is not None and n_extra:
            bent = extra.bent(*problem.unpack(x), lam_g[len(lam_g) - n_extra :])
            entries = entries + problem.extra_entries(bent)
        return [entries]

    values, multipliers = [("f", scalar), ("g", constraints)], [("lam_f", scalar), ("lam_g", constraints)]
    return NlpFunctions(
        Oracle("nlp", point[:1], values, cost, trouble),
        Oracle("grad_f", point, [("f", scalar), ("grad_f_x", vector)], gradient, trouble),
        Oracle("jac_g", point, [("g", constraints), ("jac_g_x", jacobian)], slopes, trouble),
        Oracle("hess_lag", point + multipliers, [("triu_hess_gamma_x_x", hessian)], second, trouble),
        lower,
        upper,
    )


def _stacked(gaps: Pattern, limits: FloatArray, n_extra: int, used: IntArray) -> tuple[ca.Sparsity, IntArray]:
    """Return the sparsity of stacked gaps, limits and extra constraints, and the order of their entries.

    The entries are those of the gaps in the order of their pattern, the nonzeros of the limits row by row, and the
    slopes of the further constraints by the `used` unknowns row by row.
    """
    limit, of = np.nonzero(limits)
    further = np.arange(n_extra).repeat(len(used))
    rows = [gaps.rows, gaps.shape[0] + limit, gaps.shape[0] + len(limits) + further]
    columns = [gaps.columns, of, np.tile(used, n_extra)]
    pattern = Pattern.of((gaps.shape[0] + len(limits) + n_extra, gaps.shape[1]), rows, columns)
    return _sparsity(pattern), pattern.order


def _sparsity(pattern: Pattern) -> ca.Sparsity:
    """Return a pattern as a CasADi sparsity: by columns, with ascending rows."""
    counts = np.bincount(pattern.columns, minlength=pattern.shape[1])
    return ca.Sparsity(*pattern.shape, [0, *np.cumsum(counts).tolist()], pattern.rows.tolist())


# ---- First-order optimality of a point, in standard deviations of the estimates.
#
# The measure is the length of the Gauss-Newton step that would come next, with the linearised gaps closed and within
# the bounds. It is zero at a stationary point, whatever the Hessian. It does not depend on units or scales.

_ROUNDING = 1e-12  # of a curvature: for unknowns that the data do not tell
_UNSEEN = 1e-10  # of the largest curvature
_AT_BOUND = 1e-4  # scaled; of constraints
_SPRING = 1e8  # of an unknown's own curvature: half of the digits for the step, half for the force
_MEETINGS = 10  # rounds in which a step meets further bounds


def distance_from_rest(problem: Shooting, unknowns: FloatArray) -> float:
    """Return the length of the next Gauss-Newton step in standard deviations of the estimates.

    Parameters
    ----------
    problem : Shooting
        Problem of the fit.
    unknowns : (n_unknowns,) array
        Scaled unknowns.

    Returns
    -------
    float
        Infinite where the problem has no value or the step cannot be computed; zero where all errors are rounding.
    """
    iterate = problem.at(unknowns)
    if not (np.isfinite(iterate.cost) and np.isfinite(iterate.gradient).all() and np.isfinite(iterate.hessian).all()):
        return np.inf
    if problem.extra is None and iterate.cost <= problem.exact_cost:
        return 0.0
    try:
        step = gauss_newton_step(problem, iterate, unknowns)
    except (RuntimeError, ValueError, scipy.sparse.linalg.MatrixRankWarning):  # singular
        return np.inf
    return in_standard_deviations(problem, iterate, step)


def in_standard_deviations(problem: Shooting, iterate: Iterate, change: FloatArray) -> float:
    """Return the length of a step (n_unknowns,) in standard deviations, from the information at a point."""
    pattern, entries = problem.hessian_pattern, iterate.hessian
    twice = np.where(pattern.rows == pattern.columns, 1.0, 2.0)
    square = float((twice * entries * change[pattern.rows] * change[pattern.columns]).sum())
    return float(np.sqrt(max(square, 0.0) * problem.likelihood_size)) if np.isfinite(square) else np.inf


def gauss_newton_step(problem: Shooting, iterate: Iterate, x: FloatArray, box: Box | None = None) -> FloatArray:
    """Return the Gauss-Newton step (n_unknowns,) from the sparse KKT system; it ends at the bounds.

    These are those of the problem, or others.
    """
    return _bounded_step(problem, iterate, x, box or problem.box)[0]


def forces_of_bounds(problem: Shooting, unknowns: FloatArray) -> FloatArray:
    """Return the log-likelihood's slope at each active bound, (n_p,) [1/unit]; zero for other parameters.

    A force F holds a parameter with the standard deviation sigma: without its bound it would move on by ``F sigma^2``.

    Parameters
    ----------
    problem : Shooting
        Problem of the fit.
    unknowns : (n_unknowns,) array
        Its solution, scaled.
    """
    nothing, iterate, box = np.zeros(problem.n_theta), problem.at(unknowns), problem.box
    if not (np.isfinite(iterate.gradient).all() and np.isfinite(iterate.hessian).all()):
        return nothing
    # A bound that is farther than the standard deviation with all others known is met along a valley, if at all.
    pattern, curvature = problem.hessian_pattern, np.zeros(problem.n_unknowns)
    diagonal = pattern.rows == pattern.columns
    curvature[pattern.rows[diagonal]] = iterate.hessian[diagonal]
    below, above = unknowns - box[0], box[1] - unknowns
    near = np.minimum(below, above) * np.sqrt(curvature * problem.likelihood_size) <= 1.0
    near = (near & (box[0] < box[1]))[: problem.n_theta]
    if not near.any():
        return nothing
    try:
        _, inward = _bounded_step(problem, iterate, unknowns, box)
    except (RuntimeError, ValueError, scipy.sparse.linalg.MatrixRankWarning):  # singular
        return nothing
    outward = np.maximum(np.where(below < above, inward, -inward)[: problem.n_theta], 0.0)
    return np.asarray(np.where(near, outward, 0.0) * problem.likelihood_size / problem.theta_scale)


def _bounded_step(problem: Shooting, iterate: Iterate, x: FloatArray, box: Box) -> tuple[FloatArray, FloatArray]:
    """Return the Gauss-Newton step within the bounds, and the multipliers of the bounds, both (n_unknowns,).

    The step is that of the optimality conditions. An unknown that would leave its bounds goes as far as its bound,
    held there by a stiff spring, whose force is the multiplier of the bound.
    """
    met, off = _active_rows(problem, iterate, x)
    active, columns = np.nonzero(met)
    n, m = problem.n_unknowns, problem.n_gaps + len(met)
    upper, across = problem.hessian_pattern, problem.jacobian_pattern
    free = np.concatenate([box[0] < box[1], np.ones(m, dtype=bool)])
    # Each unknown in units of its own curvature, each constraint in units of its largest entry.
    beside = upper.rows != upper.columns
    size = np.zeros(n)
    size[upper.rows[~beside]] = iterate.hessian[~beside]
    most = size.max(where=free[:n], initial=0.0)
    seen = size > _UNSEEN * most  # the state in a stretch that is left out has no curvature of its own
    size = np.where(seen, 1 / np.sqrt(np.where(seen, size, 1.0)), 1.0)
    bound = np.concatenate([across.rows, problem.n_gaps + active]), np.concatenate([across.columns, columns])
    slopes = np.concatenate([iterate.jacobian, met[active, columns]]) * size[bound[1]]
    largest = np.zeros(m)
    np.maximum.at(largest, bound[0], np.abs(slopes))
    largest = np.where(largest > 0, largest, 1.0)
    entries = iterate.hessian * size[upper.rows] * size[upper.columns]
    diagonal = np.zeros(n)
    diagonal[upper.rows[~beside]] = entries[~beside]
    rows = np.concatenate([upper.rows[beside], n + bound[0]])
    columns = np.concatenate([upper.columns[beside], bound[1]])
    entries = np.concatenate([entries[beside], slopes / largest[bound[0]]])
    kept, every = free[rows] & free[columns], np.arange(n + m)
    rows, columns, entries = rows[kept], columns[kept], entries[kept]
    diagonal = np.concatenate([np.where(free[:n], diagonal + _ROUNDING, 1.0), np.full(m, -_ROUNDING)])
    places = np.concatenate([rows, columns, every]), np.concatenate([columns, rows, every])
    slope = np.concatenate([iterate.gradient * size, np.concatenate([iterate.gaps, off]) / largest])
    slope = np.where(free, -slope, 0.0)

    def solved(spring: FloatArray, target: FloatArray) -> FloatArray:
        stiff, pulled = np.pad(spring, (0, m)), np.pad(spring * target, (0, m))
        values = np.concatenate([entries, entries, diagonal + stiff])
        matrix = scipy.sparse.coo_array((values, places), shape=(n + m, n + m))
        matrix.has_canonical_format = True  # each entry once: no search for others
        matrix = matrix.tocsc()
        matrix.has_canonical_format = matrix.has_sorted_indices = True  # the factorisation needs no order in a column
        with warnings.catch_warnings():
            warnings.simplefilter("error", scipy.sparse.linalg.MatrixRankWarning)
            return np.asarray(scipy.sparse.linalg.splu(matrix).solve(slope + pulled)[:n])

    spring, target = np.zeros(n), np.zeros(n)
    step = solved(spring, target)
    for _ in range(_MEETINGS):
        end = np.clip(x + size * step, *box)
        beyond = free[:n] & (spring == 0) & (end != x + size * step)
        if not beyond.any():
            break
        spring[beyond], target[beyond] = _SPRING, (end - x)[beyond] / size[beyond]
        step = solved(spring, target)
    return np.where(spring > 0, target, step) * size, spring * (target - step) / size


def _active_rows(problem: Shooting, iterate: Iterate, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return slopes of active constraints, (n_active, n_unknowns), and distances from their bounds, (n_active,)."""
    limits, low, high = problem.limits
    values = limits @ x[: problem.n_theta]
    met = limits[(values < low + _AT_BOUND) | (values > high - _AT_BOUND)]
    rows, off = np.pad(met, ((0, 0), (0, problem.n_unknowns - problem.n_theta))), np.zeros(len(met))
    if problem.extra is None:
        return rows, off
    distance = problem.extra.off_bound(iterate.extra_rows, _AT_BOUND)
    active = ~np.isnan(distance)
    further = np.zeros((int(active.sum()), problem.n_unknowns))
    further[:, problem.extra_places[0]] = iterate.extra_slopes[active]
    return np.vstack([rows, further]), np.concatenate([off, distance[active]])


@dataclass(frozen=True)
class Tolerances:
    """Stopping tolerances of the solver. Lengths of steps are in standard deviations of the estimates.

    Attributes
    ----------
    solver : float
        Of IPOPT on the scaled optimality conditions.
    tighter : float
        The same for a solution that has not come to rest, as a part of it.
    paper : float
        Relative change of the parameters at which the paper's rule stops.
    gap, exact_gap : float
        Largest gap at which a rule is believed, of the scaled states; and for a fit without errors, whose gradient is
        rounding and tells nothing more.
    step, step_before : float
        Step at which nothing that the data could tell is left. One may be small by chance, where the solver has just
        cut it: the one before must have been small, too.
    step_ahead : float
        What Gauss-Newton may still want there, which is a part of what is needed or more.
    near, near_gap, ahead : float
        Step and gap at which the basin of the minimum is reached, and the iterations ahead that justify a change of
        method there.
    judged : float
        Step at which a point is near enough to the minimum to judge the steps of an integrator.
    patience : int
        Iterations that a predictor may be unstable on the way, where its start was so too, or stand still.
    edge : float
        Rate of a predictor from which on small steps stand still at the edge of stability.
    rest, rest_by_paper : float
        Length that the next step of a solution may still have; the paper's rule stops earlier.
    farthest : float
        Largest gap in that of the start: what IPOPT tries beyond takes MUMPS seconds to factorise.
    """

    solver: float = 1e-6
    tighter: float = 1e-4
    paper: float = 1e-4
    gap: float = 1e-6
    exact_gap: float = 1e-9
    step: float = 1e-4
    step_before: float = 1e-2
    step_ahead: float = 1e-2
    near: float = 50.0
    near_gap: float = 0.1
    ahead: float = 7
    judged: float = 1.0
    patience: int = 5
    edge: float = 1 - 1e-6
    rest: float = 0.1
    rest_by_paper: float = 1.0
    farthest: float = 1e9


TOLERANCES = Tolerances()


@dataclass(frozen=True)
class Progress:
    """Progress of a solver in one iteration, for a progress line.

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
    """Reason for ending the solver from outside: Ctrl-C, or an error of the progress function.

    An exception inside of a callback would be printed by CasADi and lost.

    Attributes
    ----------
    error : BaseException or None
        KeyboardInterrupt after Ctrl-C, or what a progress function raised.
    """

    error: BaseException | None = None


@dataclass(eq=False)
class Watch:
    """Monitor of a run: reports progress, applies stopping rules, ends the run on Ctrl-C.

    Attributes
    ----------
    problem, options, interrupt
        Those of the run.
    earlier : sequence of Progress
        Iterations of the run before; empty for the first.
    changes_over : bool
        Whether the run may end for another method.
    ends_near : callable, optional
        Asked once near the minimum whether the run ends there.
    history : list of Progress
        Iterations so far.
    status : FitStatus or None
        Reason of the watch to end the run; None when it has none.
    creeping : bool
        Whether the method is to change: the basin of the minimum is reached, but many iterations lie ahead.
    rest : (n_unknowns,) array, float
        Last point at which the first-order optimality was looked at, and its value.
    """

    problem: Shooting
    options: FitArguments
    interrupt: Interrupt
    earlier: Sequence[Progress] = ()
    changes_over: bool = False
    ends_near: Callable[[FloatArray], bool] | None = None
    history: list[Progress] = field(init=False, default_factory=list)
    status: FitStatus | None = field(init=False, default=None)
    creeping: bool = field(init=False, default=False)
    rest: tuple[FloatArray, float] = field(init=False, default=(np.zeros(0), np.inf))
    _inner: bool = field(init=False, default=False)
    _unstable: int = field(init=False, default=0)
    _stuck: int = field(init=False, default=0)
    _previous: FloatArray | None = field(init=False, default=None)
    _sigma: float = field(init=False, default=np.inf)

    def look(self, cost: float, x: FloatArray, g: FloatArray) -> bool:
        """Return whether the run ends at an iterate with given constraint values."""
        problem, limit = self.problem, TOLERANCES
        step = sigma = np.inf
        if self._previous is not None:
            change, n_theta = x - self._previous, problem.n_theta
            step = float(np.linalg.norm(change[:n_theta])) / max(float(np.linalg.norm(x[:n_theta])), 1e-300)
            sigma = in_standard_deviations(problem, problem.at(x), change)
        gap = float(np.abs(g[: problem.n_gaps]).max(initial=0.0))
        if problem.extra is not None:
            gap = max(gap, problem.extra.violation(g[len(g) - len(problem.extra.size) :]))
        done = max(len(self.earlier) - 1, 0)  # where the last solver ended is where this one starts
        now = Progress(done + len(self.history), cost, gap, step, sigma)
        self.history.append(now)
        if self.options.progress is not None and not (self.earlier and len(self.history) == 1):
            try:
                self.options.progress(now)
            except BaseException as error:  # raised again outside of the solver
                self.interrupt.error = error
                return True
        small = sigma < limit.step and self._sigma < limit.step_before and gap < limit.gap
        still = small and self.options.stop == "tolerance"
        at_rest = still and self._nothing_to_gain(x)
        self._stuck = self._stuck + 1 if still and not at_rest else 0
        inner = bool(problem.noise) and problem.stable_only and problem.rate(*problem.unpack(x)) < limit.edge
        if self._previous is None:
            self._inner = inner
        elif (
            (self._inner and not inner)
            and (sigma < limit.step_before and gap < limit.gap)
            and not any(problem.parts_at_edge(problem.unpack(x)[0]))  # else the gain is to blame
        ):
            self._stuck = limit.patience  # beyond the edge of stability the problem has no value
        near = self.changes_over and sigma < limit.near and gap < limit.near_gap
        creeps = near and _iterations_ahead(sigma, self._sigma) > limit.ahead
        self.creeping = creeps and problem.rate(*problem.unpack(x)) < 1
        ends = False
        if self.ends_near and sigma < limit.judged and self._sigma < limit.near and gap < limit.near_gap:
            ends, self.ends_near = self.ends_near(x), None
        self._previous, self._sigma = x, sigma
        watched = problem.noise and not problem.stable_only  # else the problem has no value at an unstable predictor
        self._unstable = self._unstable + 1 if watched and problem.rate(*problem.unpack(x)) > 1 else 0
        reasons = {
            FitStatus.CONVERGED_BY_PAPER_RULE: self.options.stop == "paper" and step < limit.paper and gap < limit.gap,
            FitStatus.UNSTABLE_PREDICTOR: self._unstable >= limit.patience,
            FitStatus.STEPS_TOO_SMALL: self._stuck >= limit.patience,
            FitStatus.CONVERGED: at_rest,
            FitStatus.CONVERGED_AT_ROUNDING: (
                problem.extra is None and cost <= problem.exact_cost and gap < limit.exact_gap
            ),
            FitStatus.CONVERGED_ACCEPTABLY: ends,
        }
        self.status = next((status for status, holds in reasons.items() if holds), None)
        return self.status is not None or self.creeping or self.interrupt.error is not None

    def _nothing_to_gain(self, x: FloatArray) -> bool:
        """Return whether the next Gauss-Newton step is negligible.

        Small steps of the solver may mean a wrong Hessian or a line search that stalls, not a minimum. Near an unstable
        predictor there is no minimum, which the result reports.
        """
        if any(self.problem.parts_at_edge(self.problem.unpack(x)[0])):
            return True
        self.rest = x, distance_from_rest(self.problem, x)
        return self.rest[1] < TOLERANCES.step_ahead


def _iterations_ahead(sigma: float, before: float) -> float:
    """Return the predicted number of iterations to the tolerance, from the last rate of convergence."""
    if not sigma < before:
        return np.inf
    return float(np.log(max(sigma / TOLERANCES.step, 1.0)) / np.log(before / max(sigma, 1e-300)))


# ---- Runs of IPOPT on the shooting problem.

_BY_IPOPT = {
    "Solve_Succeeded": FitStatus.CONVERGED,
    "Solved_To_Acceptable_Level": FitStatus.CONVERGED_ACCEPTABLY,
    "Feasible_Point_Found": FitStatus.CONVERGED,
    "Maximum_Iterations_Exceeded": FitStatus.ITERATION_LIMIT,
    "Restoration_Failed": FitStatus.GAPS_OPEN,
    "Infeasible_Problem_Detected": FitStatus.GAPS_CONTRADICT,
    "Search_Direction_Becomes_Too_Small": FitStatus.STEPS_TOO_SMALL,
    "Diverging_Iterates": FitStatus.DIVERGED,
    "Invalid_Number_Detected": FitStatus.PREDICTOR_OVERFLOWS,
    "Error_In_Step_Computation": FitStatus.NO_STEP,
}
"""Of IPOPT's return statuses; all others are its own failures."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Last iterate of the solver, and the reason for its stop.

    Attributes
    ----------
    unknowns : (n_unknowns,) array
        Scaled unknowns.
    status : FitStatus
        Reason.
    iterations : int
        Number of iterations.
    history : tuple of Progress
        Progress of each iteration.
    rest : float
        First-order optimality: length of the Gauss-Newton step that would come next, in standard deviations.
    overflows : int
        Number of points that the solver tried where the model has no finite value; it steps back from them.
    phases : tuple of Phase
        Problems that were solved one after the other: in windows, then in one window if the first one crept.
    """

    unknowns: FloatArray
    status: FitStatus
    iterations: int
    history: tuple[Progress, ...]
    rest: float = np.inf
    overflows: int = 0
    phases: tuple[Phase, ...] = ()

    def after(self, before: Solution, problem: Shooting) -> tuple[Solution, bool]:
        """Return this solution with the previous round's iterations added, and whether the parameters have settled.

        They are when they moved by less than 1 % of a standard deviation: no digit of an interval depends on less. The
        status is then that of the round before, because the solver may be stuck where a round begins at its end.
        """
        step = (self.unknowns - before.unknowns)[: problem.n_theta]
        at_rest = bool(np.linalg.norm(step) * np.sqrt(problem.likelihood_size) < _AT_REST)
        status = before.status if at_rest else self.status
        return replace(self, status=status, iterations=before.iterations + self.iterations), at_rest


_AT_REST = 0.01


def solve(
    problem: Shooting,
    start: FloatArray,
    options: FitArguments = FitArguments(),  # noqa: B008
    ends_near: Callable[[FloatArray], bool] | None = None,
) -> Solution:
    """Return the minimum of the cost with all gaps closed.

    Gauss-Newton in windows finds the basin. Where it creeps there, as with errors that are coloured, each segment
    becomes one window, and the Hessian gets what Gauss-Newton leaves out (`ExactHessian`).

    At the end the first-order optimality is checked. A solution that has not come to rest is solved on, with a tighter
    tolerance; one that still has not is no success.

    Parameters
    ----------
    problem : Shooting
    start : (n_unknowns,) array
        Start, scaled; the solver begins within the bounds.
    options : FitArguments
        Options of a fit: `stop`, `max_iterations`, `progress` and `ipopt`. "tolerance" stops by IPOPT's own test or at
        a step far below the estimates' standard deviations, whichever is met first; "paper" at a relative change of
        the parameters below 1e-4 (Sec. 3.6).
    ends_near : callable, optional
        Asked once, with the unknowns near the minimum, whether to end there, as "converged acceptably".

    Returns
    -------
    Solution

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C, once the iteration under way has ended.
    Exception
        What `progress` raises.
    """
    most, start = options.max_iterations, np.clip(start, *problem.box)
    with _interruptible() as interrupt:
        runs = _Runs(problem, gauss_newton, options, interrupt)
        first, watch = runs.run(start, most, changes_over=bool(problem.parts), ends_near=ends_near)
        if not watch.creeping:
            if not (ends_near and first.status is FitStatus.CONVERGED_ACCEPTABLY):
                first = runs.at_rest(first, most)
            return replace(first, phases=(_phase(problem, first),))
        joined, kept = in_one_window(problem)
        runs = _Runs(joined, ExactHessian, options, interrupt)
        most -= first.iterations
        last, _ = runs.run(first.unknowns[kept], most, earlier=first.history)
        last = runs.at_rest(last, most)
    phases = _phase(problem, first), _phase(joined, last)
    return replace(_continued(first, replace(last, unknowns=in_windows(problem, joined, last.unknowns))), phases=phases)


def solve_apart(problem: Shooting, start: FloatArray, most: int) -> FloatArray:
    """Return the unknowns (n_unknowns,) of minimal cost with gaps between windows left open.

    A short window ends before errors of the parameters have grown, so that the cost has few other minima, far from the
    solution as well. The states that follow each other are not used, so that the estimates are rough: a start. The
    paper's rule stops.
    """
    options = FitArguments(stop="paper", max_iterations=most)
    with _interruptible() as interrupt:
        runs = _Runs(replace(problem, links=problem.links[:0]), gauss_newton, options, interrupt)
        return runs.run(np.clip(start, *problem.box), most)[0].unknowns


def _phase(problem: Shooting, solution: Solution) -> Phase:
    return Phase(problem.n_windows, problem.n_gaps, problem.n_unknowns, solution.iterations)


def _continued(first: Solution, last: Solution) -> Solution:
    """Return the last solution of two successive runs, with the iterations of both."""
    return replace(
        last,
        iterations=first.iterations + last.iterations,
        overflows=first.overflows + last.overflows,
        history=(*first.history, *last.history[1:]),
    )


@dataclass(frozen=True, eq=False)
class _Runs:
    """Runs of IPOPT on one problem with one kind of Hessian."""

    problem: Shooting
    curvature: Callable[[Shooting], Curvature]
    options: FitArguments
    interrupt: Interrupt

    def run(
        self,
        start: FloatArray,
        most: int,
        *,
        tolerance: float = TOLERANCES.solver,
        earlier: Sequence[Progress] = (),
        changes_over: bool = False,
        ends_near: Callable[[FloatArray], bool] | None = None,
    ) -> tuple[Solution, Watch]:
        """Run IPOPT once with a limit of iterations; `earlier` is the progress of the previous run."""
        problem, (lower, upper), trouble = self.problem, self.problem.box, Trouble(most=TOLERANCES.farthest)
        watch = Watch(problem, self.options, self.interrupt, earlier, changes_over, ends_near)
        functions = nlp_functions(problem, self.curvature(problem), trouble)
        n, m, names = problem.n_unknowns, len(functions.lower), ca.nlpsol_out()
        sizes = {"f": (1, 1), "x": (n, 1), "g": (m, 1), "lam_x": (n, 1), "lam_g": (m, 1), "lam_p": (0, 0)}

        def look(*values: FloatArray) -> list[FloatArray | float]:
            f, x, g = (values[names.index(name)] for name in ("f", "x", "g"))
            return [float(watch.look(float(f[0]), x.copy(), g))]

        arguments = [(name, ca.Sparsity.dense(*sizes[name])) for name in names]
        iteration = Oracle("watch", arguments, [("stop", ca.Sparsity.dense(1, 1))], look, trouble)
        solver = self._solver(functions, iteration, tolerance, most)
        if self.interrupt.error is None:
            with one_solver():
                result = solver(x0=start, lbx=lower, ubx=upper, lbg=functions.lower, ubg=functions.upper)
        if self.interrupt.error is not None:
            raise self.interrupt.error
        if trouble.defect is not None:
            raise trouble.defect
        unknowns, stats = np.asarray(result["x"], float).ravel(), solver.stats()
        status = _BY_IPOPT.get(str(stats["return_status"]), FitStatus.SOLVER_FAILED)
        if stats["return_status"] == "User_Requested_Stop" and watch.status is not None:
            status = watch.status
        if not np.isfinite(unknowns).all():
            unknowns, status = np.asarray(start, float), FitStatus.OVERFLOW
        rest = watch.rest[1] if np.array_equal(watch.rest[0], unknowns) else np.inf
        return Solution(unknowns, status, int(stats["iter_count"]), tuple(watch.history), rest, trouble.points), watch

    def at_rest(self, solution: Solution, most: int) -> Solution:
        """Return a solution with its first-order optimality, after further iterations if it has not settled."""
        problem, rest, limit = self.problem, solution.rest, TOLERANCES
        if not np.isfinite(rest):  # else the watch has looked already
            rest = distance_from_rest(problem, solution.unknowns)
        if not solution.status.success or rest <= limit.rest:
            return replace(solution, rest=rest)
        if any(problem.parts_at_edge(problem.unpack(solution.unknowns)[0])):
            return replace(solution, rest=rest)
        if solution.status is FitStatus.CONVERGED_BY_PAPER_RULE:
            stalled = rest > limit.rest_by_paper
            return replace(solution, rest=rest, status=FitStatus.STALLED if stalled else solution.status)
        left = max(1, most - solution.iterations)
        tolerance = limit.solver * limit.tighter
        last, _ = self.run(solution.unknowns, left, tolerance=tolerance, earlier=solution.history)
        rest = distance_from_rest(problem, last.unknowns)
        status = FitStatus.STALLED if last.status.success and rest > limit.rest else last.status
        return _continued(solution, replace(last, status=status, rest=rest))

    def _solver(self, functions: NlpFunctions, iteration: ca.Callback, tolerance: float, most: int) -> ca.Function:
        """Return a solver with a callback at each iteration; it must not outlive the functions."""
        ipopt, x = self.options.ipopt or {}, ca.MX.sym("x", self.problem.n_unknowns)
        f, g = functions.value(x)
        options: dict[str, Any] = {
            **functions.derivatives,
            "iteration_callback": iteration,
            "print_time": False,
            "error_on_fail": False,
            "show_eval_warnings": False,
            "ipopt": {
                "print_level": 0,
                "sb": "yes",
                "tol": tolerance,
                "constr_viol_tol": tolerance,
                "dual_inf_tol": tolerance,
                "acceptable_tol": 10 * tolerance,
                "acceptable_iter": 15,
                "max_iter": most,
                "nlp_scaling_method": "none",
                "mu_init": 1e-6,
                "bound_push": 1e-8,
                "bound_frac": 1e-8,
                "bound_relax_factor": 0.0,
                "mumps_pivot_order": 0,  # approximate minimum degree: analysed sooner, and as good for an arrow
                **ipopt,
            },
        }
        try:
            return ca.nlpsol("fit", "ipopt", {"x": x, "f": f, "g": g}, options)
        except RuntimeError as error:
            if not ipopt:
                raise
            raise UsageError(f"ipopt = {dict(ipopt)}: {str(error).splitlines()[-1].strip()}") from None


@contextmanager
def _interruptible() -> Iterator[Interrupt]:
    """Return a context in which Ctrl-C ends the solver at its next iteration, not within a callback.

    Nothing changes where Ctrl-C is ignored already, as in a worker process, which its runner stops.
    """
    interrupt = Interrupt()
    handles_interrupt = (
        threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) != signal.SIG_IGN
    )
    if not handles_interrupt:
        yield interrupt
        return

    def note(_signal: int, _frame: Any) -> None:
        interrupt.error = KeyboardInterrupt()

    previous = signal.signal(signal.SIGINT, note)
    try:
        yield interrupt
    finally:
        signal.signal(signal.SIGINT, previous)
