"""Evaluation of a fit at the solution: estimates, their uncertainty, status and notes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gbid.arrays import BoolArray, FloatArray
from gbid.identify.data import FitData, column_means
from gbid.identify.nlp.shooting import Shooting
from gbid.identify.nlp.solver import Solution
from gbid.identify.nonlinear.working_point import at_working_point
from gbid.identify.options import FitOptions
from gbid.identify.problem.assembly import Assembly
from gbid.identify.problem.feedback_test import feedback_notes
from gbid.identify.problem.initial_states import InitialStates, released_states
from gbid.identify.result import FitResult, StdKind
from gbid.identify.robust.reweighting import Reweighted
from gbid.identify.scheduled.tied_equations import centre_tie
from gbid.identify.uncertainty.bootstrap import Bootstrap
from gbid.identify.uncertainty.covariance import FLATTEST, Covariance, covariance
from gbid.identify.uncertainty.doubts import far_below_white, hardly_determined, may_cover_less, not_determined
from gbid.identify.uncertainty.model_spreads import model_spreads
from gbid.identify.uncertainty.whiteness import whiteness_test
from gbid.identify.verdict import explains_nothing, verdict
from gbid.notes.fit_notes import FitNote
from gbid.structure import AnyStructure, NonlinearModel, Parameter, ScheduledStructure, model_of

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
    worse = bool(finite) and explains_nothing(problem, whole, _counted_outputs(data, counted, options.horizon))
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
    model = model_of(structure, {name: first[name] for name in own}, data.input_names, data.output_names)
    if isinstance(model, NonlinearModel):
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
        fit_percent=_fit_percent(data, every, counted, options.horizon),
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
            *(feedback_notes(data.records, by_record) if coloured and finite and options.horizon == 1 else ()),
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
    if isinstance(structure, ScheduledStructure):  # a coefficient may well be zero, too
        known &= {q.name for q in structure.base.parameters}
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


def _fit_percent(data: FitData, errors: list[FloatArray], counted: list[FloatArray], horizon: int) -> FloatArray:
    rows = []
    for e, y in zip(errors, _counted_outputs(data, counted, horizon), strict=True):
        left, whole = (np.linalg.norm(np.ascontiguousarray(part.T), axis=1) for part in (e, y - column_means(y)))
        rows.append(100 * (1 - left / whole))
    return np.array(rows)


def _counted_outputs(data: FitData, counted: list[FloatArray], horizon: int) -> list[FloatArray]:
    """Return the outputs of each record that are in the cost, (n_samples, n_y)."""
    pairs = zip(data.records, counted, strict=True)
    return [r.outputs[horizon - 1 :].compress(used[:, 0] > 0, axis=0) for r, used in pairs]
