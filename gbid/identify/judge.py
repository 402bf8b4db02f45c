"""Judgement of a solved problem: estimates, their uncertainty, the status, and notes of what to think of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gbid.core.arrays import BoolArray, FloatArray
from gbid.core.notes import FitNote
from gbid.discretise import check_holds
from gbid.identify.data import column_means
from gbid.identify.optimum import Optimum
from gbid.identify.problem.assemble import Assembly, window_length
from gbid.identify.problem.integration import at_working_point, with_integration_error
from gbid.identify.problem.nlp import Shooting, extra_notes
from gbid.identify.problem.states import decay_notes, released_states
from gbid.identify.result import FitResult, StdKind
from gbid.identify.start.scheduled_start import centre_tie
from gbid.identify.uncertainty.coloured import Bootstrap, whiteness_test
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
from gbid.structure import Parameter, kind_of

_COLOURED = 0.01  # significance level of the whiteness test, shared by the outputs
_NEAR = 1e-6  # largest distance from a bound at which a parameter lies on it, as a part of the parameter's scale
_NEAR_IN_STD = 1e-3  # the same as a part of its standard deviation


def judge(optimum: Optimum) -> FitResult:
    """Return the result of a fit, evaluated at the optimum of its problem, without its wall time."""
    problem, shooting, solution = optimum.problem, optimum.shooting, optimum.solution
    task, assembly, reweighted = problem.task, problem.assembly, optimum.reweighted
    structure, data, free = task.structure, task.data, assembly.free
    theta, starts = shooting.unpack(solution.unknowns)
    every = _by_record(shooting, shooting.errors(shooting.values(theta), starts), assembly)  # outliers count in full
    used = _by_record(shooting, [part.blocks.used[:, :, None] for part in shooting.parts], assembly)
    outputs = [r.outputs.compress(rows[:, 0] > 0, axis=0) for r, rows in zip(data.records, used, strict=True)]
    squares = np.asarray(sum(e.T @ e for e in every))
    weighted = shooting if reweighted is None else reweighted.problem
    residuals = weighted.errors(weighted.values(theta), starts)
    products = np.asarray(sum(np.einsum("gkyw,gkzw->yz", e, e) for e in residuals))
    by_record = _by_record(weighted, residuals, assembly)
    finite = bool(np.isfinite(products).all() and np.isfinite(theta).all())
    worse = finite and explains_nothing(weighted, squares, outputs)
    white = whiteness_test(by_record)
    sound = finite and not worse
    coloured = not (sound and (white.p_value >= _COLOURED / len(white.p_value)).all())
    bootstrap = task.bootstrap if sound and solution.status.success else None
    n_records, n_states = task.states.known.shape
    known_starts = np.hstack([task.states.known, np.zeros((n_records, weighted.n_states - n_states), bool)])
    point = _Point(optimum, weighted, theta, starts, products, known_starts, coloured, bootstrap)
    on_bound, found = point.uncertainty()
    trusted: StdKind = "bootstrap" if bootstrap else "robust" if coloured else "white"
    chosen = {"white": found.white, "robust": found.robust, "bootstrap": found.bootstrap}[trusted]
    if chosen is None:
        trusted, chosen = "robust", found.robust

    estimates = {**problem.begin, **dict.fromkeys(assembly.unused, 0.0)}
    estimates |= {q.name: float(v) for q, v in zip(free, theta, strict=True)}
    local_names = {
        record.name: {short: full for short, full in names.items() if short != full}
        for record, names in zip(data.records, assembly.record_names, strict=True)
        if any(short != full for short, full in names.items())
    }
    for name in {short for names in local_names.values() for short in names}:
        estimates.pop(name, None)
    std = _standard_deviations(estimates, problem.parameters, free, chosen, on_bound, found)
    mean_square = squares / weighted.n_samples
    at_edge = finite and any(weighted.parts_at_edge(theta))
    units = {q.name: q.unit for q in problem.parameters} | task.disturbances.units(data.output_units)
    own_name = {**dict(zip(estimates, estimates, strict=True)), **assembly.own_names}
    first = {**estimates, **{short: estimates[full] for short, full in assembly.record_names[0].items()}}
    names = [q.name for q in structure.parameters]
    kind = kind_of(structure)
    model = kind.model({name: first[name] for name in names}, data.input_names, data.output_names)
    if kind.nonlinear:
        model = at_working_point(model, weighted, theta, starts, data)
    tie = centre_tie(structure, weighted.parts[0].predictor.free, [q.name for q in free])
    spreads = model_spreads(weighted, theta, chosen, model, names, tie)
    n, k = weighted.n_samples, len(theta) + int((~known_starts).sum())
    first_states = starts[assembly.record_window] + released_states(weighted, theta, assembly.record_window)
    log_det = float(np.linalg.slogdet(mean_square)[1]) if np.isfinite(mean_square).all() else np.nan
    result = FitResult(
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
        loss=float(np.trace(mean_square) if weighted.criterion == "trace" else np.linalg.det(mean_square)),
        error_covariance=mean_square,
        fit_percent=_fit_percent(every, outputs),
        aic=n * log_det + 2 * k,
        fpe=float(np.exp(log_det) * (1 + k / n) / max(1 - k / n, 1e-12)),
        condition=found.condition,
        status=verdict(
            solution.status,
            overflows=not finite,
            worse_than_constant=worse,
            at_edge=at_edge,
            undetermined=~on_bound & ~np.isfinite([std[q.name] for q in free]),
        ),
        optimality=solution.rest,
        iterations=solution.iterations,
        wall_time_s=0.0,
        start={name: problem.begin[name] for name in estimates},
        start_origin={name: _origin(optimum, own_name[name]) for name in estimates},
        notes=(
            *_notes(optimum, on_bound, found, trusted, coloured),
            *_doubts(optimum, theta, found),
            *(may_cover_less(found.models, model.modes(), data.sample_time, n) if coloured else ()),
            *(feedback_notes(data.records, by_record) if coloured and finite else ()),
            *_edge_note(at_edge),
            *optimum.notes,
            *task.begin.notes,
            *task.states.notes,
            *_overflow_notes(solution.overflows),
            *decay_notes(data),
            *extra_notes(shooting, solution.unknowns),
        ),
        options=task.options.settled(
            intersample=check_holds(task.hold, len(data.input_names)),
            criterion=task.criterion,
            initial_state=task.states.choice,
            window=problem.window and window_length(shooting),
            robust_threshold=task.loss and task.loss.threshold,
            bootstrap_draws=task.bootstrap and task.bootstrap.draws,
            bootstrap_seed=task.bootstrap and task.bootstrap.seed,
        ),
        disturbances=task.disturbances,
        engine=assembly.engine,
        schedule=task.courses.schedule if task.courses else None,
        model=model,
        sample_time=data.sample_time,
        local_names=local_names,
        model_slopes=spreads.slopes,
    )
    return with_integration_error(result, optimum.integration_shift)


@dataclass(frozen=True, eq=False)
class _Point:
    """Optimum with its residuals, at which the covariance is taken.

    `known_starts` (n_records, n) are the initial states that are no unknowns of their own.
    """

    optimum: Optimum
    weighted: Shooting
    theta: FloatArray
    starts: FloatArray
    products: FloatArray
    known_starts: BoolArray
    coloured: bool
    bootstrap: Bootstrap | None

    def uncertainty(self) -> tuple[BoolArray, Covariance]:
        """Return which free parameters lie on a bound, (n_theta,), and the covariance of the others."""
        on_bound = self._on_bound(_NEAR * self.weighted.theta_scale)
        found = self._covariance(on_bound)
        pressed = on_bound | self._on_bound(_NEAR_IN_STD * np.sqrt(np.diag(found.white)))
        if (pressed != on_bound).any():  # the solver stops slightly inside of an active bound
            return pressed, self._covariance(pressed)
        return on_bound, found

    def _on_bound(self, near: FloatArray) -> BoolArray:
        free = self.optimum.problem.assembly.free
        lower, upper = np.array([q.lower for q in free], float), np.array([q.upper for q in free], float)
        return np.asarray((self.theta - lower <= near) | (upper - self.theta <= near))

    def _covariance(self, on_bound: BoolArray) -> Covariance:
        nothing = np.full((len(self.theta), len(self.theta)), np.nan)
        none = Covariance(nothing, nothing, np.nan, np.zeros((0, len(self.theta))), np.inf)
        if not np.isfinite(self.products).all():
            return none
        reweighted = self.optimum.reweighted
        try:
            found = covariance(
                self.weighted,
                self.theta,
                self.starts,
                self.optimum.problem.assembly.record_window,
                self.products,
                on_bound,
                known_starts=self.known_starts,
                coloured=self.coloured,
                bootstrap=self.bootstrap,
            )
        except np.linalg.LinAlgError:
            return none
        return found if reweighted is None else found.scaled(*reweighted.factors)


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


def _fit_percent(errors: list[FloatArray], outputs: list[FloatArray]) -> FloatArray:
    """Return ``100 (1 - |e| / |y - mean y|)``, recordings by outputs."""
    rows = []
    for e, y in zip(errors, outputs, strict=True):
        left, full = (np.linalg.norm(np.ascontiguousarray(part.T), axis=1) for part in (e, y - column_means(y)))
        rows.append(100 * (1 - left / full))
    return np.array(rows)


def _origin(optimum: Optimum, name: str) -> str:
    """Return where the start value of a parameter comes from: another start than the task's was found in the data."""
    begin = optimum.problem.task.begin
    if name not in begin.origin:
        return "structure"
    return begin.origin[name] if optimum.problem.start[name] == begin.values[name] else "data"


# ---- Notes.


def _notes(
    optimum: Optimum, on_bound: BoolArray, found: Covariance, trusted: StdKind, coloured: bool
) -> tuple[str, ...]:
    assembly, begin, reweighted = optimum.problem.assembly, optimum.problem.begin, optimum.reweighted
    names = np.array([q.name for q in assembly.free])
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
    if reweighted is not None and reweighted.light:
        notes.append(f"robust loss: {100 * reweighted.light:.2g} % of the samples count less than half")
    return (*notes, *assembly.notes)


def _overflow_notes(points: int) -> tuple[str, ...]:
    """Return a note on the points at which the model overflowed, none for none."""
    text = f"the model overflows at {points} of the points that the solver tried; it stepped back"
    return (FitNote.OVERFLOWS(text),) if points else ()


def _doubts(optimum: Optimum, theta: FloatArray, found: Covariance) -> tuple[str, ...]:
    structure, assembly = optimum.problem.task.structure, optimum.problem.assembly
    names = np.array([q.name for q in assembly.free])
    known, own = {q.name for q in structure.parameters}, assembly.own_names
    if scheduled := kind_of(structure).scheduled:  # a coefficient may well be zero, too
        known &= {q.name for q in scheduled.base.parameters}
    # A disturbance gain or a trend may well be zero: an open sign says nothing there.
    physical = np.array(
        [own.get(name, name) in known and i not in optimum.shooting.noise for i, name in enumerate(names)], bool
    )
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
