"""The fit, start to end."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from gbid.arrays import FloatArray
from gbid.discretise import Hold, check_holds
from gbid.errors import UsageError
from gbid.identify.data import FitData, gather
from gbid.identify.kernel.engine import EngineName
from gbid.identify.nlp.shooting import Criterion
from gbid.identify.nlp.solver import Solution, solve
from gbid.identify.nlp.watch import Progress, Stop
from gbid.identify.options import FitOptions
from gbid.identify.other_gains import lowest_of_several
from gbid.identify.outcome import outcome
from gbid.identify.predictor import Focus, noise_names
from gbid.identify.problem.assembly import Scope, assemble, automatic_window, full_start, offset_starts
from gbid.identify.problem.scaling import InitialState, build_problem, unknown_bounds, window_length
from gbid.identify.result import FitResult
from gbid.identify.start import start_values
from gbid.identify.status import FitStatus
from gbid.recording import Recording
from gbid.structure import Parameter, Structure, as_names, known_names
from gbid.threads import one_blas_thread


def fit(
    structure: Structure,
    recordings: Recording | Sequence[Recording],
    *,
    inputs: str | Sequence[str] | None = None,
    outputs: str | Sequence[str] | None = None,
    focus: Focus = "prediction",
    intersample: Hold | Sequence[Hold] | None = None,
    criterion: Criterion = "trace",
    horizon: int = 1,
    output_weights: Sequence[float] | None = None,
    start: Mapping[str, float] | None = None,
    fixed: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    local: Mapping[str, Scope] | None = None,
    offsets: bool = False,
    initial_state: InitialState = "estimated",
    left_out: Mapping[str, Sequence[tuple[int, int]]] | None = None,
    window: int | Literal["auto"] | None = "auto",
    stop: Stop = "tolerance",
    max_iterations: int = 100,
    scaling: bool = True,
    engine: EngineName = "auto",
    progress: Callable[[Progress], None] | None = None,
) -> FitResult:
    """Fit a structure to recordings by prediction errors (paper, Eq. 15) with multiple shooting.

    Parameters
    ----------
    structure : Structure
        `RotorBearing`, `PiezoPair`, `Plant` or a `LinearStructure` of one's own.
    recordings : Recording or sequence of Recording
        Parameters are shared by all but those named in `local`; each has an initial state of its own.
    inputs, outputs : str or sequence of str, optional
        Signals (``"p"``) or channels (``"p.x"``) of the recordings; the structure's own when not given.
    focus : {"prediction", "simulation"}
        Errors of a prediction with the disturbance gain, or of the model running on its own.
    intersample : {"zoh", "foh"} or sequence, optional
        Behaviour of the inputs between samples; the structure's own when not given.
    criterion : {"trace", "det"}
        Mean squared error summed over outputs, or the determinant of its matrix.
    horizon : int
        Steps ahead that are predicted; 1 is the paper's.
    output_weights : sequence of float, optional
        Weight of each output's squared error in the trace; ones when not given.
    start : dict of str to float, optional
        Start values; what is not given comes from the structure, and for the built-in ones from the data.
    fixed : dict of str to float, optional
        Parameters that keep a value; a disturbance gain held at 0 is none.
    bounds : dict of str to (lower, upper), optional
        Bounds in place of the structure's.
    prior : dict of str to (value, std), optional
        What is known beforehand, as normal: draws estimates towards nominal values.
    local : dict of str to {"recording", "operating_point"}, optional
        Parameters with a value of their own for each recording or operating point.
    offsets : bool
        Whether a constant offset of each output is estimated for each recording.
    initial_state : {"estimated", "zero"} or sequence of float
        Initial state of every recording.
    left_out : dict of str to sequence of (start, stop), optional
        Samples of recordings, by name, that do not count (a rub, a dropout): the model runs through them.
    window : int, None or "auto"
        Samples in a shooting window; None is single shooting. "auto" takes about 256 (prediction) or 128
        (simulation), and tries others when that does not converge.
    stop : {"tolerance", "paper"}
        Far below the estimates' uncertainty or at IPOPT's tolerance, or the paper's rule (relative change below
        1e-4).
    max_iterations : int
    scaling : bool
        Whether unknowns are scaled to the order of one; only a test would say no.
    engine : {"auto", "compiled", "numpy"}
        What runs the pass over the samples; "auto" compiles it where there is a C compiler.
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
    _check_options(focus, criterion, window, stop, max_iterations, horizon)
    recordings = [recordings] if isinstance(recordings, Recording) else list(recordings)
    in_names = as_names(structure.inputs if inputs is None else inputs)
    out_names = as_names(structure.outputs if outputs is None else outputs)
    hold = structure.intersample if intersample is None else intersample
    parameters = _with_options(structure.parameters, start or {}, fixed or {}, bounds or {})
    data = gather(recordings, in_names, out_names, minimum=len(parameters) + 9 + horizon)

    stated = {q.name: q.start for q in parameters if q.start is not None}
    with one_blas_thread():
        begin = _within(parameters, start_values(structure, data, stated), set(stated))
    asked = {**(start or {}), **(fixed or {})}
    origin = {q.name: "user" if q.name in asked else "structure" if q.name in stated else "data" for q in parameters}

    def attempt(samples: int | None, gain_held: bool = False) -> FitResult:
        used = _with_gain_held(structure, parameters) if gain_held else parameters
        assembly = assemble(
            structure,
            used,
            begin,
            data,
            intersample=hold,
            focus=focus,
            horizon=horizon,
            offsets=offsets,
            local=local or {},
            left_out=left_out or {},
            window=samples,
            engine=engine,
        )
        full = full_start(assembly, begin, offset_starts(structure, begin, data, hold) if offsets else ())
        problem, unknowns = build_problem(assembly, data, criterion, output_weights, full, prior or {}, scaling)
        lower, upper = unknown_bounds(problem, assembly, initial_state)
        first = np.clip(unknowns, lower, upper)

        def run(begin: FloatArray) -> Solution:
            return solve(problem, begin, lower, upper, stop=stop, max_iterations=max_iterations, progress=progress)

        solution, told = lowest_of_several(problem, run(first), (lower, upper), run)
        options = FitOptions(
            inputs=in_names,
            outputs=out_names,
            focus=focus,
            horizon=horizon,
            intersample=check_holds(hold, len(data.input_names)),
            criterion=criterion,
            stop=stop,
            initial_state=initial_state if isinstance(initial_state, str) else "given",
            offsets=offsets,
            window=None if samples is None else window_length(problem),
            engine=assembly.engine,
        )
        result = outcome(structure, used, data, assembly, problem, solution, full, origin, options)
        return replace(result, notes=(*result.notes, *told))

    # Small matrices: several BLAS threads only wait for one another. An unstable start overflows: the status says so.
    with one_blas_thread(), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        result = _best_of(attempt, window if window != "auto" else _ladder(data, focus))
    return replace(result, wall_time_s=time.perf_counter() - began)


def _ladder(data: FitData, focus: Focus) -> list[int | None]:
    """Windows to try one after the other: the usual one, then shorter and longer ones."""
    usual = automatic_window(data, focus)
    return [usual, max(16, usual // 2), 4 * usual]


def _best_of(attempt: Callable[..., FitResult], windows: int | list[int | None] | None) -> FitResult:
    """Take the first attempt that converges; else the one with the smallest loss. Say which it was."""
    if not isinstance(windows, list):
        return attempt(windows)
    tried: list[FitResult] = []
    for samples in windows:
        result = attempt(samples)
        tried.append(result)
        if result.success:
            break
        if result.status is FitStatus.UNSTABLE_PREDICTOR:
            result = attempt(samples, gain_held=True)
            note = "a free disturbance gain led to the edge of an unstable predictor: it was held at its start"
            status = FitStatus.CONVERGED_GAIN_HELD if result.success else result.status
            return replace(result, status=status, notes=(*result.notes, note))
    else:
        finite = [r for r in tried if np.isfinite(r.loss)]
        result = min(finite, key=lambda r: r.loss) if finite else tried[0]
    if len(tried) > 1:
        others = ", ".join(str(r.options.window) for r in tried if r is not result)
        note = f"windows of {others} samples did not converge; this is the result with {result.options.window}"
        result = replace(result, notes=(*result.notes, note))
    return result


def _with_gain_held(structure: Structure, parameters: tuple[Parameter, ...]) -> tuple[Parameter, ...]:
    """Hold what only the disturbance gain depends on."""
    names = noise_names(structure)
    return tuple(replace(q, fixed=True) if q.name in names and q.start is not None else q for q in parameters)


def _check_options(
    focus: str, criterion: str, window: int | str | None, stop: str, max_iterations: int, horizon: int
) -> None:
    choices = {
        "focus": (focus, ("prediction", "simulation")),
        "criterion": (criterion, ("trace", "det")),
        "stop": (stop, ("tolerance", "paper")),
    }
    for name, (value, allowed) in choices.items():
        if value not in allowed:
            raise UsageError(f"{name} = {value!r}; choose {' or '.join(map(repr, allowed))}")
    if window != "auto" and window is not None and (isinstance(window, str) or window < 2):
        raise UsageError(f"window = {window}; a shooting window needs at least 2 samples, or None for one window")
    if max_iterations < 1:
        raise UsageError(f"max_iterations = {max_iterations}; it must be at least 1")
    if horizon < 1:
        raise UsageError(f"horizon = {horizon}; it must be at least 1")
    if horizon > 1 and focus == "simulation":
        raise UsageError("horizon is for focus = 'prediction'; a simulation looks ahead without end")


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
