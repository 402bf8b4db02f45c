"""Fit of a structure to recordings, from the arguments to the result."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from gbid.core.arrays import BoolArray, FloatArray, one_blas_thread
from gbid.core.errors import UsageError
from gbid.core.notes import FitNote
from gbid.discretise import Hold, check_holds
from gbid.identify.data import FitData, column_means
from gbid.identify.disturbances import TrendName
from gbid.identify.predictor import Focus
from gbid.identify.problem.asked import Constraints, ExtraCost, extra_notes
from gbid.identify.problem.assemble import Assembly, Scope, automatic_window, window_length
from gbid.identify.problem.integration import at_working_point, integrated_finely, with_integration_error
from gbid.identify.problem.nlp import Criterion, Shooting
from gbid.identify.problem.solve import IpoptOptions, Progress, Solution, Stop, solve
from gbid.identify.problem.states import InitialState, InitialStates, decay_notes, released_states
from gbid.identify.request import check_choices, request
from gbid.identify.restarts import Attempt, Plan, best_attempt, lowest_of_several, strongly_coloured
from gbid.identify.result import FitOptions, FitResult, StdKind
from gbid.identify.robust import LossName, Reweighted, reweighted_solution, robust_loss
from gbid.identify.start.scheduled_start import centre_tie
from gbid.identify.start.start import settled_start
from gbid.identify.uncertainty.coloured import Bootstrap, StdName, asked_bootstrap, whiteness_test
from gbid.identify.uncertainty.covariance import FLATTEST, Covariance, covariance, model_spreads
from gbid.identify.uncertainty.doubts import (
    explains_nothing,
    far_below_white,
    feedback_notes,
    hardly_determined,
    may_cover_less,
    not_determined,
    verdict,
)
from gbid.recording import Recording
from gbid.recording.recording import check_order
from gbid.structure import (
    AnyStructure,
    Parameter,
    kind_of,
    symbolic_matrices,
)
from gbid.structure.parameter import asked_once

# ---- Evaluation of a fit at the solution: estimates, their uncertainty, status and notes.

_COLOURED = 0.01  # significance level of the whiteness test, shared by the outputs
_NEAR = 1e-6  # largest distance from a bound at which a parameter lies on it, as a part of the parameter's scale
_NEAR_IN_STD = 1e-3  # the same as a part of its standard deviation


def outcome(
    structure: AnyStructure,
    parameters: tuple[Parameter, ...],
    data: FitData,
    assembly: Assembly,
    problem: Shooting,
    solution: Solution,
    begin: Mapping[str, float],
    origin: Mapping[str, str],
    options: FitOptions,
    states: InitialStates,
    light: Reweighted | None = None,
) -> FitResult:
    """Return the result of a fit, evaluated at the solution.

    Parameters
    ----------
    structure, parameters, data, assembly, problem
        Model, data and nonlinear programme of the fit.
    solution : Solution
        Last iterate of the solver, with its status.
    begin : dict of str to float
        Start values by full name.
    origin : dict of str to str
        Origin of each start value.
    options : FitOptions
        Options of the fit.
    states : InitialStates
        Initial states: estimated, fixed, or functions of the parameters.
    light : Reweighted, optional
        Problem with the weights of a robust loss; its solution is `solution`.

    Returns
    -------
    FitResult
        The result, without its wall time.
    """
    free = assembly.free
    theta, starts = problem.unpack(solution.unknowns)
    values = problem.values(theta)
    errors = problem.errors(values, starts)
    every = _by_record(problem, errors, assembly)  # outliers count in full
    counted = _by_record(problem, [part.blocks.used[:, :, None] for part in problem.parts], assembly)
    if light is not None:
        problem = light.problem
        errors = problem.errors(values, starts)
    products = np.asarray(sum(np.einsum("gkyw,gkzw->yz", e, e) for e in errors))
    finite = np.isfinite(products).all() and np.isfinite(theta).all()
    n_records, n_states = states.known.shape
    settled = np.hstack([states.known, np.zeros((n_records, problem.n_states - n_states), bool)])
    by_record = _by_record(problem, errors, assembly)
    whole = np.asarray(sum(e.T @ e for e in every))
    worse = bool(finite) and explains_nothing(problem, whole, _counted_outputs(data, counted))
    white = whiteness_test(by_record)
    sound = bool(finite) and not worse
    coloured = not (sound and (white.p_value >= _COLOURED / len(white.p_value)).all())
    bootstrap = options.bootstrap if sound and solution.status.success else None
    trusted: StdKind = "bootstrap" if bootstrap else "robust" if coloured else "white"

    def uncertainty(on_bound: BoolArray) -> Covariance:
        own = _covariance(problem, theta, starts, assembly, products, on_bound, settled, coloured, bootstrap)
        return own if light is None else own.scaled(*light.factors)

    on_bound = _on_bound(free, theta, _NEAR * problem.theta_scale)
    found = uncertainty(on_bound)
    pressed = on_bound | _on_bound(free, theta, _NEAR_IN_STD * np.sqrt(np.diag(found.white)))
    if (pressed != on_bound).any():  # the solver stops slightly inside of an active bound
        on_bound = pressed
        found = uncertainty(on_bound)
    chosen = {"white": found.white, "robust": found.robust, "bootstrap": found.bootstrap}[trusted]
    if chosen is None:
        trusted, chosen = "robust", found.robust

    estimates = {**begin, **dict.fromkeys(assembly.unused, 0.0)}
    estimates |= {q.name: float(v) for q, v in zip(free, theta, strict=True)}
    locals_of = _local_names(data, assembly)
    for name in {short for names in locals_of.values() for short in names}:
        estimates.pop(name, None)
    std = _standard_deviations(estimates, parameters, free, chosen, on_bound, found)
    mean_square = whole / problem.n_samples
    undetermined = ~on_bound & ~np.isfinite([std[q.name] for q in free])
    at_edge = bool(finite) and any(problem.parts_at_edge(theta))
    against = {"overflows": not finite, "worse_than_constant": worse, "at_edge": at_edge}
    status = verdict(solution.status, **against, undetermined=undetermined)
    units = {q.name: q.unit for q in parameters}
    units |= options.disturbances.units(data.output_units)
    own_name = {**dict(zip(estimates, estimates, strict=True)), **assembly.own_names}
    first = {**estimates, **{short: estimates[full] for short, full in assembly.record_names[0].items()}}
    own = [q.name for q in structure.parameters]
    kind = kind_of(structure)
    model = kind.model({name: first[name] for name in own}, data.input_names, data.output_names)
    if kind.nonlinear:
        model = at_working_point(model, problem, theta, starts, data)
    spreads = model_spreads(
        problem,
        theta,
        chosen,
        model,
        own,
        centre_tie(structure, problem.parts[0].predictor.free, [q.name for q in free]),
    )
    n, k = problem.n_samples, len(theta) + int((~settled).sum())
    first_states = starts[assembly.record_window] + released_states(problem, theta, assembly.record_window)
    log_det = float(np.linalg.slogdet(mean_square)[1]) if np.isfinite(mean_square).all() else np.nan
    return FitResult(
        structure=structure.name,
        recordings=tuple(record.name for record in data.records),
        parameters=estimates,
        std=std,
        units={name: units[own_name[name]] for name in estimates},
        free=tuple(q.name for q in free),
        covariance=chosen,
        covariance_white=found.white,
        covariance_robust=found.robust,
        covariance_bootstrap=found.bootstrap,
        trusted=trusted,
        whiteness=white.p_value if finite else np.full(len(products), np.nan),
        modes_std=spreads.modes,
        static_gain_std=spreads.static_gain,
        initial_states=first_states[:, : assembly.n_states],
        loss=float(np.trace(mean_square) if problem.criterion == "trace" else np.linalg.det(mean_square)),
        error_covariance=mean_square,
        fit_percent=_fit_percent(data, every, counted),
        aic=n * log_det + 2 * k,
        fpe=float(np.exp(log_det) * (1 + k / n) / max(1 - k / n, 1e-12)),
        condition=found.condition,
        status=status,
        optimality=solution.rest,
        iterations=solution.iterations,
        wall_time_s=0.0,
        start={name: begin[name] for name in estimates},
        start_origin={name: origin.get(own_name[name], "structure") for name in estimates},
        notes=(
            *_notes(assembly, begin, free, on_bound, found, trusted, coloured),
            *_doubts(problem, theta, structure, assembly, found),
            *(may_cover_less(found.models, model.modes(), data.sample_time, n) if coloured else ()),
            *(feedback_notes(data.records, by_record) if coloured and finite else ()),
            *_edge_note(at_edge),
            *_light_note(light),
        ),
        options=options,
        model=model,
        sample_time=data.sample_time,
        local_names=locals_of,
        model_slopes=spreads.slopes,
    )


def _by_record(problem: Shooting, errors: list[FloatArray], assembly: Assembly) -> list[FloatArray]:
    """Return the errors in the order of the samples of each record, (n_samples, n_y); zero for left-out samples."""
    by_window: dict[int, FloatArray] = {}
    for e, part, first in zip(errors, problem.parts, problem.first_window[:-1], strict=True):
        for window, rows in zip(part.blocks.segment_first, part.blocks.by_segment(e), strict=True):
            by_window[int(first + window)] = rows
    following = {int(a): int(b) for a, b in problem.links}
    records = []
    for window in assembly.record_window:
        stretches: list[FloatArray] = []
        at = int(window)
        while True:
            if at in by_window:
                stretches.append(by_window[at])
            if at not in following:
                break
            at = following[at]
        records.append(np.concatenate(stretches))
    return records


def _covariance(
    problem: Shooting,
    theta: FloatArray,
    starts: FloatArray,
    assembly: Assembly,
    products: FloatArray,
    on_bound: BoolArray,
    settled: BoolArray,
    coloured: bool,
    bootstrap: Bootstrap | None,
) -> Covariance:
    nothing = np.full((len(theta), len(theta)), np.nan)
    none = Covariance(nothing, nothing, np.nan, np.zeros((0, len(theta))), np.inf)
    if not np.isfinite(products).all():
        return none
    try:
        return covariance(
            problem,
            theta,
            starts,
            assembly.record_window,
            products,
            on_bound,
            known_starts=settled,
            coloured=coloured,
            bootstrap=bootstrap,
        )
    except np.linalg.LinAlgError:
        return none


def _on_bound(free: tuple[Parameter, ...], theta: FloatArray, near: FloatArray) -> BoolArray:
    return np.array(
        [v - q.lower <= s or q.upper - v <= s for q, v, s in zip(free, theta, near, strict=True)], dtype=bool
    )


def _local_names(data: FitData, assembly: Assembly) -> dict[str, dict[str, str]]:
    return {
        record.name: {short: full for short, full in names.items() if short != full}
        for record, names in zip(data.records, assembly.record_names, strict=True)
        if any(short != full for short, full in names.items())
    }


def _notes(
    assembly: Assembly,
    begin: Mapping[str, float],
    free: tuple[Parameter, ...],
    on_bound: BoolArray,
    found: Covariance,
    trusted: StdKind,
    coloured: bool,
) -> tuple[str, ...]:
    names = np.array([q.name for q in free])
    notes = [FitNote.ON_BOUND(f"{name} lies on a bound: no standard deviation") for name in names[on_bound]]
    notes += not_determined(found.undetermined, names)
    if coloured:
        kind = "those of the bootstrap" if trusted == "bootstrap" else "the robust ones"
        notes.append(
            FitNote.NOT_WHITE(
                f"the residuals are not white: standard deviations are {kind}, and do not contain the error of the "
                "structure itself"
            )
        )
    if not np.isnan(found.flatness) and found.flatness < FLATTEST:
        notes.append(
            FitNote.NO_MINIMUM(
                "this is not a minimum of the criterion, or it is flat in some direction: standard deviations use the "
                "Gauss-Newton curvature, and are too small; try other start values (fit_multistart)"
            )
        )
    if assembly.unused:
        notes.append(FitNote.NOT_USED(f"simulation focus does not use, set to 0: {', '.join(assembly.unused)}"))
        held = [name for name in assembly.unused if begin[name] != 0]
        notes += [FitNote.NOT_USED(f"their start values were not used: {', '.join(held)}")] if held else []
    return (*notes, *assembly.notes)


def overflow_notes(points: int) -> tuple[str, ...]:
    """Return a note on the points at which the model overflowed, none for none."""
    text = f"the model overflows at {points} of the points that the solver tried; it stepped back"
    return (FitNote.OVERFLOWS(text),) if points else ()


def _doubts(
    problem: Shooting,
    theta: FloatArray,
    structure: AnyStructure,
    assembly: Assembly,
    found: Covariance,
) -> tuple[str, ...]:
    names = np.array([q.name for q in assembly.free])
    known, own = {q.name for q in structure.parameters}, assembly.own_names
    if scheduled := kind_of(structure).scheduled:  # a coefficient may well be zero, too
        known &= {q.name for q in scheduled.base.parameters}
    # A disturbance gain or a trend may well be zero: an open sign says nothing there.
    physical = np.array([own.get(name, name) in known and i not in problem.noise for i, name in enumerate(names)], bool)
    physical &= ~np.asarray((np.abs(found.undetermined) > 1e-3).any(axis=0))
    white = found.white[np.ix_(physical, physical)]
    return (*hardly_determined(theta[physical], white, names[physical]), *far_below_white(found, names))


def _edge_note(at_edge: bool) -> tuple[str, ...]:
    if not at_edge:
        return ()
    text = (
        "the disturbance gain makes the predictor almost unstable: the record is too short to estimate it; "
        "fix it (fixed=...) or use focus='simulation'"
    )
    return (FitNote.PREDICTOR_AT_EDGE(text),)


def _light_note(light: Reweighted | None) -> tuple[str, ...]:
    if light is None or not light.light:
        return ()
    return (f"robust loss: {100 * light.light:.2g} % of the samples count less than half",)


def _standard_deviations(
    estimates: Mapping[str, float],
    parameters: tuple[Parameter, ...],
    free: tuple[Parameter, ...],
    chosen: FloatArray,
    on_bound: BoolArray,
    found: Covariance,
) -> dict[str, float]:
    fixed = {q.name for q in parameters if q.fixed}
    std = {name: 0.0 if name in fixed else np.nan for name in estimates}
    dark = np.asarray((np.abs(found.undetermined) > 1e-3).any(axis=0))
    for i, q in enumerate(free):
        if not (on_bound[i] or dark[i]):
            std[q.name] = float(np.sqrt(chosen[i, i]))
    return std


def _fit_percent(data: FitData, errors: list[FloatArray], counted: list[FloatArray]) -> FloatArray:
    rows = []
    for e, y in zip(errors, _counted_outputs(data, counted), strict=True):
        left, whole = (np.linalg.norm(np.ascontiguousarray(part.T), axis=1) for part in (e, y - column_means(y)))
        rows.append(100 * (1 - left / whole))
    return np.array(rows)


def _counted_outputs(data: FitData, counted: list[FloatArray]) -> list[FloatArray]:
    """Return the outputs of each record that are in the cost, (n_samples, n_y)."""
    pairs = zip(data.records, counted, strict=True)
    return [r.outputs.compress(used[:, 0] > 0, axis=0) for r, used in pairs]


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
    output_weights: Sequence[float] | None = None,
    start: Mapping[str, float] | Literal["data"] | None = None,
    fixed: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    extra_cost: ExtraCost | None = None,
    constraints: Constraints | None = None,
    local: Mapping[str, Scope] | None = None,
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
            "output_weights": output_weights,
            "start": start,
            "fixed": fixed,
            "bounds": bounds,
            "prior": prior,
            "extra_cost": extra_cost,
            "constraints": constraints,
            "local": local,
            "trend": trend,
            "hum": hum,
            "initial_state": initial_state,
            "left_out": left_out,
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
        linear = kind_of(structure).linear
        if linear is None or symbolic_matrices(linear)[1].feedback is not None:
            return None  # an observer is for linear models in continuous time, with constant parameters
        own, hold = (linear, asked.parameters, begin, asked.undisturbed), asked.intersample
        moved = settled_start(*own, intersample=hold, left_out=left_out or {})
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
