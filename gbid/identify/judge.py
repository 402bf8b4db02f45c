"""Judgement of a solved problem: estimates, their uncertainty, the status, and notes of what to think of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from gbid.core.arrays import BoolArray, FloatArray
from gbid.core.notes import FitNote
from gbid.discretise import check_holds
from gbid.identify.bias import Bias, bias_of
from gbid.identify.data import FitData, Record, centred_rows
from gbid.identify.data_notes import data_notes
from gbid.identify.frequency_fit import ResponseResiduals
from gbid.identify.options import SettledOptions
from gbid.identify.pose import Optimum
from gbid.identify.problem.assemble import window_length
from gbid.identify.problem.integration import at_working_point, with_integration_error
from gbid.identify.problem.nlp import Shooting, extra_notes
from gbid.identify.problem.solve import TOLERANCES, forces_of_bounds
from gbid.identify.problem.states import decay_notes, released_states
from gbid.identify.result import FitResult, FitStatus, StdKind
from gbid.identify.start.scheduled_start import centre_tie
from gbid.identify.uncertainty.coloured import ErrorModel
from gbid.identify.uncertainty.covariance import (
    FLATTEST,
    Covariance,
    Estimate,
    ModelSpreads,
    covariance,
    filtered_records,
    model_spreads,
)
from gbid.identify.uncertainty.profiles import Profiler
from gbid.identify.uncertainty.residual_tests import Whiteness, whiteness_test
from gbid.structure import kind_of

_EQUAL = 1e-3  # largest relative difference of parameters that meet: the data tell it ever less well
_NEARLY_ALL = 0.99  # smallest share of their difference in what the data do not determine
_NEAR = 1e-2  # of the range between both bounds, farther from which an estimate lies on none, wherever the data push it


def judge(optimum: Optimum) -> FitResult:
    """Return the result of a fit, evaluated at the optimum of its problem, without its wall time."""
    problem, solution = optimum.problem, optimum.solution
    task, assembly = problem.task, problem.assembly
    residuals = _residuals(optimum)
    certainty = _certainty(optimum, residuals)
    estimate, spread, bias, whiteness = residuals.estimate, certainty.spread, certainty.bias, residuals.whiteness
    shooting, theta, windows = estimate.problem, estimate.theta, estimate.record_window
    parameters, local_names = _parameters(optimum, theta)
    std = _standard_deviations(optimum, parameters, certainty)
    model = _model(optimum, estimate, parameters)
    spreads = _spreads_of_model(optimum, estimate, certainty.covariance, model)
    scores = _scores(optimum, residuals)
    units = {q.name: q.unit for q in problem.parameters} | task.disturbances.units(task.data.output_units)
    short_name = {**dict(zip(parameters, parameters, strict=True)), **assembly.own_names}
    at_edge = residuals.finite and any(shooting.parts_at_edge(theta))
    shaft = shaft_notes(model.modes(), task.data) if residuals.finite and task.data.records else ()
    result = FitResult(
        structure=task.structure.name,
        recordings=tuple(each.name for each in task.data.records or task.responses),
        parameters=parameters,
        std=std,
        units={name: units[short_name[name]] for name in parameters},
        free=_free_names(optimum),
        covariance=certainty.covariance,
        covariance_white=spread.white,
        covariance_robust=spread.robust,
        trusted="none" if certainty.left_out else certainty.kind,
        whiteness=whiteness.p_value if residuals.finite else np.full(len(residuals.products), np.nan),
        modes_std=spreads.modes,
        static_gain_std=spreads.static_gain,
        initial_states=(
            (estimate.starts[windows] + released_states(shooting, theta, windows))[:, : assembly.n_states]
            if shooting.parts
            else np.zeros((len(task.responses), assembly.n_states))
        ),
        error_covariance=residuals.mean_square,
        fit_percent=residuals.fit_percent,
        **scores,
        condition=spread.condition,
        status=verdict(
            solution.status,
            overflows=not residuals.finite,
            worse_than_constant=residuals.worse_than_constant,
            at_edge=at_edge,
            shaft=bool(shaft),
            undetermined=~certainty.on_bound & ~np.isfinite([std[q.name] for q in assembly.free]),
        ),
        optimality=solution.rest,
        iterations=solution.iterations,
        phases=solution.phases,
        wall_time_s=0.0,
        start={name: problem.begin[name] for name in parameters},
        start_origin={name: _origin(optimum, short_name[name]) for name in parameters},
        notes=(
            *certainty.notes,
            *bias.notes,
            *_notes_on_coverage(optimum, residuals, spread, model),
            *((FitNote.PREDICTOR_AT_EDGE(_AT_EDGE),) if at_edge else ()),
            *certainty.notes_on_poles,
            *shaft,
            *optimum.notes,
            *task.begin.notes,
            *task.states.notes,
            *((FitNote.OVERFLOWS(_OVERFLOWS.format(solution.overflows)),) if solution.overflows else ()),
            *decay_notes(task.data),
            *data_notes(task.data, {q.name for q in task.parameters}, task.options.left_out or {}),
            *extra_notes(optimum.shooting, solution.unknowns),
        ),
        options=_settled_options(optimum, estimate),
        disturbances=task.disturbances,
        engine=assembly.engine,
        schedule=task.courses.schedule if task.courses else None,
        model=model,
        sample_time=np.nan if task.data.is_irregular else task.data.sample_time,
        local_names=local_names,
        model_slopes=spreads.slopes,
        hold_shift=bias.moved,
        profiler=_profiler(optimum, residuals, certainty, scores["loss"]),
        error_models=_error_models(optimum),
    )
    return with_integration_error(result, optimum.integration_shift)


# ---- The questions of a judgement, in their order.


@dataclass(frozen=True, eq=False)
class _Residuals:
    """Errors of a fit at its estimates, and what they are.

    Attributes
    ----------
    estimate : Estimate
        Estimates, with the weighted problem where a loss or filters weigh the errors.
    by_record : list of (n_samples, n_y) array
        Weighted and filtered errors of each record.
    products : (n_y, n_y) array
        Sum of their products.
    mean_square : (n_y, n_y) array
        Mean of the products of the errors as they are: outliers count in full.
    fit_percent : (n_records, n_y) array
        ``100 (1 - |e| / |y - mean y|)`` of the errors as they are.
    whiteness : Whiteness
        Test of `by_record`.
    finite : bool
        Whether errors and parameters are finite.
    worse_than_constant : bool
        Whether the mean of each record explains the outputs as well, see `explains_nothing`.
    noisy : (n_y,) boolean array
        Outputs with noise; the others are simulated ones, whose errors are at rounding.
    responses : ResponseResiduals or None
        Errors of a fit to frequency responses alone.
    """

    estimate: Estimate
    by_record: list[FloatArray]
    products: FloatArray
    mean_square: FloatArray
    fit_percent: FloatArray
    whiteness: Whiteness
    finite: bool
    worse_than_constant: bool
    noisy: BoolArray
    responses: ResponseResiduals | None = None

    @property
    def sound(self) -> bool:
        """Whether the errors are those of a model that explains something."""
        return self.finite and not self.worse_than_constant

    @property
    def coloured(self) -> bool:
        """Whether standard deviations for independent errors are not to be trusted."""
        if self.responses is not None and self.responses.doubtful:
            return True
        return not (self.sound and self.whiteness.accepted[self.noisy].all())


def _residuals(optimum: Optimum) -> _Residuals:
    """Return what the model leaves unexplained: the errors at the optimum."""
    problem, shooting, solution = optimum.problem, optimum.shooting, optimum.solution
    data, windows = problem.task.data, problem.assembly.record_window
    theta, starts = shooting.unpack(solution.unknowns)
    if not shooting.parts:
        return _of_responses(optimum, Estimate(shooting, theta, starts, windows))
    every = shooting.by_record(shooting.errors(shooting.values(theta), starts), windows)
    used = shooting.by_record([part.blocks.used[:, :, None] for part in shooting.parts], windows)
    outputs = [_counted_outputs(r, rows[:, 0] > 0) for r, rows in zip(data.records, used, strict=True)]
    squares = np.asarray(sum(e.T @ e for e in every) + shooting.absent)
    weighted = shooting if optimum.reweighted is None else optimum.reweighted.problem
    by_record, products = every, squares
    if weighted is not shooting:
        by_record = weighted.by_record(weighted.errors(weighted.values(theta), starts), windows)
        products = np.asarray(sum(e.T @ e for e in by_record) + weighted.absent)
    estimate = Estimate(weighted, theta, starts, windows, problem.task.states.in_shooting(weighted.n_states))
    if optimum.weighted is not None:
        estimate = replace(estimate, filters=optimum.weighted.filters)
    if estimate.filters and solution.status is not FitStatus.GROWS:
        by_record = [record.errors for record in filtered_records(estimate)]
        products = np.asarray(sum(e.T @ e for e in by_record))
    finite = bool(np.isfinite(products).all() and np.isfinite(theta).all())
    worse = finite and optimum.weighted is None and explains_nothing(weighted, squares - shooting.absent, outputs)
    return _Residuals(
        estimate=estimate,
        by_record=by_record,
        products=products,
        mean_square=squares / weighted.n_samples,
        fit_percent=_fit_percent(every, outputs),
        whiteness=whiteness_test(by_record),
        finite=finite,
        worse_than_constant=worse,
        noisy=np.diag(squares) > weighted.floors,
    )


def _of_responses(optimum: Optimum, estimate: Estimate) -> _Residuals:
    """Return the residuals of a fit to frequency responses alone."""
    each = ResponseResiduals.at(optimum.shooting.responses, estimate.theta)
    return _Residuals(
        estimate=estimate,
        by_record=[],
        products=each.mean_square,
        mean_square=each.mean_square,
        fit_percent=each.fit_percent,
        whiteness=Whiteness(np.full(len(each.p_value), np.nan), each.p_value, 0),
        finite=bool(np.isfinite(each.mean_square).all() and np.isfinite(estimate.theta).all()),
        worse_than_constant=False,
        noisy=np.ones(len(each.p_value), bool),
        responses=each,
    )


@dataclass(frozen=True, eq=False)
class _Certainty:
    """How well the estimates are known.

    Attributes
    ----------
    on_bound : (n_theta,) boolean array
        Free parameters on a bound.
    spread : Covariance
        Their covariances, widened by what delay, hold and other maxima move.
    kind : {"white", "robust"}
        The one that counts.
    bias : Bias
        What the estimates are off by beside the noise.
    notes, notes_on_poles : sequence of str
        Notes on the standard deviations, and on poles that meet.
    left_out : bool
        Whether the structure leaves something out, so that no standard deviation holds.
    """

    on_bound: BoolArray
    spread: Covariance
    kind: StdKind
    bias: Bias
    notes: tuple[str, ...]
    notes_on_poles: list[str]
    left_out: bool

    @property
    def covariance(self) -> FloatArray:
        """Covariance that counts, (n_theta, n_theta)."""
        return self.spread.of(self.kind)

    @property
    def unknown(self) -> BoolArray:
        """Free parameters without a standard deviation, (n_theta,)."""
        return np.asarray(self.on_bound | self.spread.open)


def _certainty(optimum: Optimum, residuals: _Residuals) -> _Certainty:
    """Return how far the estimates may be off: their covariance and bias."""
    theta, coloured, noisy = residuals.estimate.theta, residuals.coloured, residuals.noisy
    responses = residuals.responses
    settled = residuals.sound and optimum.solution.status.success and responses is None
    on_bound, spread = _uncertainty(optimum, residuals.estimate, residuals.products, coloured)
    spread, notes_on_poles = _with_equal_poles(optimum, theta, spread)
    kind: StdKind = "robust" if coloured else "white"
    std = np.where(on_bound | spread.open, np.nan, np.sqrt(np.diag(spread.of(kind))))
    errors = residuals.by_record if noisy.all() else [e * noisy for e in residuals.by_record]
    bias = bias_of(optimum, errors, std, white=not coloured) if settled else Bias()
    notes = _notes(optimum, theta, on_bound, spread, coloured and responses is None and not bias.explains_colour)
    left_out = bias.left_out
    if responses is not None and not residuals.whiteness.accepted.all():
        notes, left_out = (*notes, *responses.notes), responses.follow
    if bias.moved is not None and bias.widens:
        spread = spread.widened(bias.moved)
    for shift in optimum.weighted.elsewhere if optimum.weighted else ():
        spread = spread.widened(shift)
    return _Certainty(on_bound, spread, kind, bias, notes, notes_on_poles, left_out)


def _free_names(optimum: Optimum) -> tuple[str, ...]:
    """Return the names of the free parameters in the order of the covariance."""
    return tuple(q.name for q in optimum.problem.assembly.free)


def _error_models(optimum: Optimum) -> tuple[ErrorModel, ...]:
    """Return the models of the errors that weigh them; none without ``errors="ar"``."""
    return tuple(f.model for f in optimum.weighted.filters) if optimum.weighted else ()


def _parameters(optimum: Optimum, theta: FloatArray) -> tuple[dict[str, float], dict[str, dict[str, str]]]:
    """Return all parameters by full name, and the full names of those that are local to a recording."""
    problem, assembly = optimum.problem, optimum.problem.assembly
    parameters = {
        **problem.begin,
        **dict.fromkeys(assembly.unused, 0.0),
        **dict(zip(_free_names(optimum), theta.tolist(), strict=True)),
    }
    local_names = {
        record.name: local
        for record, full_names in zip(problem.task.data.records, assembly.record_names, strict=True)
        if (local := {short: full for short, full in full_names.items() if short != full})
    }
    for name in {short for local in local_names.values() for short in local}:
        parameters.pop(name, None)
    return parameters, local_names


def _standard_deviations(optimum: Optimum, parameters: Iterable[str], certainty: _Certainty) -> dict[str, float]:
    """Return the standard deviation of each parameter: zero for a fixed one, nan for one that is not determined."""
    fixed, names = {q.name for q in optimum.problem.parameters if q.fixed}, _free_names(optimum)
    std, covariance = {name: 0.0 if name in fixed else np.nan for name in parameters}, certainty.covariance
    for i in np.flatnonzero(~certainty.unknown):
        std[names[i]] = float(np.sqrt(covariance[i, i]))
    return std


def _model(optimum: Optimum, estimate: Estimate, parameters: dict[str, float]) -> Any:
    """Return the model of the first recording."""
    task, record_names = optimum.problem.task, next(iter(optimum.problem.assembly.record_names), {})
    kind, data = kind_of(task.structure), task.data
    first = {**parameters, **{short: parameters[full] for short, full in record_names.items()}}
    stated = {q.name: first[q.name] for q in task.structure.parameters}
    model = kind.model(stated, data.input_names, data.output_names)
    return at_working_point(model, estimate.problem, estimate.theta, estimate.starts, data) if kind.nonlinear else model


def _spreads_of_model(optimum: Optimum, estimate: Estimate, covariance: FloatArray, model: Any) -> ModelSpreads:
    """Return slopes and standard deviations of the model."""
    structure, scheduled = optimum.problem.task.structure, kind_of(optimum.problem.task.structure).scheduled
    free = estimate.problem.groups[0].predictor.free
    tie = centre_tie(scheduled, free, list(_free_names(optimum))) if scheduled else None
    return model_spreads(estimate, covariance, model, [q.name for q in structure.parameters], tie)


def _scores(optimum: Optimum, residuals: _Residuals) -> dict[str, Any]:
    """Return how good the fit is for its number of parameters: fields of the result."""
    estimate, mean_square = residuals.estimate, residuals.mean_square
    if residuals.responses is not None:
        loss, likelihood, k = residuals.responses.loss, residuals.responses.log_likelihood, len(estimate.theta)
        return {"loss": loss, "log_likelihood": likelihood, "aic": 2 * k - 2 * likelihood, "fpe": np.nan}
    n, k = estimate.problem.n_samples, len(estimate.theta) + int((~estimate.given).sum())
    log_det = float(np.linalg.slogdet(mean_square)[1]) if np.isfinite(mean_square).all() else np.nan
    per_sample = len(mean_square) * (1 + float(np.log(2 * np.pi)))
    if optimum.weighted is not None:  # likelihood and coefficients of the models of the errors
        log_det = -2 * optimum.weighted.log_likelihood / n - per_sample
        k += sum(f.model.coefficients.size for f in optimum.weighted.filters)
    for_gaps = sum(gains.spread for part in estimate.problem.parts for gains in part.blocks.gains)
    return {
        "loss": float(np.trace(mean_square) if estimate.problem.criterion == "trace" else np.linalg.det(mean_square)),
        "log_likelihood": -0.5 * (n * (log_det + per_sample) + for_gaps),
        "aic": n * log_det + for_gaps + 2 * k,
        "fpe": float(np.exp(log_det) * (1 + k / n) / max(1 - k / n, 1e-12)),
    }


def _notes_on_coverage(optimum: Optimum, residuals: _Residuals, spread: Covariance, model: Any) -> list[str]:
    """Return notes on intervals that contain the truth less often than they state."""
    if residuals.responses is not None:
        return []
    # White residuals tell of disturbances where a gain takes them in; one that is held at zero does not.
    gain = not residuals.coloured and model.K is not None and bool(model.K.any())
    models, data = _error_models(optimum) or spread.models, optimum.problem.task.data
    lost = sum(int(record.missing.all(axis=1).sum()) for record in data.records if record.missing is not None)
    n_samples = min(residuals.estimate.problem.n_samples + lost, sum(record.n_samples for record in data.records))
    return may_cover_less(models, model.modes(), data.sample_time, n_samples, gain=gain)


def _settled_options(optimum: Optimum, estimate: Estimate) -> SettledOptions:
    """Return the options of the fit with what it chose itself."""
    problem, task = optimum.problem, optimum.problem.task
    return task.options.settled(
        intersample=check_holds(task.hold, len(task.data.input_names)),
        criterion=estimate.problem.criterion,
        initial_state=task.states.choice,
        window=problem.window and window_length(optimum.shooting),
        robust_threshold=task.loss and task.loss.threshold,
    )


def _profiler(optimum: Optimum, residuals: _Residuals, certainty: _Certainty, loss: float) -> Profiler | None:
    """Return what computes profiles of the cost later; none for a model of the errors."""
    if optimum.weighted:
        return None
    estimate = residuals.estimate
    return Profiler(
        _free_names(optimum),
        estimate.problem.theta_scale,
        optimum.problem.box,
        estimate.problem.likelihood_size,
        loss,
        estimate,
        residuals.products,
        certainty.on_bound,
        np.where(certainty.unknown, np.nan, np.diag(certainty.covariance)),
        np.diag(certainty.spread.curvature),
        certainty.kind == "robust",
    )


def _uncertainty(
    optimum: Optimum, estimate: Estimate, products: FloatArray, coloured: bool
) -> tuple[BoolArray, Covariance]:
    """Return which free parameters lie on a bound, (n_theta,), and the covariance of the others."""
    n_p = len(estimate.theta)
    nothing, no_one = np.full((n_p, n_p), np.nan), np.zeros(n_p, bool)
    none = Covariance(nothing, nothing, np.nan, np.zeros((0, n_p)), np.inf, curvature=nothing)

    def without(held: BoolArray, **further: Any) -> Covariance:
        try:
            return covariance(estimate, products, held, **further)
        except np.linalg.LinAlgError:
            return none

    if not np.isfinite(products).all():
        return no_one, none
    force, on_bound = forces_of_bounds(estimate.problem, optimum.solution.unknowns, optimum.problem.box), no_one
    if force.any():  # a converged fit may have a step of so many standard deviations ahead, without any bound
        lower, upper = np.array([(q.lower, q.upper) for q in optimum.problem.assembly.free]).T
        near = np.minimum(estimate.theta - lower, upper - estimate.theta) <= _NEAR * (upper - lower)
        on_bound = near & (force * np.sqrt(np.diag(without(no_one).white)) > TOLERANCES.rest)
    spread = without(on_bound, coloured=coloured)
    return on_bound, spread if optimum.reweighted is None else spread.scaled(*optimum.reweighted.factors)


def _with_equal_poles(optimum: Optimum, theta: FloatArray, spread: Covariance) -> tuple[Covariance, list[str]]:
    """Return the covariance of exchangeable parameters that meet as that of equal ones, and notes on them.

    Where two such parameters are equal, nothing changes when they part by little: their difference has no information,
    or near there less than it needs. It is known nevertheless, for there what they can describe ends.
    """
    short, notes = optimum.problem.assembly.own_names, list[str]()
    names = [q.name for q in optimum.problem.assembly.free]
    for pair in getattr(kind_of(optimum.problem.task.structure).plant, "exchangeable", ()):
        one, other = ([i for i, name in enumerate(names) if short.get(name, name) == each] for each in pair)
        for i, j in zip(one, other, strict=False):  # none, where one is fixed
            apart = np.zeros(len(theta))
            apart[[i, j]] = np.sqrt(0.5), -np.sqrt(0.5)
            shares, variance = spread.undetermined @ apart, float(apart @ spread.white @ apart)
            lost = np.linalg.norm(shares) > _NEARLY_ALL
            if abs(theta[i] - theta[j]) > _EQUAL * abs(theta[i]) or not (lost or (apart @ theta) ** 2 < variance):
                continue
            if lost:
                _, sizes, axes = np.linalg.svd(spread.undetermined - np.outer(shares, apart), full_matrices=False)
                spread = spread._replace(undetermined=axes[sizes > _INVOLVED])
            else:
                spread = spread.along(np.eye(len(theta)) - np.outer(spread.white @ apart, apart) / variance)
            notes.append(
                FitNote.POLES_MEET(
                    f"{names[i]} and {names[j]} meet: complex poles may have a lower loss; fit PiezoPair(poles='any')"
                )
            )
    return spread, notes


def _counted_outputs(record: Record, counted: BoolArray) -> FloatArray:
    """Return the outputs of the samples that count, with their mean where they are missing."""
    if record.missing is None:
        return record.outputs if counted.all() else record.outputs.compress(counted, axis=0)
    measured = np.where(record.missing, np.nan, record.outputs)[counted]
    return np.where(np.isnan(measured), np.nanmean(measured, axis=0), measured)


def _fit_percent(errors: list[FloatArray], outputs: list[FloatArray]) -> FloatArray:
    """Return ``100 (1 - |e| / |y - mean y|)``, recordings by outputs."""
    rows = []
    for e, y in zip(errors, outputs, strict=True):
        left, full = ([each @ each for each in columns] for columns in (e.T, centred_rows(y)))
        rows.append(100 * (1 - np.sqrt(np.divide(left, full))))
    return np.array(rows)


def _origin(optimum: Optimum, name: str) -> str:
    """Return where the start value of a parameter comes from: another start than the task's was found in the data."""
    begin = optimum.problem.task.begin
    if name not in begin.origin:
        return "structure"
    return begin.origin[name] if optimum.problem.start[name] == begin.values[name] else "data"


# ---- Notes.

_AT_EDGE = (
    "the disturbance gain makes the predictor almost unstable: the record is too short to estimate it; "
    "fix it (fixed=...) or use focus='simulation'"
)
_OVERFLOWS = "the model overflows at {} of the points that the solver tried; it stepped back"


def _notes(
    optimum: Optimum, theta: FloatArray, on_bound: BoolArray, spread: Covariance, coloured: bool
) -> tuple[str, ...]:
    """Return notes on the standard deviations, and on parameters whose sign is open or whose deviation is suspicious.

    `coloured` tells whether the residuals are not white.
    """
    structure, assembly, reweighted = optimum.problem.task.structure, optimum.problem.assembly, optimum.reweighted
    names = np.array([q.name for q in assembly.free])
    notes = [FitNote.ON_BOUND(f"{name} lies on a bound: no standard deviation") for name in names[on_bound]]
    notes += not_determined(spread.undetermined, names)
    if coloured:
        notes.append(
            FitNote.NOT_WHITE(
                "the residuals are not white: standard deviations are the robust ones, and do not contain the error of "
                f"the structure itself{weights_would_help(spread)}"
            )
        )
    if spread.flatness < FLATTEST:
        notes.append(
            FitNote.NO_MINIMUM(
                "this is not a minimum of the criterion, or it is flat in some direction: standard deviations use the "
                "Gauss-Newton curvature, and are too small; try other start values (fit_multistart)"
            )
        )
    if assembly.unused:
        notes.append(FitNote.NOT_USED(f"simulation focus does not use, set to 0: {', '.join(assembly.unused)}"))
        held = [name for name in assembly.unused if optimum.problem.begin[name] != 0]
        notes += [FitNote.NOT_USED(f"their start values were not used: {', '.join(held)}")] if held else []
    if reweighted is not None and reweighted.outlying:
        notes.append(f"robust loss: {100 * reweighted.outlying:.2g} % of the samples count less than half")
    known, short_names = {q.name for q in structure.parameters}, assembly.own_names
    if scheduled := kind_of(structure).scheduled:  # a coefficient may well be zero, too
        known &= {q.name for q in scheduled.base.parameters}
    # A disturbance gain or a trend may well be zero: an open sign says nothing of them.
    physical = np.array([short_names.get(name, name) in known for name in names], bool) & ~spread.open
    physical[list(optimum.shooting.noise)] = False
    white = spread.white[np.ix_(physical, physical)]
    sign_open = hardly_determined(theta[physical], white, names[physical])
    return (*notes, *assembly.notes, *sign_open, *far_below_white(spread, names))


_INVOLVED = 0.1  # smallest share of a parameter in a direction, of the largest share, for which it is named
_PEAK = 5.0  # power of the errors at the frequency of a mode, over their mean power, for which they hide its motion
_DECAYS = 25.0  # times that a mode decays in all records, below which its slow errors are seen too seldom
_HARDLY_ONE = 2.0  # times of decay below which the records do not show whether the errors move the mode
_UNSEEN = 1.0  # times of decay below which residuals do not show it at all
_LIGHT = 0.1  # damping factor below which a mode counts as lightly damped
_FREQUENCIES = 2048  # for the mean power
_NARROWER = 0.8  # ratio of intervals below which a model of the errors is worth its time
_FAR_BELOW = 1 / 3  # ratio of the standard deviations below which a note says so

_MOST_DIRECTIONS = 3  # largest number of undetermined directions that are listed one by one


def not_determined(directions: FloatArray, names: npt.NDArray[np.str_]) -> list[str]:
    """Return notes on directions (n_directions, n) without information: their parameters, and what is determined."""
    if len(directions) > _MOST_DIRECTIONS:
        text = f"the information is singular in {len(directions)} directions: no standard deviations"
        return [FitNote.NOT_DETERMINED(text)]
    notes = []
    for direction in directions:
        strong = np.flatnonzero(np.abs(direction) > _INVOLVED * np.abs(direction).max())
        involved = ", ".join(names[strong])
        if len(strong) == 1:
            text = f"the data do not determine {involved}: its input or state is not excited; fix it (fixed=...)"
        else:
            text = f"the data do not determine {involved} separately, only a combination; fix one (fixed=...)"
        notes.append(FitNote.NOT_DETERMINED(text))
    return notes


def hardly_determined(values: FloatArray, white: FloatArray, names: npt.NDArray[np.str_]) -> list[str]:
    """Return notes on the directions whose standard deviation for white errors exceeds the size of the parameters.

    Parameters
    ----------
    values : (n,) array
        Estimates.
    white : (n, n) array
        Their covariance for white errors.
    names : (n,) array of str
        Their names.

    Returns
    -------
    list of str
        One note for each direction.

    Notes
    -----
    The directions are the eigenvectors of the covariance relative to the estimates with eigenvalues above one. Along
    such a direction the sign of the estimates is open, however small the errors of the model are.
    """
    sigma = np.sqrt(np.maximum(np.diag(white), 0.0))
    open_sign = np.isfinite(sigma) & (sigma > np.abs(values)) & (values != 0)
    if not open_sign.any():
        return []
    chosen = np.flatnonzero(open_sign)
    size = np.abs(values[chosen])
    _, axes = np.linalg.eigh(white[np.ix_(chosen, chosen)] / np.outer(size, size))
    notes, told = [], np.zeros(len(chosen), bool)
    for direction in axes.T[::-1]:
        strong = np.abs(direction) > _INVOLVED * np.abs(direction).max()
        if told[strong].all():
            continue
        told |= strong
        involved = names[chosen[strong]]
        times = float((sigma[chosen] / size)[strong].max())
        if len(involved) == 1:
            text = (
                f"the data leave even the sign of {involved[0]} open: its standard deviation for white errors is "
                f"{times:.2g} times its size"
            )
        else:
            step = direction[strong] * size[strong]
            along = " : ".join(f"{part:.2g}" for part in step / step[np.argmax(np.abs(direction[strong]))])
            text = (
                f"the data leave even the sign of {', '.join(involved)} open: their standard deviations for white "
                f"errors are up to {times:.2g} times their sizes, along {along}; fix one (fixed=...), or state "
                "what is known (prior=...)"
            )
        notes.append(FitNote.SIGN_OPEN(text))
    return notes


def far_below_white(estimate: Covariance, names: npt.NDArray[np.str_]) -> list[str]:
    """Return a note on parameters with a robust standard deviation far below that for white errors."""
    white, robust = (np.sqrt(np.maximum(np.diag(c), 0.0)) for c in (estimate.white, estimate.robust))
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = robust / white
    low = np.flatnonzero(np.isfinite(ratio) & (white > 0) & (ratio < _FAR_BELOW))
    if not len(low):
        return []
    text = (
        f"standard deviations far below those for white errors (down to {float(ratio[low].min()):.2g} of them): "
        f"{', '.join(names[low])}; they hold only if the errors have hardly any power where these parameters act, as "
        "the residuals say; std_with('white') is the careful choice"
    )
    return [FitNote.FAR_BELOW_WHITE(text)]


def weights_would_help(spread: Covariance) -> str:
    """Return the advice to weight the errors by their model, where its intervals are narrower by a fifth or more.

    The intervals are compared by the geometric mean over the parameters. Recordings half as long again give as much.
    """
    if spread.weighted is None:
        return ""
    robust, weighted = np.diag(spread.robust), np.diag(spread.weighted)
    known = (robust > 0) & (weighted > 0)
    ratio = float(np.exp(0.5 * np.log(weighted[known] / robust[known]).mean())) if known.any() else 1.0
    if not ratio < _NARROWER:
        return ""
    return f"; errors='ar' with focus='simulation' would make intervals narrower, {ratio:.2g} times as wide"


def may_cover_less(
    models: Sequence[ErrorModel],
    modes: Sequence[tuple[float, float]],
    sample_time: float,
    n_samples: int,
    *,
    gain: bool = False,
) -> list[str]:
    """Return a note on intervals that contain the truth less often than they state.

    Parameters
    ----------
    models : sequence of ErrorModel
        Model of the errors of each record.
    modes : sequence of (frequency [Hz], damping factor)
        Modes of the structure at the estimate.
    sample_time : float
        Time between samples [s].
    n_samples : int
        Number of samples of all records.
    gain : bool
        Whether a disturbance gain makes the residuals white.

    Notes
    -----
    The study of docs/uncertainty.md has low coverage where two things come together: the errors have a peak at the
    frequency of a lightly damped mode, and the records last few of its times of decay. Then the fit explains a part of
    the errors as motion of the mode, and what is left says little of them. Below about two times of decay hardly a peak
    is left, so that any power above the mean counts. Below one the fit explains all that errors move the mode: even
    white residuals then do not show that they are sensor noise only. A disturbance gain tells both apart, but below one
    time of decay the estimates are not normally distributed (an autoregression near a unit root: Phillips, Biometrika
    74, 1987).
    """
    grid = np.pi * (np.arange(_FREQUENCIES) + 0.5) / _FREQUENCIES
    coloured = [model for model in models if model.order]
    power = [np.diagonal(model.spectrum(grid), axis1=1, axis2=2).real.mean(axis=0) for model in coloured]
    told = []
    for frequency, damping in modes:
        if not 0 < damping < _LIGHT:
            continue
        decays = 2 * np.pi * frequency * damping * sample_time * n_samples
        turn = np.array([2 * np.pi * frequency * sample_time * np.sqrt(1 - damping**2)])
        peaks = [
            float((np.diagonal(model.spectrum(turn)[0]).real / mean).max())
            for model, mean in zip(coloured, power, strict=True)
        ]
        if not gain and decays < _DECAYS and max(peaks, default=0.0) > (1.0 if decays < _HARDLY_ONE else _PEAK):
            text = (
                f"intervals may contain the truth less often than they state: at the mode of {frequency:.3g} Hz the "
                f"errors have {max(peaks):.2g} times their mean power, and the recordings last {decays:.2g} of its "
                "times of decay; record longer, or free a disturbance gain"
            )
            told.append(FitNote.MAY_COVER_LESS(text))
        elif decays < _UNSEEN:
            why = "are too short to tell its motion from what disturbances make of it; record longer"
            if not gain:
                why = "do not show whether disturbances move it; record longer, or free a disturbance gain"
            text = (
                f"intervals may contain the truth less often than they state: the recordings last {decays:.2g} times "
                f"of decay of the mode of {frequency:.3g} Hz, and {why}"
            )
            told.append(FitNote.MAY_COVER_LESS(text))
    return told


# ---- Status of a fit: whether what the solver calls converged is an estimate.

_WORSE = 0.01  # part by which the loss may exceed that of a constant: its mean takes a little of the noise along
_OF_A_MEAN = 10.0  # the same for short records, over the number of samples


def explains_nothing(problem: Shooting, products: FloatArray, outputs: list[FloatArray]) -> bool:
    """Return whether the fit is worse than the mean of each record.

    Parameters
    ----------
    problem : Shooting
        Problem of the fit, for its criterion.
    products : (n_y, n_y) array
        Sum of the products of the errors.
    outputs : list of (n_samples, n_y) array
        Outputs of each record that are in the cost.
    """
    centred = (centred_rows(y) for y in outputs if len(y))
    constant = problem.cost(np.asarray(sum(rows @ rows.T for rows in centred)))
    cost = problem.cost(products)
    return not cost <= constant + 0.5 * float(np.log1p(_WORSE + _OF_A_MEAN / problem.n_samples))


def verdict(
    status: FitStatus,
    *,
    overflows: bool,
    worse_than_constant: bool,
    at_edge: bool,
    shaft: bool,
    undetermined: BoolArray,
) -> FitStatus:
    """Return the status of a fit, which is a success only for an estimate.

    The solver has checked the first-order optimality already (`gbid.identify.problem.solve`).

    Parameters
    ----------
    status : FitStatus
        Status of the solver.
    overflows : bool
        Whether the errors or the parameters are not finite.
    worse_than_constant : bool
        Result of `explains_nothing`.
    at_edge : bool
        Whether the disturbance gain makes a predictor unstable or almost so, see `Shooting.parts_at_edge`.
    shaft : bool
        Whether a mode of the model is the rotation of the shaft, see `shaft_notes`.
    undetermined : (n_free,) boolean array
        Free parameters without a finite standard deviation that lie on no bound.
    """
    if overflows:
        return FitStatus.OVERFLOW
    if not status.success:
        return status
    if worse_than_constant:
        return FitStatus.WORSE_THAN_CONSTANT
    if at_edge:
        return FitStatus.UNSTABLE_PREDICTOR
    if shaft:
        return FitStatus.SHAFT_AS_MODE
    return FitStatus.NOT_DETERMINED if undetermined.any() else status


_HARMONICS = 10  # multiples of the speed that a run-out has
_APART = 10.0  # times the resolution between two multiples: else a mode is near one by chance


def shaft_notes(modes: Sequence[tuple[float, float]], data: FitData) -> tuple[str, ...]:
    """Return a note on each mode that is the rotation of the shaft: run-out or unbalance, taken for motion of a mode.

    Parameters
    ----------
    modes : sequence of (frequency [Hz], damping factor)
        Modes of the model.
    data : FitData
        Data of the fit. All recordings must state the same ``speed_rpm``, else there is no note.

    Notes
    -----
    The lines of the shaft have no width. A mode counts as one of them if its half-width (frequency times damping
    factor) and its distance from a multiple of the speed are both below the resolution 1 / T of the longest recording.
    """
    speeds = {float(record.conditions.get("speed_rpm", 0.0)) for record in data.records}
    resolution = 1 / (max(record.n_samples for record in data.records) * data.sample_time)
    line = speeds.pop() / 60
    if speeds or abs(line) < _APART * resolution:
        return ()
    notes = []
    for frequency, damping in modes:
        multiple = round(frequency / abs(line))
        sharp = abs(damping) * frequency < resolution
        if sharp and 1 <= multiple <= _HARMONICS and abs(frequency - multiple * abs(line)) < resolution:
            text = (
                f"the mode of {frequency:.5g} Hz with damping factor {damping:.2g} is {multiple} times the speed of "
                f"{60 * abs(line):g} rpm: run-out or unbalance, no mode of the rotor; subtract a map from a recording "
                "with piezos at rest (gbid.identify_runout, gbid.prefilter), or give the unbalance as an input "
                "(unbalance=True)"
            )
            notes.append(FitNote.SHAFT(text))
    return tuple(notes)
