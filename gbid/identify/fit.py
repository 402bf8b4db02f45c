"""The fit, start to end."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import inf

import numpy as np
import numpy.typing as npt

from gbid.discretise import Hold
from gbid.errors import UsageError
from gbid.identify.blocks import Blocks, cut
from gbid.identify.covariance import Covariance, covariance
from gbid.identify.data import FitData, gather
from gbid.identify.predictor import Focus, Predictor, build_predictor
from gbid.identify.result import FitResult
from gbid.identify.shooting import Criterion, Shooting
from gbid.identify.solver import Progress, Solution, Stop, solve
from gbid.identify.start import start_values
from gbid.identify.sweep import forced_states, residuals, sweep
from gbid.recording import Recording
from gbid.structure import Parameter, Structure, as_names, evaluate, known_names

FloatArray = npt.NDArray[np.float64]
DEFAULT_WINDOW = 500


def fit(
    structure: Structure,
    recordings: Recording | Sequence[Recording],
    *,
    inputs: str | Sequence[str] | None = None,
    outputs: str | Sequence[str] | None = None,
    focus: Focus = "prediction",
    intersample: Hold | Sequence[Hold] | None = None,
    criterion: Criterion = "trace",
    window: int | None = DEFAULT_WINDOW,
    start: Mapping[str, float] | None = None,
    fixed: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    stop: Stop = "tolerance",
    max_iterations: int = 100,
    scaling: bool = True,
    progress: Callable[[Progress], None] | None = None,
) -> FitResult:
    """Fit a structure to recordings by prediction errors (paper, Eq. 15) with multiple shooting.

    Parameters
    ----------
    structure : Structure
        `RotorBearing`, `PiezoPair`, `Plant` or a `LinearStructure` of one's own.
    recordings : Recording or sequence of Recording
        Parameters are shared by all; each has an initial state of its own.
    inputs, outputs : str or sequence of str, optional
        Signals (``"p"``) or channels (``"p.x"``) of the recordings; the structure's own when not given.
    focus : {"prediction", "simulation"}
        One-step-ahead errors with the disturbance gain, or errors of the model running on its own.
    intersample : {"zoh", "foh"} or sequence, optional
        Behaviour of the inputs between samples; the structure's own when not given.
    criterion : {"trace", "det"}
        Mean squared error summed over outputs, or the determinant of its matrix.
    window : int or None
        Samples in a shooting window; None is single shooting.
    start : dict of str to float, optional
        Start values; what is not given comes from the structure, and for the built-in ones from the data.
    fixed : dict of str to float, optional
        Parameters that keep a value.
    bounds : dict of str to (lower, upper), optional
        Bounds in place of the structure's.
    stop : {"tolerance", "paper"}
        IPOPT's tolerance (1e-6, scaled), or the paper's rule (relative change below 1e-4).
    max_iterations : int
    scaling : bool
        Whether unknowns are scaled to the order of one; only a test would say no.
    progress : callable, optional
        Called with a `Progress` at each iteration.

    Returns
    -------
    FitResult
        Also when the solver did not converge: `status` and `success` tell.

    Raises
    ------
    UsageError
        For unknown names or options, bounds that exclude a start, a structure whose matrices do not fit.
    DataError
        For recordings that cannot carry the fit.
    KeyboardInterrupt
        After Ctrl-C.
    """
    began = time.perf_counter()
    _check_options(focus, criterion, window, stop, max_iterations)
    recordings = [recordings] if isinstance(recordings, Recording) else list(recordings)
    in_names = as_names(structure.inputs if inputs is None else inputs)
    out_names = as_names(structure.outputs if outputs is None else outputs)
    hold = structure.intersample if intersample is None else intersample
    parameters = _with_options(structure.parameters, start or {}, fixed or {}, bounds or {})
    data = gather(recordings, in_names, out_names, minimum=len(parameters) + 10)

    stated = {q.name: q.start for q in parameters if q.start is not None}
    begin = _within(parameters, start_values(structure, data, stated), set(stated))
    held = {q.name: begin[q.name] for q in parameters if q.fixed}
    predictor = _predictor(structure, parameters, held, data, hold, focus, begin)
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable start overflows: the status says so
        problem, unknowns = _problem(predictor, data, window, criterion, begin, scaling)
    lower, upper = _bounds(problem)
    solution = solve(
        problem,
        np.clip(unknowns, lower, upper),
        lower,
        upper,
        stop=stop,
        max_iterations=max_iterations,
        progress=progress,
    )
    options = {
        "inputs": " ".join(in_names),
        "outputs": " ".join(out_names),
        "focus": focus,
        "intersample": hold if isinstance(hold, str) else " ".join(hold),
        "criterion": criterion,
        "window": "one per recording" if window is None else f"{problem.blocks.length * problem.blocks.per_window}",
        "stop": stop,
    }
    with np.errstate(over="ignore", invalid="ignore"):
        result = _result(structure, parameters, data, problem, solution, begin, options)
    return replace(result, wall_time_s=time.perf_counter() - began)


def _check_options(focus: str, criterion: str, window: int | None, stop: str, max_iterations: int) -> None:
    choices = {
        "focus": (focus, ("prediction", "simulation")),
        "criterion": (criterion, ("trace", "det")),
        "stop": (stop, ("tolerance", "paper")),
    }
    for name, (value, allowed) in choices.items():
        if value not in allowed:
            raise UsageError(f"{name} = {value!r}; choose {' or '.join(map(repr, allowed))}")
    if window is not None and window < 2:
        raise UsageError(f"window = {window}; a shooting window needs at least 2 samples, or None for one window")
    if max_iterations < 1:
        raise UsageError(f"max_iterations = {max_iterations}; it must be at least 1")


def _with_options(
    parameters: tuple[Parameter, ...],
    start: Mapping[str, float],
    fixed: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]],
) -> tuple[Parameter, ...]:
    """Put the caller's starts, fixed values and bounds in place of the structure's."""
    for what, given in (("start", start), ("fixed", fixed), ("bounds", bounds)):
        known_names(parameters, given, what)
    changed = []
    for q in parameters:
        if q.name in fixed:
            changed.append(Parameter(q.name, float(fixed[q.name]), fixed=True, unit=q.unit))
            continue
        lower, upper = bounds.get(q.name, (q.lower, q.upper))
        changed.append(replace(q, start=start.get(q.name, q.start), lower=lower, upper=upper))
    return tuple(changed)


def _within(parameters: tuple[Parameter, ...], values: Mapping[str, float], stated: set[str]) -> dict[str, float]:
    """Move start values found from the data into their bounds; stated ones were checked already."""
    return {
        q.name: values[q.name] if q.name in stated else float(np.clip(values[q.name], q.lower, q.upper))
        for q in parameters
    }


def _predictor(
    structure: Structure,
    parameters: tuple[Parameter, ...],
    held: Mapping[str, float],
    data: FitData,
    hold: Hold | Sequence[Hold],
    focus: Focus,
    begin: Mapping[str, float],
) -> Predictor:
    """Build the predictor, exact at the start and wherever finite bounds let a parameter go."""
    corners = [{**begin, q.name: edge} for q in parameters for edge in (q.lower, q.upper) if abs(edge) < inf]
    predictor = build_predictor(structure, held, data.sample_time, hold, focus, [begin, *corners])
    n_inputs, n_outputs = len(data.input_names), len(data.output_names)
    if (predictor.n_inputs, predictor.n_outputs) != (n_inputs, n_outputs):
        raise UsageError(
            f"structure {structure.name!r} has {predictor.n_inputs} inputs and {predictor.n_outputs} outputs; "
            f"the recordings give {n_inputs} ({', '.join(data.input_names)}) and {n_outputs} "
            f"({', '.join(data.output_names)})"
        )
    return replace(predictor, free=tuple(q for p in predictor.free for q in parameters if q.name == p.name))


def _problem(
    predictor: Predictor,
    data: FitData,
    window: int | None,
    criterion: Criterion,
    begin: Mapping[str, float],
    scaling: bool,
) -> tuple[Shooting, FloatArray]:
    """Cut the data, scale the unknowns, and find window starts for the start values."""
    blocks = cut(data, predictor, window)
    theta = np.array([begin[q.name] for q in predictor.free])
    values = predictor.at(theta)
    power = sum(float(np.var(record.outputs, axis=0).sum()) * record.n_samples for record in data.records)
    output_scale = float(np.sqrt(power / data.n_samples))
    n_y, n = predictor.n_outputs, predictor.n_states
    states = forced_states(values, blocks)
    size = np.sqrt(np.mean(states**2, axis=(0, 2)))
    state_scale = np.where(np.isfinite(size) & (size > 0), size, 1.0)
    s = sweep(values, blocks, np.zeros((blocks.n_windows, n)), np.eye(n_y) / (data.n_samples * output_scale**2))
    starts = -_ridge_solve(s.hessian_start, s.gradient_start, state_scale)
    problem = Shooting(predictor, blocks, criterion, output_scale, np.ones(len(theta)), state_scale)
    error = residuals(values, blocks, starts)
    weight = problem.weight(np.einsum("kyw,kzw->yz", error, error))
    curvature = np.diag(sweep(values, blocks, starts, weight).hessian)
    magnitude = np.where(theta != 0, np.abs(theta), 1.0)
    theta_scale = np.where(curvature > 0, 1 / np.sqrt(np.maximum(curvature, 1e-300)), magnitude)
    if not scaling:
        theta_scale, state_scale = np.ones_like(theta_scale), np.ones_like(state_scale)
    problem = replace(problem, theta_scale=theta_scale, state_scale=state_scale, _last={})
    return problem, problem.pack(theta, starts)


def _ridge_solve(hessian: FloatArray, gradient: FloatArray, scale: FloatArray) -> FloatArray:
    """Solve per window, held near zero where a window says nothing about a state."""
    scaled = hessian * np.outer(scale, scale)
    n = len(scale)
    ridge = 1e-6 * np.trace(scaled, axis1=1, axis2=2)[:, None, None] / n + 1e-300
    return np.asarray(np.linalg.solve(scaled + ridge * np.eye(n), (gradient * scale)[:, :, None])[:, :, 0] * scale)


def _bounds(problem: Shooting) -> tuple[FloatArray, FloatArray]:
    free = problem.predictor.free
    n_rest = problem.n_unknowns - len(free)
    lower = np.array([q.lower for q in free]) / problem.theta_scale
    upper = np.array([q.upper for q in free]) / problem.theta_scale
    return np.concatenate([lower, np.full(n_rest, -inf)]), np.concatenate([upper, np.full(n_rest, inf)])


def _result(
    structure: Structure,
    parameters: tuple[Parameter, ...],
    data: FitData,
    problem: Shooting,
    solution: Solution,
    begin: Mapping[str, float],
    options: Mapping[str, str],
) -> FitResult:
    """Turn the solver's answer into estimates with their uncertainty."""
    predictor = problem.predictor
    theta, starts = problem.unpack(solution.unknowns)
    estimates = {**begin, **dict.fromkeys(predictor.unused, 0.0)}
    estimates |= {q.name: float(v) for q, v in zip(predictor.free, theta, strict=True)}
    initial = starts[problem.blocks.record_first]
    values = predictor.at(theta)
    records = cut(data, predictor, None)
    error = residuals(values, records, initial)
    products = np.einsum("kyw,kzw->yz", error, error)
    mean_square = products / data.n_samples
    n_unknowns = len(theta) + initial.size
    freedom = max(1.0, data.n_samples - n_unknowns / predictor.n_outputs)
    on_bound = _on_bound(predictor.free, theta, problem.theta_scale)
    success, status = solution.success, solution.status
    if not np.isfinite(products).all():
        success, status = False, "not converged: the predictor overflows; start from a stable model"
        found = Covariance(np.full((len(theta), len(theta)), np.nan), np.zeros((0, len(theta))))
    else:
        weight = problem.weight(products)
        found = covariance(values, records, initial, weight, products / freedom, on_bound)
    if not predictor.enough_squarings(theta):
        success, status = False, "not converged: a pole ran far beyond its start; give bounds or a start nearer to it"
    notes = _notes(predictor, begin, on_bound, found)
    std = _standard_deviations(parameters, predictor, on_bound, found)
    fit = _fit_percent(data, error, records)
    return FitResult(
        structure=structure.name,
        recordings=tuple(record.name for record in data.records),
        parameters=estimates,
        std=std,
        units={q.name: q.unit for q in parameters},
        free=tuple(q.name for q in predictor.free),
        covariance=found.parameters,
        initial_states=initial,
        loss=float(np.trace(mean_square) if problem.criterion == "trace" else np.linalg.det(mean_square)),
        error_covariance=mean_square,
        fit_percent=fit,
        status=status,
        success=success,
        iterations=solution.iterations,
        wall_time_s=0.0,
        start={q.name: begin[q.name] for q in parameters},
        notes=notes,
        options=options,
        model=evaluate(structure, estimates, data.input_names, data.output_names),
        sample_time=data.sample_time,
    )


def _on_bound(free: tuple[Parameter, ...], theta: FloatArray, scale: FloatArray) -> npt.NDArray[np.bool_]:
    near = 1e-6 * scale
    return np.array(
        [v - q.lower <= s or q.upper - v <= s for q, v, s in zip(free, theta, near, strict=True)], dtype=bool
    )


def _notes(
    predictor: Predictor, begin: Mapping[str, float], on_bound: npt.NDArray[np.bool_], found: Covariance
) -> tuple[str, ...]:
    names = np.array([q.name for q in predictor.free])
    notes = [f"{name} lies on a bound: no standard deviation" for name in names[on_bound]]
    for direction in found.undetermined:
        involved = names[np.abs(direction) > 0.1 * np.abs(direction).max()]
        notes.append(
            f"the data do not determine {', '.join(involved)} (together)"
            if len(involved) > 1
            else f"the data do not determine {involved[0]}"
        )
    held = [name for name in predictor.unused if begin[name] != 0]
    if predictor.unused:
        notes.append(f"not seen by simulation focus, set to 0: {', '.join(predictor.unused)}")
    if held:
        notes.append(f"their start values were left aside: {', '.join(held)}")
    return tuple(notes)


def _standard_deviations(
    parameters: tuple[Parameter, ...], predictor: Predictor, on_bound: npt.NDArray[np.bool_], found: Covariance
) -> dict[str, float]:
    std = {q.name: 0.0 if q.fixed else np.nan for q in parameters}
    dark = (np.abs(found.undetermined) > 1e-3).any(axis=0)
    for i, q in enumerate(predictor.free):
        if not (on_bound[i] or dark[i]):
            std[q.name] = float(np.sqrt(found.parameters[i, i]))
    return std


def _fit_percent(data: FitData, error: FloatArray, records: Blocks) -> FloatArray:
    """Fit per record and output from the errors of all records in blocks."""
    rows = []
    first_block = records.window_first[records.record_first]
    for i, record in enumerate(data.records):
        last = first_block[i + 1] if i + 1 < len(first_block) else records.n_blocks
        squares = (error[:, :, first_block[i] : last] ** 2).sum((0, 2))
        spread = ((record.outputs - record.outputs.mean(0)) ** 2).sum(0)
        rows.append(100 * (1 - np.sqrt(squares / spread)))
    return np.array(rows)
