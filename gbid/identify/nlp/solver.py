"""IPOPT on the shooting problem."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.identify.nlp.functions.casadi_callback import Trouble
from gbid.identify.nlp.functions.nlp_functions import NlpFunctions, nlp_functions
from gbid.identify.nlp.hessian import Curvature, ExactHessian, GaussNewton
from gbid.identify.nlp.one_window import in_one_window, in_windows
from gbid.identify.nlp.optimality import distance_from_rest
from gbid.identify.nlp.shooting import Shooting
from gbid.identify.nlp.watch import PATIENCE, Interrupt, Progress, Stop, Watch
from gbid.identify.status import FitStatus
from gbid.threads import one_solver

IpoptOptions = Mapping[str, str | float]
"""Options of IPOPT by name; a whole number is a number, too."""

_TOLERANCE = 1e-6  # of IPOPT on the scaled optimality conditions
_REST = 0.1  # standard deviations that the next step of a solution may still be long
_REST_BY_PAPER = 1.0  # the same for the paper's rule, which stops earlier
_FARTHEST = 1e9  # times the largest gap of the start: what IPOPT tries beyond takes MUMPS seconds to factorise
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
    ipopt: IpoptOptions | None = None,
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
    ipopt : dict, optional
        Options of IPOPT that replace those of this module.

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
    given = ipopt or {}
    with _interruptible() as interrupt:
        watch = Watch(problem, stop, progress, interrupt, (lower, upper), changes_over=True)
        first = _run(problem, watch, (start, lower, upper), _TOLERANCE, max_iterations, GaussNewton(problem), given)
        if not watch.creeping:
            return _at_rest(
                problem, first, (lower, upper), interrupt, stop, max_iterations, progress, GaussNewton, given
            )
        joined, kept = in_one_window(problem)
        box = (first.unknowns[kept], lower[kept], upper[kept])
        watch = Watch(joined, stop, progress, interrupt, box[1:], earlier=first.history)
        left = max_iterations - first.iterations
        last = _run(joined, watch, box, _TOLERANCE, left, ExactHessian(joined), given)
        last = _at_rest(joined, last, box[1:], interrupt, stop, left, progress, ExactHessian, given)
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
    ipopt: IpoptOptions,
) -> Solution:
    """Return a solution with its first-order optimality; one that has not come to rest is solved on first."""
    known = np.isfinite(solution.rest)  # the watch has looked already
    rest = solution.rest if known else distance_from_rest(problem, solution.unknowns, box)
    if not solution.status.success or rest <= _REST or any(problem.parts_at_edge(problem.unpack(solution.unknowns)[0])):
        return replace(solution, rest=rest)
    if solution.status is FitStatus.CONVERGED_BY_PAPER_RULE:
        return replace(solution, rest=rest, status=solution.status if rest <= _REST_BY_PAPER else FitStatus.STALLED)
    left = max(1, max_iterations - solution.iterations)
    watch = Watch(problem, stop, progress, interrupt, box, earlier=solution.history)
    last = _run(problem, watch, (solution.unknowns, *box), _TOLERANCE * _TIGHTER, left, curvature(problem), ipopt)
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
    ipopt: IpoptOptions,
) -> Solution:
    """Run IPOPT once from a start within bounds."""
    start, lower, upper = box
    trouble = Trouble(most=_FARTHEST)
    solver, functions = _ipopt(problem, watch, tolerance, max_iterations, curvature, trouble, ipopt)
    if watch.interrupt.error is None:
        with one_solver():
            result = solver(x0=start, lbx=lower, ubx=upper, lbg=functions.lower, ubg=functions.upper)
    if watch.interrupt.error is not None:
        raise watch.interrupt.error
    if trouble.defect is not None:
        raise trouble.defect
    unknowns = np.asarray(result["x"], float).ravel()
    status = _status(str(solver.stats()["return_status"]), watch)
    if not np.isfinite(unknowns).all():
        unknowns, status = np.asarray(start, float), FitStatus.OVERFLOW
    iterations = int(solver.stats()["iter_count"])
    rest = watch.rest[1] if np.array_equal(watch.rest[0], unknowns) else np.inf
    return Solution(unknowns, status, iterations, tuple(watch.history), rest, trouble.points)


def _ipopt(
    problem: Shooting,
    watch: Watch,
    tolerance: float,
    max_iterations: int,
    curvature: Curvature,
    trouble: Trouble,
    ipopt: IpoptOptions,
) -> tuple[ca.Function, NlpFunctions]:
    """Build the solver; also return the callbacks, which must outlive it."""
    functions = nlp_functions(problem, curvature, trouble)
    x = ca.MX.sym("x", problem.n_unknowns)
    f, g = functions.value(x)
    options: dict[str, Any] = {
        **functions.derivatives,
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
            "mumps_pivot_order": 0,  # approximate minimum degree: analysed sooner, and as good for an arrow
            **ipopt,
        },
    }
    try:
        return ca.nlpsol("fit", "ipopt", {"x": x, "f": f, "g": g}, options), functions
    except RuntimeError as error:
        if not ipopt:
            raise
        raise UsageError(f"ipopt = {dict(ipopt)}: {str(error).splitlines()[-1].strip()}") from None


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
