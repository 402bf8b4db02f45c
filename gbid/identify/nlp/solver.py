"""IPOPT on the shooting problem."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.nlp.casadi_callback import Oracle, Trouble
from gbid.identify.nlp.hessian import Curvature, ExactHessian, GaussNewton
from gbid.identify.nlp.one_window import in_one_window, in_windows
from gbid.identify.nlp.optimality import distance_from_rest
from gbid.identify.nlp.patterns import Pattern
from gbid.identify.nlp.record_group import Iterate
from gbid.identify.nlp.shooting import Shooting
from gbid.identify.nlp.watch import PATIENCE, Interrupt, Progress, Stop, Watch
from gbid.identify.status import FitStatus
from gbid.threads import one_solver

_TOLERANCE = 1e-6  # of IPOPT on the scaled optimality conditions
_REST = 0.1  # standard deviations that the next step of a solution may still be long
_REST_BY_PAPER = 1.0  # the same for the paper's rule, which stops earlier
_TIGHTER = 1e-4  # of the tolerance, for a solution that has not come to rest

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
    """Last iterate of the solver, and the reason why it stopped.

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
    """

    unknowns: FloatArray
    status: FitStatus
    iterations: int
    history: tuple[Progress, ...]
    rest: float = np.inf
    overflows: int = 0


def solve(
    problem: Shooting,
    start: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    *,
    stop: Stop = "tolerance",
    max_iterations: int = 100,
    progress: Callable[[Progress], None] | None = None,
) -> Solution:
    """Minimise the cost with all gaps closed.

    Gauss-Newton in windows finds the basin. Where it creeps there, as with errors that are coloured, each segment
    becomes one window, and the Hessian gets what Gauss-Newton leaves out (`ExactHessian`).

    At the end the first-order optimality is checked. A solution that has not come to rest is solved on, with a tighter
    tolerance; one that still has not is no success.

    Parameters
    ----------
    problem : Shooting
    start, lower, upper : (n_unknowns,) array
        Start and bounds, scaled.
    stop : {"tolerance", "paper"}
        IPOPT's own test or a step far below the estimates' standard deviations, whichever is met first; or the
        paper's: the relative change of the parameters below 1e-4 (Sec. 3.6).
    max_iterations : int
    progress : callable, optional
        Called with each `Progress`.

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
    with _interruptible() as interrupt:
        watch = Watch(problem, stop, progress, interrupt, (lower, upper), changes_over=True)
        first = _run(problem, watch, (start, lower, upper), _TOLERANCE, max_iterations, GaussNewton(problem))
        if not watch.creeping:
            return _at_rest(problem, first, (lower, upper), interrupt, stop, max_iterations, progress, GaussNewton)
        joined, kept = in_one_window(problem)
        box = (first.unknowns[kept], lower[kept], upper[kept])
        watch = Watch(joined, stop, progress, interrupt, box[1:], earlier=first.history)
        last = _run(joined, watch, box, _TOLERANCE, max_iterations - first.iterations, ExactHessian(joined))
        left = max_iterations - first.iterations
        last = _at_rest(joined, last, box[1:], interrupt, stop, left, progress, ExactHessian)
    return replace(
        last,
        unknowns=in_windows(problem, joined, last.unknowns),
        iterations=first.iterations + last.iterations,
        overflows=first.overflows + last.overflows,
        history=(*first.history, *last.history[1:]),
    )


def _at_rest(
    problem: Shooting,
    solution: Solution,
    box: tuple[FloatArray, FloatArray],
    interrupt: Interrupt,
    stop: Stop,
    max_iterations: int,
    progress: Callable[[Progress], None] | None,
    curvature: Callable[[Shooting], Curvature],
) -> Solution:
    """Return a solution with its first-order optimality; one that has not come to rest is solved on first."""
    rest = distance_from_rest(problem, solution.unknowns, box)
    if not solution.status.success or rest <= _REST or any(problem.parts_at_edge(problem.unpack(solution.unknowns)[0])):
        return replace(solution, rest=rest)
    if solution.status is FitStatus.CONVERGED_BY_PAPER_RULE:
        return replace(solution, rest=rest, status=solution.status if rest <= _REST_BY_PAPER else FitStatus.STALLED)
    left = max(1, max_iterations - solution.iterations)
    watch = Watch(problem, stop, progress, interrupt, box, earlier=solution.history)
    last = _run(problem, watch, (solution.unknowns, *box), _TOLERANCE * _TIGHTER, left, curvature(problem))
    rest = distance_from_rest(problem, last.unknowns, box)
    status = FitStatus.STALLED if last.status.success and rest > _REST else last.status
    return replace(
        last,
        status=status,
        rest=rest,
        iterations=solution.iterations + last.iterations,
        overflows=solution.overflows + last.overflows,
        history=(*solution.history, *last.history[1:]),
    )


def _run(
    problem: Shooting,
    watch: Watch,
    box: tuple[FloatArray, FloatArray, FloatArray],
    tolerance: float,
    max_iterations: int,
    curvature: Curvature,
) -> Solution:
    """Run IPOPT once from a start within bounds."""
    start, lower, upper = box
    trouble = Trouble()
    solver, _alive = _ipopt(problem, watch, tolerance, max_iterations, curvature, trouble)
    if watch.interrupt.error is None:
        closed = np.zeros(problem.n_gaps)
        _, lowest, highest = problem.limits
        bounds = {"lbg": np.concatenate([closed, lowest]), "ubg": np.concatenate([closed, highest])}
        with one_solver():
            result = solver(x0=start, lbx=lower, ubx=upper, **bounds)
    if watch.interrupt.error is not None:
        raise watch.interrupt.error
    if trouble.defect is not None:
        raise trouble.defect
    unknowns = np.asarray(result["x"], float).ravel()
    status = _status(str(solver.stats()["return_status"]), watch)
    if not np.isfinite(unknowns).all():
        unknowns, status = np.asarray(start, float), FitStatus.OVERFLOW
    iterations = int(solver.stats()["iter_count"])
    return Solution(unknowns, status, iterations, tuple(watch.history), overflows=trouble.points)


def _ipopt(
    problem: Shooting, watch: Watch, tolerance: float, max_iterations: int, curvature: Curvature, trouble: Trouble
) -> tuple[ca.Function, list[Oracle]]:
    """Build the solver; also return the callbacks, which must outlive it."""
    n, m = problem.n_unknowns, problem.n_gaps
    vector, scalar, empty = ca.Sparsity.dense(n, 1), ca.Sparsity.dense(1, 1), ca.Sparsity(0, 0)
    limits = ca.sparsify(ca.DM(np.pad(problem.limits[0], ((0, 0), (0, n - problem.n_theta)))))
    constraints = ca.Sparsity.dense(m + limits.rows(), 1)
    gaps, hessian = _sparsity(problem.jacobian_pattern), _sparsity(problem.hessian_pattern)
    jacobian = ca.vertcat(gaps, limits.sparsity())
    point = [("x", vector), ("p", empty)]
    multipliers = [("lam_f", scalar), ("lam_g", constraints)]

    def flat(values: ca.DM) -> FloatArray:
        return np.asarray(values, float).ravel()

    def at(x: ca.DM) -> Iterate:
        return problem.at(flat(x))

    def held(x: ca.DM) -> ca.DM:
        return ca.vertcat(ca.DM(at(x).gaps), limits @ x)

    def cost(x: ca.DM) -> list[Any]:
        found = np.nan
        try:
            found = at(x).cost
            return [found, held(x)]
        finally:
            trouble.points += not np.isfinite(found)

    value = Oracle("nlp", [("x", vector)], [("f", scalar), ("g", constraints)], cost, trouble)
    gradient = Oracle(
        "grad_f",
        point,
        [("f", scalar), ("grad_f_x", vector)],
        lambda x, _p: [at(x).cost, at(x).gradient],
        trouble,
    )
    jac = Oracle(
        "jac_g",
        point,
        [("g", constraints), ("jac_g_x", jacobian)],
        lambda x, _p: [held(x), ca.vertcat(ca.DM(gaps, at(x).jacobian), limits)],
        trouble,
    )
    hess = Oracle(
        "hess_lag",
        point + multipliers,
        [("triu_hess_gamma_x_x", hessian)],
        lambda x, _p, lam_f, lam_g: [ca.DM(hessian, curvature(flat(x), float(lam_f), flat(lam_g)[:m]))],
        trouble,
    )
    x = ca.MX.sym("x", n)
    f, g = value(x)
    options: dict[str, Any] = {
        "no_nlp_grad": True,
        "grad_f": gradient,
        "jac_g": jac,
        "hess_lag": hess,
        "iteration_callback": watch,
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
            "max_iter": max_iterations,
            "nlp_scaling_method": "none",
            "mu_init": 1e-6,
            "bound_push": 1e-8,
            "bound_frac": 1e-8,
            "bound_relax_factor": 0.0,
        },
    }
    solver = ca.nlpsol("fit", "ipopt", {"x": x, "f": f, "g": g}, options)
    return solver, [value, gradient, jac, hess]


def _status(by_ipopt: str, watch: Watch) -> FitStatus:
    """Return the status: the reason of the watch if it stopped the solver, else that of IPOPT."""
    if by_ipopt == "User_Requested_Stop":
        if watch.settled:
            return FitStatus.CONVERGED_BY_PAPER_RULE
        if watch.unstable >= PATIENCE:
            return FitStatus.UNSTABLE_PREDICTOR
        if watch.stuck >= PATIENCE:
            return FitStatus.STEPS_TOO_SMALL
        if watch.at_rest:
            return FitStatus.CONVERGED
        if watch.exact:
            return FitStatus.CONVERGED_AT_ROUNDING
    return _BY_IPOPT.get(by_ipopt, FitStatus.SOLVER_FAILED)


def _sparsity(pattern: Pattern) -> ca.Sparsity:
    """Return the pattern as CasADi keeps it: columns with rows in order."""
    counts = np.bincount(pattern.columns, minlength=pattern.shape[1])
    return ca.Sparsity(*pattern.shape, [0, *np.cumsum(counts).tolist()], pattern.rows.tolist())


@contextmanager
def _interruptible() -> Iterator[Interrupt]:
    """Return a context in which Ctrl-C ends the solver at its next iteration instead of within a callback.

    Nothing changes where Ctrl-C is ignored already, as in a worker process, which its runner stops.
    """
    interrupt = Interrupt()
    heard = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) != signal.SIG_IGN
    if not heard:
        yield interrupt
        return

    def note(_signal: int, _frame: Any) -> None:
        interrupt.error = KeyboardInterrupt()

    previous = signal.signal(signal.SIGINT, note)
    try:
        yield interrupt
    finally:
        signal.signal(signal.SIGINT, previous)
