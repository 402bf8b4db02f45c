"""Fit of a structure to recordings, from the arguments to the result."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from gbid.arrays import FloatArray
from gbid.discretise import Hold, check_holds
from gbid.errors import UsageError
from gbid.identify.attempts import Attempt, Plan, best_attempt
from gbid.identify.disturbances.asked import TrendName
from gbid.identify.kernel.engine import EngineName
from gbid.identify.nlp.shooting import Criterion, Shooting
from gbid.identify.nlp.solver import IpoptOptions, Solution, solve
from gbid.identify.nlp.watch import Progress, Stop
from gbid.identify.nonlinear.integration import integrated_finely, with_integration_error
from gbid.identify.options import FitOptions
from gbid.identify.other_gains import lowest_of_several, strongly_coloured
from gbid.identify.outcome import outcome, overflow_notes
from gbid.identify.predictor import Focus
from gbid.identify.problem.asked_extra import Constraints, ExtraCost, extra_notes
from gbid.identify.problem.assembly import Scope, automatic_window
from gbid.identify.problem.initial_states import InitialState
from gbid.identify.problem.request import check_choices, request
from gbid.identify.problem.scaling import window_length
from gbid.identify.problem.undriven import decay_notes
from gbid.identify.result import FitResult
from gbid.identify.robust.loss import LossName, robust_loss
from gbid.identify.robust.reweighting import reweighted_solution
from gbid.identify.start.settled_start import settled_start
from gbid.identify.uncertainty.bootstrap import StdName, asked_bootstrap
from gbid.recording import Recording
from gbid.recording.argument_order import check_order
from gbid.structure import AnyStructure, NonlinearStructure, ScheduledStructure, symbolic_matrices
from gbid.structure.asked_once import asked_once
from gbid.threads import one_blas_thread

_ENOUGH_ITERATIONS = 50  # with fewer, what the caller wants is the way from the start, not another start


@asked_once()
def fit(
    structure: AnyStructure,
    recordings: Recording | Sequence[Recording],
    *,
    inputs: str | Sequence[str] | None = None,
    outputs: str | Sequence[str] | None = None,
    focus: Focus = "prediction",
    intersample: Hold | Sequence[Hold] | None = None,
    criterion: Criterion | Literal["auto"] = "auto",
    horizon: int = 1,
    output_weights: Sequence[float] | None = None,
    start: Mapping[str, float] | Literal["data"] | None = None,
    fixed: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    extra_cost: ExtraCost | None = None,
    constraints: Constraints | None = None,
    local: Mapping[str, Scope] | None = None,
    offsets: bool = False,
    robust: LossName | None = None,
    robust_threshold: float | None = None,
    std: StdName = "auto",
    bootstrap_draws: int | None = None,
    bootstrap_seed: int | None = None,
    trend: TrendName | Mapping[str, TrendName] = "none",
    hum: float | Sequence[float] = (),
    initial_state: InitialState = "auto",
    left_out: Mapping[str, Sequence[tuple[int, int]]] | None = None,
    window: int | Literal["auto"] | None = "auto",
    stop: Stop = "tolerance",
    max_iterations: int = 100,
    scaling: bool = True,
    engine: EngineName = "auto",
    progress: Callable[[Progress], None] | None = None,
    ipopt: IpoptOptions | None = None,
) -> FitResult:
    """Return the fit of a structure to recordings by prediction errors (paper, Eq. 15) with multiple shooting.

    Parameters
    ----------
    structure : Structure or NonlinearStructure
        `RotorBearing`, `PiezoPair`, `Plant`, or a user's `LinearStructure` or `NonlinearStructure`; what
        `scheduled` makes of linear ones, for recordings in which scheduling variables change.
    recordings : Recording or sequence of Recording
        Recordings to fit. They share all parameters except those in `local`; each has its own initial state.
    inputs, outputs : str or sequence of str, optional
        Signals (``"p"``) or channels (``"p.x"``) of the recordings; by default those of the structure. ``inputs=()`` is
        a free decay: the inputs of the structure are zero throughout. An input that is zero or constant in a recording
        means the same there.
    focus : {"prediction", "simulation"}
        Errors of the prediction with the disturbance gain, or of the simulation without measured outputs.
    intersample : {"zoh", "foh"} or sequence, optional
        Behaviour of the inputs between samples; by default that of the structure.
    criterion : {"auto", "trace", "det"}
        Mean squared error summed over outputs (the paper's), or determinant of the mean square matrix of the errors,
        which weights each output by its errors. "auto" is "det" for several outputs without `output_weights`.
    horizon : int
        Number of steps of the prediction; 1 in the paper.
    output_weights : sequence of float, optional
        Weight of the squared error of each output in the trace; default ones.
    start : dict of str to float, or "data", optional
        Start values. Others come from the structure, or from the data where the structure states none. With "data" all
        come from the data, also those that the structure states.
    fixed : dict of str to float, optional
        Parameters with fixed values. A disturbance gain fixed at 0 is left out of the model.
    bounds : dict of str to (lower, upper), optional
        Bounds that replace those of the structure.
    prior : dict of str to (value, std), optional
        Prior knowledge of parameters as normal distributions, in the units of the parameters.
    extra_cost : callable, optional
        ``extra_cost(p, x0)`` returns a CasADi expression that is added to the negative log-likelihood. `p` has the
        parameters by name, ``x0["run 1"]`` is the initial state of a recording. ``((p.k - 3) / 0.1) ** 2 / 2`` is the
        prior ``(3, 0.1)`` of k.
    constraints : callable, optional
        ``constraints(p, x0)`` returns a list of ``(lower, expression, upper)``. Equal bounds are an equation.
    local : dict of str to {"recording", "operating_point"}, optional
        Parameters with a separate value for each recording or operating point.
    offsets : bool
        Whether a constant offset of each output is estimated for each recording; the same as ``trend="offset"``.
    robust : {"huber", "student"}, optional
        Loss for data with outliers; by default squared errors. A sample counts less the larger its errors are compared
        with the others. The loss and `error_covariance` of the result are those of all samples, as without it.
    robust_threshold : float, optional
        Huber: errors in standard deviations up to which a sample counts in full. Student: degrees of freedom. By
        default the standard deviations are 2.6 % larger than with squared errors, when the errors are normal.
    std : {"auto", "bootstrap"}
        Standard deviations. "auto": those for white errors, or robust ones where the residuals are not white.
        "bootstrap": the robust ones times a factor for each parameter, so that 95 % intervals hold for errors that are
        drawn from the model of the residuals. It takes the time of as many robust standard deviations as draws.
    bootstrap_draws, bootstrap_seed : int, optional
        Number of draws, at least 50 (default 200), and seed of the random numbers (default 0). The same seed gives the
        same standard deviations.
    trend : {"none", "offset", "linear", "random walk"}, int or dict
        Trend of the outputs, estimated along for each recording: a polynomial of time of this degree (0 to 9), or an
        offset that is a random walk, whose gain is estimated. A dict has an entry for each output channel with a trend.
    hum : float or sequence of float
        Known frequencies [Hz] of sinusoids in all outputs, whose amplitudes are estimated along for each recording.
    initial_state : {"auto", "estimated", "zero", "structure"}, sequence or dict
        Initial state of each recording: estimated, or ``x0`` of the structure, a function of the parameters. "auto" is
        "structure" when the structure gives `x0`, else "estimated"; in a `ClosedLoop` delays begin at rest. A
        sequence has a number, ``"estimated"`` or ``"structure"`` for each state. A dict gives one of these to each
        recording by name.
    left_out : dict of str to sequence of (start, stop), optional
        Samples of recordings, by name, whose errors do not count (a rub, a dropout). The model is simulated there.
    window : int, None or "auto"
        Number of samples in a shooting window; None is single shooting. "auto" is about 256 (prediction) or 128
        (simulation), and tries other lengths when that fit does not converge. In an unstable model they are shorter, so
        that it grows tenfold at most in one.
    stop : {"tolerance", "paper"}
        "tolerance": steps far below the uncertainty of the estimates, or the tolerance of IPOPT. "paper": relative
        change below 1e-4.
    max_iterations : int
        Largest number of iterations.
    scaling : bool
        Whether unknowns are scaled to the order of one; false is for tests only.
    engine : {"auto", "compiled", "numpy"}
        Engine of the pass over the samples; "auto" compiles it if there is a C compiler.
    progress : callable, optional
        Function that is called with a `Progress` at each iteration. What it raises ends the fit, and is raised again.
    ipopt : dict, optional
        Options of IPOPT by name, such as ``{"print_level": 5}``. They replace those of gbid.

    Returns
    -------
    FitResult
        The result, also when the solver did not converge; see `status` and `success`.

    Raises
    ------
    UsageError
        When a name or option is unknown, bounds exclude a start value, or the matrices of the structure have wrong
        shapes.
    DataError
        When the recordings are not sufficient for the fit, or do not determine a parameter because no input moves.
    KeyboardInterrupt
        After Ctrl-C.
    """
    began = time.perf_counter()
    _check_options(stop, window, max_iterations)
    check_order(structure, "fit(structure, recordings)")
    asked = request(
        structure,
        recordings,
        {
            "inputs": inputs,
            "outputs": outputs,
            "focus": focus,
            "intersample": intersample,
            "criterion": criterion,
            "horizon": horizon,
            "output_weights": output_weights,
            "start": start,
            "fixed": fixed,
            "bounds": bounds,
            "prior": prior,
            "extra_cost": extra_cost,
            "constraints": constraints,
            "local": local,
            "offsets": offsets,
            "trend": trend,
            "hum": hum,
            "initial_state": initial_state,
            "left_out": left_out,
            "scaling": scaling,
            "engine": engine,
        },
    )
    structure, data, first = asked.structure, asked.data, asked.first
    loss = robust_loss(robust, robust_threshold, len(data.output_names))
    bootstrap = asked_bootstrap(std, bootstrap_draws, bootstrap_seed)
    begin = first.values

    def attempt(
        own: Mapping[str, float], samples: int | None, gain_held: bool = False, unstable: bool = True
    ) -> Attempt:
        posed = asked.posed(own, samples, gain_held=gain_held)
        problem, box = posed.problem, (posed.lower, posed.upper)
        rate = problem.rate(*problem.unpack(posed.unknowns))
        if plan.grows(rate) and not unstable:
            return Attempt(None, rate, False)

        def run(start: FloatArray, posed: Shooting = problem) -> Solution:
            limit = max_iterations
            return solve(posed, start, *box, stop=stop, max_iterations=limit, progress=progress, ipopt=ipopt)

        solution, more = lowest_of_several(problem, run(np.clip(posed.unknowns, *box)), box, run)
        problem, solution, shift = integrated_finely(problem, solution, box, run)
        light = None
        if loss is not None and solution.status.success:
            light, solution = reweighted_solution(problem, solution, loss, run)
        options = FitOptions(
            inputs=asked.inputs,
            outputs=asked.outputs,
            focus=focus,
            horizon=horizon,
            intersample=check_holds(asked.intersample, len(data.input_names)),
            criterion=asked.criterion,
            stop=stop,
            initial_state=asked.states.word,
            disturbances=asked.disturbances,
            robust=loss,
            window=None if samples is None else window_length(problem),
            engine=posed.assembly.engine,
            bootstrap=bootstrap,
            schedule=asked.courses.schedule if asked.courses else None,
        )
        moved = {name: word if own[name] == begin[name] else "data" for name, word in first.origin.items()}
        result = outcome(
            structure,
            posed.parameters,
            data,
            posed.assembly,
            problem,
            solution,
            posed.begin,
            moved,
            options,
            asked.states,
            light,
        )
        notes = (*more, *first.notes, *asked.states.notes, *overflow_notes(solution.overflows), *decay_notes(data))
        notes = (*notes, *extra_notes(problem, solution.unknowns))
        result = with_integration_error(replace(result, notes=(*result.notes, *notes)), shift)
        doubtful = result.trusted != "white" and strongly_coloured(problem, solution.unknowns)
        return Attempt(result, problem.rate(*problem.unpack(solution.unknowns)), doubtful)

    def settle() -> dict[str, float] | None:
        if (
            isinstance(structure, NonlinearStructure | ScheduledStructure)
            or symbolic_matrices(structure)[1].feedback is not None
        ):
            return None  # an observer is for linear models in continuous time, with constant parameters
        own, hold = (structure, asked.parameters, begin, asked.undisturbed), asked.intersample
        moved = settled_start(*own, intersample=hold, left_out=left_out or {}, engine=engine)
        return moved and {q.name: float(np.clip(moved[q.name], q.lower, q.upper)) for q in asked.parameters}

    usual = automatic_window(data, focus)
    plan = Plan(
        attempt,
        settle,
        (usual, max(16, usual // 2), 4 * usual) if window == "auto" else (window,),
        adapts=window == "auto",
        longest=max(record.n_samples for record in data.records),
        n_samples=data.n_samples,
        may_move=max_iterations >= _ENOUGH_ITERATIONS and ("data" not in first.origin.values() or bool(first.notes)),
    )
    # Matrices are small: several BLAS threads would be slower. An unstable start overflows; the status reports it.
    with one_blas_thread(), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        result = best_attempt(plan, begin)
    return replace(result, wall_time_s=time.perf_counter() - began)


def _check_options(stop: str, window: int | str | None, max_iterations: int) -> None:
    check_choices({"stop": (stop, ("tolerance", "paper"))})
    if window != "auto" and window is not None and (isinstance(window, str) or window < 2):
        raise UsageError(f"window = {window}; a shooting window needs at least 2 samples, or None for one window")
    if max_iterations < 1:
        raise UsageError(f"max_iterations = {max_iterations}; it must be at least 1")
