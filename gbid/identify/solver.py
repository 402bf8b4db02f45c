"""IPOPT on the shooting problem."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np
import numpy.typing as npt

from gbid.identify.shooting import Iterate, Pattern, Shooting

FloatArray = npt.NDArray[np.float64]
Stop = Literal["tolerance", "paper"]
PAPER_TOLERANCE = 1e-4
_GAP_TOLERANCE = 1e-6  # of the scaled states, before the paper's stopping rule is believed
_STEP_TOLERANCE = 1e-4  # of the estimates' joint standard deviation: nothing that the data could tell is left
_PATIENCE = 5  # iterations that a predictor may be unstable on the way
_NEAR = 1.0  # standard deviations: a step below it says that the basin of the minimum is reached
_NEAR_GAP = 1e-2
_EXACT_GAP = 1e-9  # the same for a fit without errors, whose gradient is rounding and tells nothing more

UNSTABLE = (
    "not converged: the disturbance gain makes the predictor unstable; hold it (fixed) or use focus = 'simulation'"
)

_WORDS = {
    "Solve_Succeeded": "converged",
    "Solved_To_Acceptable_Level": "converged to the solver's acceptable tolerance only",
    "Feasible_Point_Found": "converged",
    "Maximum_Iterations_Exceeded": "not converged: iteration limit reached",
    "Restoration_Failed": "not converged: no step closes the gaps between windows; try other start values",
    "Infeasible_Problem_Detected": "not converged: the gaps between windows cannot be closed; try other start values",
    "Search_Direction_Becomes_Too_Small": "not converged: steps became too small; a parameter may not be determined",
    "Diverging_Iterates": "not converged: the iterates diverge; check bounds and start values",
    "Invalid_Number_Detected": "not converged: the predictor overflows; start from a stable model",
    "Error_In_Step_Computation": "not converged: the step cannot be computed; a parameter may not be determined",
}


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


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the solver stopped, and why.

    Attributes
    ----------
    unknowns : (n_unknowns,) array
        Scaled.
    status : str
        In words.
    success : bool
    iterations : int
    history : tuple of Progress
    """

    unknowns: FloatArray
    status: str
    success: bool
    iterations: int
    history: tuple[Progress, ...]


def solve(
    problem: Shooting,
    start: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    *,
    stop: Stop = "tolerance",
    tolerance: float = 1e-6,
    max_iterations: int = 100,
    progress: Callable[[Progress], None] | None = None,
) -> Solution:
    """Minimise the cost with all gaps closed.

    Parameters
    ----------
    problem : Shooting
    start, lower, upper : (n_unknowns,) array
        Start and bounds, scaled.
    stop : {"tolerance", "paper"}
        IPOPT's own test or a step far below the estimates' standard deviations, whichever is met first; or the
        paper's: the relative change of the parameters below 1e-4 (Sec. 3.6).
    tolerance : float
        IPOPT's tolerance on the scaled optimality conditions.
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
    """
    n, m = problem.n_unknowns, problem.n_gaps
    vector, scalar, empty = ca.Sparsity.dense(n, 1), ca.Sparsity.dense(1, 1), ca.Sparsity(0, 0)
    gaps = ca.Sparsity.dense(m, 1)
    jacobian, hessian = _sparsity(problem.jacobian_pattern), _sparsity(problem.hessian_pattern)
    point = [("x", vector), ("p", empty)]
    multipliers = [("lam_f", scalar), ("lam_g", gaps)]

    def flat(values: ca.DM) -> FloatArray:
        return np.asarray(values, float).ravel()

    def curvature(x: FloatArray, lam_f: float, lam_g: FloatArray) -> FloatArray:
        return problem.hessian(x, lam_f, lam_g) if watch.near else lam_f * problem.at(x).hessian

    def at(x: ca.DM) -> Iterate:
        return problem.at(flat(x))

    def column(values: FloatArray) -> ca.DM:
        return ca.DM(gaps, values)

    value = _Oracle("nlp", [("x", vector)], [("f", scalar), ("g", gaps)], lambda x: [at(x).cost, column(at(x).gaps)])
    gradient = _Oracle(
        "grad_f",
        point,
        [("f", scalar), ("grad_f_x", vector)],
        lambda x, _p: [at(x).cost, at(x).gradient],
    )
    jac = _Oracle(
        "jac_g",
        point,
        [("g", gaps), ("jac_g_x", jacobian)],
        lambda x, _p: [column(at(x).gaps), ca.DM(jacobian, at(x).jacobian)],
    )
    hess = _Oracle(
        "hess_lag",
        point + multipliers,
        [("triu_hess_gamma_x_x", hessian)],
        lambda x, _p, lam_f, lam_g: [ca.DM(hessian, curvature(flat(x), float(lam_f), flat(lam_g)))],
    )
    watch = _Watch(problem, stop, progress, n, m)
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
    with _interruptible(watch):
        result = solver(x0=start, lbx=lower, ubx=upper, lbg=0.0, ubg=0.0)
    if watch.interrupted:
        raise KeyboardInterrupt
    stats = solver.stats()
    status = str(stats["return_status"])
    if watch.settled and status == "User_Requested_Stop":
        words, success = f"converged: parameters changed by less than {PAPER_TOLERANCE:g} (the paper's rule)", True
    elif watch.unstable >= _PATIENCE and status == "User_Requested_Stop":
        words, success = UNSTABLE, False
    elif watch.at_rest and status == "User_Requested_Stop":
        words, success = "converged", True
    elif watch.exact and status == "User_Requested_Stop":
        words, success = "converged: the errors are at rounding", True
    else:
        words = _WORDS.get(status, f"not converged: IPOPT says {status}")
        success = words.startswith("converged")
    unknowns = np.asarray(result["x"], float).ravel()
    if not np.isfinite(unknowns).all():
        unknowns, success = np.asarray(start, float), False
    return Solution(unknowns, words, success, int(stats["iter_count"]), tuple(watch.history))


def _sparsity(pattern: Pattern) -> ca.Sparsity:
    """Return the pattern as CasADi keeps it: columns with rows in order."""
    counts = np.bincount(pattern.columns, minlength=pattern.shape[1])
    return ca.Sparsity(*pattern.shape, [0, *np.cumsum(counts).tolist()], pattern.rows.tolist())


class _Oracle(ca.Callback):
    """A Python function with named, shaped arguments, as CasADi wants it."""

    def __init__(
        self,
        name: str,
        inputs: Sequence[tuple[str, ca.Sparsity]],
        outputs: Sequence[tuple[str, ca.Sparsity]],
        function: Callable[..., list[Any]],
    ) -> None:
        ca.Callback.__init__(self)
        self._inputs, self._outputs, self._call = inputs, outputs, function
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

    def eval(self, arguments: Sequence[ca.DM]) -> list[Any]:
        return self._call(*arguments)


class _Watch(ca.Callback):
    """Called at each iteration: reports, applies the paper's stopping rule, answers Ctrl-C."""

    def __init__(
        self, problem: Shooting, stop: Stop, progress: Callable[[Progress], None] | None, n: int, m: int
    ) -> None:
        ca.Callback.__init__(self)
        self._problem, self._stop, self._progress = problem, stop, progress
        sizes = {"f": 1, "x": n, "g": m, "lam_x": n, "lam_g": m, "lam_p": 0}
        self._shapes = [
            ca.Sparsity.dense(sizes[name], 1) if name != "lam_p" else ca.Sparsity(0, 0)
            for name in map(ca.nlpsol_out, range(ca.nlpsol_n_out()))
        ]
        self.history: list[Progress] = []
        self.interrupted = False
        self.settled = False
        self.exact = False
        self.at_rest = False
        self.near = False
        self.unstable = 0
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

    def eval(self, arguments: Sequence[ca.DM]) -> list[int]:
        values = dict(zip((ca.nlpsol_out(i) for i in range(len(arguments))), arguments, strict=True))
        x = np.asarray(values["x"], float).ravel()
        gaps = np.asarray(values["g"], float)
        step = sigma = np.inf
        if self._previous is not None:
            moved, n_theta = x - self._previous, self._problem.n_theta
            step = float(np.linalg.norm(moved[:n_theta])) / max(float(np.linalg.norm(x[:n_theta])), 1e-300)
            sigma = self._in_standard_deviations(x, moved)
        gap = float(np.abs(gaps).max(initial=0.0))
        now = Progress(len(self.history), float(values["f"]), gap, step, sigma)
        self.history.append(now)
        if self._progress is not None:
            self._progress(now)
        self.settled = self._stop == "paper" and now.step < PAPER_TOLERANCE and now.gap < _GAP_TOLERANCE
        self.exact = now.cost <= self._problem.exact_cost and now.gap < _EXACT_GAP
        # Twice running: a step may be small by chance, where the solver has just cut it.
        small = self._stop == "tolerance" and max(sigma, self._sigma) < _STEP_TOLERANCE and now.gap < _GAP_TOLERANCE
        self.at_rest = small
        self.near = self.near or (sigma < _NEAR and now.gap < _NEAR_GAP)
        self._previous, self._sigma = x, sigma
        self.unstable = self.unstable + 1 if self._problem.noise and self._radius(x) > 1 else 0
        ended = self.settled or self.exact or self.at_rest
        return [int(self.interrupted or ended or self.unstable >= _PATIENCE)]

    def _radius(self, x: FloatArray) -> float:
        """Spectral radius of the predictors."""
        theta, _ = self._problem.unpack(x)
        transitions = [v.F for v in self._problem.values(theta)]
        if not all(np.isfinite(F).all() for F in transitions):
            return np.inf
        return max(float(np.abs(np.linalg.eigvals(F)).max()) for F in transitions)

    def _in_standard_deviations(self, x: FloatArray, moved: FloatArray) -> float:
        """Length of a step in the metric of the information at its end."""
        pattern, entries = self._problem.hessian_pattern, self._problem.at(x).hessian
        twice = np.where(pattern.rows == pattern.columns, 1.0, 2.0)
        square = float((twice * entries * moved[pattern.rows] * moved[pattern.columns]).sum())
        return float(np.sqrt(max(square, 0.0) * self._problem.likelihood_size)) if np.isfinite(square) else np.inf


@contextmanager
def _interruptible(watch: _Watch) -> Iterator[None]:
    """Let Ctrl-C end the solver at its next iteration, where all is in order, instead of within a callback."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def note(_signal: int, _frame: Any) -> None:
        watch.interrupted = True

    previous = signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
