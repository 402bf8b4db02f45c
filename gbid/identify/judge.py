"""Assessment of a solved problem: estimates, their uncertainty, the status, and checks that yield notes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from gbid.core.arrays import BoolArray, FloatArray
from gbid.core.notes import FitNote
from gbid.discretise.exact import check_holds
from gbid.identify.bias import Bias, bias_of
from gbid.identify.data import Record, centred_rows
from gbid.identify.data_notes import data_notes
from gbid.identify.frequency_fit import ResponseResiduals
from gbid.identify.pose import Optimum
from gbid.identify.problem.assemble import window_length
from gbid.identify.problem.integration import REFINING, at_working_point
from gbid.identify.problem.nlp import extra_notes
from gbid.identify.problem.solve import TOLERANCES, forces_of_bounds
from gbid.identify.problem.states import decay_notes, released_states
from gbid.identify.result import (
    FitDiagnosis,
    FitEstimates,
    FitProvenance,
    FitResult,
    FitStatus,
    FitUncertainty,
    StdKind,
)
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
from gbid.structure.kinds import kind_of

_EQUAL = 1e-3  # largest relative difference of parameters that count as equal: the data determine it less and less
_NEARLY_ALL = 0.99  # smallest share of their difference in what the data do not determine
_NEAR = 1e-2  # of the range between both bounds, farther from which an estimate lies on none, wherever the data push it
_WORSE = 0.01  # part by which the loss may exceed that of a constant: its mean takes a little of the noise along
_OF_A_MEAN = 10.0  # the same for short records, over the number of samples


def judge(optimum: Optimum) -> FitResult:
    """Return the result of a fit, assessed at the optimum of its problem (wall time is added later)."""
    judged = Judged(optimum)
    problem, task, assembly = optimum.problem, optimum.problem.task, optimum.problem.assembly
    parameters, spread, residuals = judged.parameters, judged.spread, judged.residuals
    units = {q.name: q.unit for q in problem.parameters} | task.disturbances.units(task.data.output_units)
    short = {name: assembly.own_names.get(name, name) for name in parameters}
    return FitResult(
        FitEstimates(
            structure=task.structure.name,
            parameters=parameters,
            units={name: units[short[name]] for name in parameters},
            free=judged.free,
            local_names=judged.local_names,
            initial_states=judged.initial_states,
            model=judged.model,
            sample_time=np.nan if task.data.is_irregular else task.data.sample_time,
            schedule=task.courses.schedule if task.courses else None,
            disturbances=task.disturbances,
            error_models=judged.error_models,
        ),
        FitUncertainty(
            std=judged.std,
            covariance=judged.covariance,
            covariance_white=spread.white,
            covariance_robust=spread.robust,
            trusted="none" if judged.left_out else judged.kind,
            modes_std=judged.model_spreads.modes,
            static_gain_std=judged.model_spreads.static_gain,
            model_slopes=judged.model_spreads.slopes,
            condition=spread.condition,
            hold_shift=judged.bias.moved,
            integration_shift=judged.integration_shift,
            profiler=judged.profiler,
        ),
        FitDiagnosis(
            status=judged.status,
            optimality=optimum.solution.rest,
            error_covariance=residuals.mean_square,
            fit_percent=residuals.fit_percent,
            whiteness=residuals.whiteness.p_value if residuals.finite else np.full(len(residuals.products), np.nan),
            **judged.scores,
            notes=tuple(note for check in CHECKS for note in check(judged)),
        ),
        FitProvenance(
            recordings=tuple(each.name for each in task.data.records or task.responses),
            options=task.options.settled(
                intersample=check_holds(task.hold, len(task.data.input_names)),
                criterion=residuals.estimate.problem.criterion,
                initial_state=task.states.choice,
                window=problem.window and window_length(optimum.shooting),
                robust_threshold=task.loss and task.loss.threshold,
            ),
            start={name: problem.begin[name] for name in parameters},
            start_origin={name: judged.origin(short[name]) for name in parameters},
            engine=assembly.engine,
            iterations=optimum.solution.iterations,
            phases=optimum.solution.phases,
            wall_time_s=0.0,
        ),
    )


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of a fit at its estimates, with fit percent and whiteness test.

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
        Whether the mean of each record explains the outputs as well.
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
        """Whether the errors are finite and smaller than those of a constant."""
        return self.finite and not self.worse_than_constant

    @property
    def coloured(self) -> bool:
        """Whether standard deviations for independent errors are invalid."""
        if self.responses is not None and self.responses.doubtful:
            return True
        return not (self.sound and self.whiteness.accepted[self.noisy].all())


def residuals_of(optimum: Optimum) -> Residuals:
    """Return the residuals of a fit at its optimum."""
    problem, shooting, solution = optimum.problem, optimum.shooting, optimum.solution
    windows = problem.assembly.record_window
    theta, starts = shooting.unpack(solution.unknowns)
    if not shooting.parts:
        return _of_responses(optimum, Estimate(shooting, theta, starts, windows))
    every = shooting.by_record(shooting.errors(shooting.values(theta), starts), windows)
    used = shooting.by_record([part.blocks.used[:, :, None] for part in shooting.parts], windows)
    outputs = [
        centred_rows(_counted_outputs(record, rows[:, 0] > 0))
        for record, rows in zip(problem.task.data.records, used, strict=True)
    ]
    squares = np.asarray(sum(e.T @ e for e in every) + shooting.absent)
    weighted = shooting if optimum.reweighted is None else optimum.reweighted.problem
    by_record, products = every, squares
    if weighted is not shooting:
        by_record = weighted.by_record(weighted.errors(weighted.values(theta), starts), windows)
        products = np.asarray(sum(e.T @ e for e in by_record) + weighted.absent)
    filters = optimum.weighted.filters if optimum.weighted else ()
    known = problem.task.states.in_shooting(weighted.n_states)
    estimate = Estimate(weighted, theta, starts, windows, known, filters)
    if filters and solution.status is not FitStatus.GROWS:
        by_record = [record.errors for record in filtered_records(estimate)]
        products = np.asarray(sum(e.T @ e for e in by_record))
    finite = bool(np.isfinite(products).all() and np.isfinite(theta).all())
    worse = False
    if finite and not optimum.weighted:
        constant = weighted.cost(np.asarray(sum(rows @ rows.T for rows in outputs if rows.size)))
        allowed = constant + 0.5 * float(np.log1p(_WORSE + _OF_A_MEAN / weighted.n_samples))
        worse = not weighted.cost(squares - shooting.absent) <= allowed
    return Residuals(
        estimate=estimate,
        by_record=by_record,
        products=products,
        mean_square=squares / weighted.n_samples,
        fit_percent=np.array([_fit_percent(*pair) for pair in zip(every, outputs, strict=True)]),
        whiteness=whiteness_test(by_record),
        finite=finite,
        worse_than_constant=worse,
        noisy=np.diag(squares) > weighted.floors,
    )


def _of_responses(optimum: Optimum, estimate: Estimate) -> Residuals:
    """Return the residuals of a fit to frequency responses alone."""
    each = ResponseResiduals.at(optimum.shooting.responses, estimate.theta)
    return Residuals(
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


def _counted_outputs(record: Record, counted: BoolArray) -> FloatArray:
    """Return the outputs at the samples in the cost; a missing output is replaced by the mean."""
    if record.missing is None:
        return record.outputs if counted.all() else record.outputs.compress(counted, axis=0)
    measured = np.where(record.missing, np.nan, record.outputs)[counted]
    return np.where(np.isnan(measured), np.nanmean(measured, axis=0), measured)


def _fit_percent(errors: FloatArray, centred: FloatArray) -> FloatArray:
    """Return ``100 (1 - |e| / |y - mean y|)`` of each output; `centred` has an output in each row."""
    left, full = ([each @ each for each in rows] for rows in (errors.T, centred))
    return np.asarray(100 * (1 - np.sqrt(np.divide(left, full))))


@dataclass(frozen=True, eq=False)
class Judged:
    """Optimum of a fit with residuals, covariance, bias, model and status, each computed once.

    Attributes
    ----------
    optimum : Optimum
        Problem, solution and options.
    """

    optimum: Optimum

    @cached_property
    def residuals(self) -> Residuals:
        """Residuals at the estimates."""
        return residuals_of(self.optimum)

    @property
    def estimate(self) -> Estimate:
        """Estimates, with the problem whose weights the errors have."""
        return self.residuals.estimate

    @cached_property
    def free(self) -> tuple[str, ...]:
        """Names of the free parameters in the order of the covariance."""
        return tuple(q.name for q in self.optimum.problem.assembly.free)

    @property
    def error_models(self) -> tuple[ErrorModel, ...]:
        """Autoregressive models that weight the errors; none without ``errors="ar"``."""
        return tuple(each.model for each in self.optimum.weighted.filters) if self.optimum.weighted else ()

    @property
    def kind(self) -> StdKind:
        """Kind of covariance that gives the standard deviations: "white", "robust" or "none"."""
        return "robust" if self.residuals.coloured else "white"

    @cached_property
    def on_bound(self) -> BoolArray:
        """Free parameters held by a bound, (n_theta,), which the data would move further."""
        optimum, at = self.optimum, self.estimate
        none = np.zeros(len(at.theta), bool)
        if not np.isfinite(self.residuals.products).all():
            return none
        force = forces_of_bounds(at.problem, optimum.solution.unknowns)
        if not force.any():
            return none
        lower, upper = np.array([(q.lower, q.upper) for q in optimum.problem.assembly.free]).T
        near = np.minimum(at.theta - lower, upper - at.theta) <= _NEAR * (upper - lower)
        return np.asarray(near & (force * np.sqrt(np.diag(self._spread_with(none).white)) > TOLERANCES.rest))

    def _spread_with(self, held: BoolArray, *, coloured: bool = False) -> Covariance:
        """Return the covariance with some parameters fixed; nan where it cannot be computed."""
        at, products = self.estimate, self.residuals.products
        try:
            if np.isfinite(products).all():
                return covariance(at, products, held, coloured=coloured)
        except np.linalg.LinAlgError:
            pass
        nothing = np.full((len(held), len(held)), np.nan)
        return Covariance(nothing, nothing, np.nan, np.zeros((0, len(held))), np.inf, curvature=nothing)

    @cached_property
    def coalescence(self) -> tuple[Covariance, list[tuple[int, int]]]:
        """Covariance from the noise alone, and coalescent pairs of exchangeable parameters.

        Where two such parameters are equal, nothing changes when they part by little: their difference has no
        information, or near there less than it needs. It is known nevertheless, for there what they can describe ends.
        The covariance of a pair is that of equal parameters.
        """
        optimum, theta, pairs = self.optimum, self.estimate.theta, list[tuple[int, int]]()
        spread = self._spread_with(self.on_bound, coloured=self.residuals.coloured)
        if optimum.reweighted is not None:
            spread = spread.scaled(*optimum.reweighted.factors)
        short = [optimum.problem.assembly.own_names.get(name, name) for name in self.free]
        for pair in getattr(kind_of(optimum.problem.task.structure).plant, "exchangeable", ()):
            one, other = ([i for i, name in enumerate(short) if name == each] for each in pair)
            for i, j in zip(one, other, strict=False):  # none, where one is fixed
                direction = np.zeros(len(theta))
                direction[[i, j]] = np.sqrt(0.5), -np.sqrt(0.5)
                shares, variance = spread.undetermined @ direction, float(direction @ spread.white @ direction)
                lost = np.linalg.norm(shares) > _NEARLY_ALL
                if abs(theta[i] - theta[j]) > _EQUAL * abs(theta[i]) or not (
                    lost or (direction @ theta) ** 2 < variance
                ):
                    continue
                if lost:
                    _, sizes, axes = np.linalg.svd(
                        spread.undetermined - np.outer(shares, direction), full_matrices=False
                    )
                    spread = spread._replace(undetermined=axes[sizes > _INVOLVED])
                else:
                    spread = spread.along(np.eye(len(theta)) - np.outer(spread.white @ direction, direction) / variance)
                pairs.append((i, j))
        return spread, pairs

    @property
    def of_noise(self) -> Covariance:
        """Covariance of the estimates from the noise alone."""
        return self.coalescence[0]

    @cached_property
    def unknown(self) -> BoolArray:
        """Free parameters without a standard deviation, (n_theta,)."""
        return np.asarray(self.on_bound | self.of_noise.open)

    @cached_property
    def bias(self) -> Bias:
        """Systematic errors of the estimates, beside the noise."""
        residuals, noisy = self.residuals, self.residuals.noisy
        if residuals.responses is not None or not (residuals.sound and self.optimum.solution.status.success):
            return Bias()
        std = np.where(self.unknown, np.nan, np.sqrt(np.diag(self.of_noise.of(self.kind))))
        errors = residuals.by_record if noisy.all() else [e * noisy for e in residuals.by_record]
        return bias_of(self.optimum, errors, std, white=not residuals.coloured)

    @property
    def left_out(self) -> bool:
        """Whether the structure is incomplete, so that no standard deviation is valid."""
        responses = self.residuals.responses
        if responses is None:
            return self.bias.left_out
        return responses.follow and not self.residuals.whiteness.accepted.all()

    @cached_property
    def spread(self) -> Covariance:
        """Covariance of the estimates, widened by the shifts from delay, hold and other maxima."""
        spread, bias, weighted = self.of_noise, self.bias, self.optimum.weighted
        if bias.moved is not None and bias.widens:
            spread = spread.widened(bias.moved)
        for shift in weighted.elsewhere if weighted else ():
            spread = spread.widened(shift)
        return spread

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance that the fit trusts, (n_theta, n_theta)."""
        return self.spread.of(self.kind)

    @cached_property
    def local_names(self) -> dict[str, dict[str, str]]:
        """Full names of local parameters, by recording and name in the structure."""
        records = zip(self.optimum.problem.task.data.records, self.optimum.problem.assembly.record_names, strict=True)
        local = {r.name: {short: full for short, full in names.items() if short != full} for r, names in records}
        return {name: names for name, names in local.items() if names}

    @cached_property
    def parameters(self) -> dict[str, float]:
        """All parameters by full name."""
        values = {
            **self.optimum.problem.begin,
            **dict.fromkeys(self.optimum.problem.assembly.unused, 0.0),
            **dict(zip(self.free, self.estimate.theta.tolist(), strict=True)),
        }
        local = {short for names in self.local_names.values() for short in names}
        return {name: value for name, value in values.items() if name not in local}

    @cached_property
    def std(self) -> dict[str, float]:
        """Standard deviation of each parameter: zero if fixed, nan if not determined."""
        std = dict.fromkeys(self.parameters, np.nan) | {q.name: 0.0 for q in self.optimum.problem.parameters if q.fixed}
        known = np.where(self.unknown, np.nan, np.sqrt(np.diag(self.covariance)))
        std |= dict(zip(self.free, known.tolist(), strict=True))
        return {name: std[name] for name in self.parameters}

    @property
    def initial_states(self) -> FloatArray:
        """Initial state of each recording, (n_records, n)."""
        task, n = self.optimum.problem.task, self.optimum.problem.assembly.n_states
        at, windows = self.estimate, self.optimum.problem.assembly.record_window
        if not at.problem.parts:
            return np.zeros((len(task.responses), n))
        return (at.starts[windows] + released_states(self.optimum.shooting, at.theta, windows))[:, :n]

    @cached_property
    def model(self) -> Any:
        """Model of the first recording."""
        task, at = self.optimum.problem.task, self.estimate
        kind, data = kind_of(task.structure), task.data
        full_names = next(iter(self.optimum.problem.assembly.record_names), {})
        stated = {q.name: self.parameters[full_names.get(q.name, q.name)] for q in task.structure.parameters}
        model = kind.model(stated, data.input_names, data.output_names)
        return at_working_point(model, at.problem, at.theta, at.starts, data) if kind.nonlinear else model

    @cached_property
    def modes(self) -> list[tuple[float, float]]:
        """Natural frequencies [Hz] and damping factors of the model."""
        return list(self.model.modes())

    @cached_property
    def model_spreads(self) -> ModelSpreads:
        """Derivatives and standard deviations of the model."""
        structure = self.optimum.problem.task.structure
        scheduled, tie = kind_of(structure).scheduled, None
        if scheduled:
            tie = centre_tie(scheduled, self.estimate.problem.groups[0].predictor.free, list(self.free))
        names = [q.name for q in structure.parameters]
        return model_spreads(self.estimate, self.covariance, self.model, names, tie)

    @cached_property
    def scores(self) -> dict[str, float]:
        """Loss, likelihood and information criteria: fields of `FitDiagnosis`."""
        at, mean_square, responses = self.estimate, self.residuals.mean_square, self.residuals.responses
        if responses is not None:
            loss, likelihood, k = responses.loss, responses.log_likelihood, len(at.theta)
            return {"loss": loss, "log_likelihood": likelihood, "aic": 2 * k - 2 * likelihood, "fpe": np.nan}
        n, k = at.problem.n_samples, len(at.theta) + int((~at.given).sum())
        log_det = float(np.linalg.slogdet(mean_square)[1]) if np.isfinite(mean_square).all() else np.nan
        per_sample = len(mean_square) * (1 + float(np.log(2 * np.pi)))
        if self.optimum.weighted is not None:  # likelihood and coefficients of the models of the errors
            log_det = -2 * self.optimum.weighted.log_likelihood / n - per_sample
            k += sum(model.coefficients.size for model in self.error_models)
        for_gaps = sum(gains.spread for part in at.problem.parts for gains in part.blocks.gains)
        volume = float(
            np.maximum(np.linalg.det(mean_square), 0.0)
        )  # below zero by rounding, of errors without full rank
        return {
            "loss": float(np.trace(mean_square)) if at.problem.criterion == "trace" else volume,
            "log_likelihood": -0.5 * (n * (log_det + per_sample) + for_gaps),
            "aic": n * log_det + for_gaps + 2 * k,
            "fpe": float(np.exp(log_det) * (1 + k / n) / max(1 - k / n, 1e-12)),
        }

    @cached_property
    def at_edge(self) -> bool:
        """Whether the disturbance gain makes a predictor unstable or nearly unstable."""
        return self.residuals.finite and any(self.optimum.shooting.parts_at_edge(self.estimate.theta))

    @cached_property
    def shaft(self) -> tuple[str, ...]:
        """Notes on modes at the frequency of the shaft."""
        return tuple(shaft_as_mode(self))

    @cached_property
    def status(self) -> FitStatus:
        """Status of the fit; success only if the solver converged to a valid estimate."""
        status = self.optimum.solution.status
        if not self.residuals.finite:
            return FitStatus.OVERFLOW
        if not status.success:
            return status
        if self.residuals.worse_than_constant:
            return FitStatus.WORSE_THAN_CONSTANT
        if self.at_edge:
            return FitStatus.UNSTABLE_PREDICTOR
        if self.shaft:
            return FitStatus.SHAFT_AS_MODE
        open_ones = ~self.on_bound & ~np.isfinite([self.std[name] for name in self.free])
        return FitStatus.NOT_DETERMINED if open_ones.any() else status

    @cached_property
    def integration_shift(self) -> FloatArray | None:
        """Shift of the estimates when the integrator step is halved, in standard deviations, (n_theta,)."""
        shift = self.optimum.integration_shift
        if shift is None:
            return None
        std = np.array([self.std[name] for name in self.free])
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(std > 0, shift / std, np.nan)

    @property
    def profiler(self) -> Profiler | None:
        """Object that computes profile likelihoods; None for a fit with error models."""
        if self.optimum.weighted:
            return None
        return Profiler(
            self.free,
            self.scores["loss"],
            self.estimate,
            self.residuals.products,
            self.on_bound,
            np.where(self.unknown, np.nan, np.diag(self.covariance)),
            np.diag(self.spread.curvature),
            self.residuals.coloured,
        )

    def origin(self, name: str) -> str:
        """Return the origin of a parameter's start value; "data" if it differs from the start values of the task."""
        begin = self.optimum.problem.task.begin
        if name not in begin.origin:
            return "structure"
        return begin.origin[name] if self.optimum.problem.start[name] == begin.values[name] else "data"


# ---- Checks of a fit: each function yields the notes of one check.

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
_HARMONICS = 10  # multiples of the speed that a run-out has
_APART = 10.0  # times the resolution between two multiples: else a mode is near one by chance


def parameters_on_bound(judged: Judged) -> Iterator[str]:
    """Yield a note on each parameter whose estimate is on a bound."""
    for i in np.flatnonzero(judged.on_bound):
        yield FitNote.ON_BOUND(f"{judged.free[i]} lies on a bound: no standard deviation")


def not_determined(judged: Judged) -> Iterator[str]:
    """Yield notes on parameter directions without information, and on the combinations that are determined."""
    directions, names = judged.of_noise.undetermined, np.array(judged.free)
    if len(directions) > _MOST_DIRECTIONS:
        text = f"the information is singular in {len(directions)} directions: no standard deviations"
        yield FitNote.NOT_DETERMINED(text)
        return
    for direction in directions:
        strong = np.flatnonzero(np.abs(direction) > _INVOLVED * np.abs(direction).max())
        involved = ", ".join(names[strong])
        if len(strong) == 1:
            text = f"the data do not determine {involved}: its input or state is not excited; fix it (fixed=...)"
        else:
            text = f"the data do not determine {involved} separately, only a combination; fix one (fixed=...)"
        yield FitNote.NOT_DETERMINED(text)


def not_white(judged: Judged) -> Iterator[str]:
    """Yield a note on coloured residuals, with the advice to weight the errors by a model where it is worthwhile.

    It is where the intervals, by their geometric mean over the parameters, are narrower by a fifth or more: recordings
    half as long again give as much.
    """
    residuals, spread = judged.residuals, judged.of_noise
    if not residuals.coloured or residuals.responses is not None or judged.bias.explains_colour:
        return
    text = (
        "the residuals are not white: standard deviations are the robust ones, and do not contain the error of the "
        "structure itself"
    )
    if spread.weighted is not None:
        robust, weighted = np.diag(spread.robust), np.diag(spread.weighted)
        known = (robust > 0) & (weighted > 0)
        ratio = float(np.exp(0.5 * np.log(weighted[known] / robust[known]).mean())) if known.any() else 1.0
        if ratio < _NARROWER:
            text += f"; errors='ar' with focus='simulation' would make intervals narrower, {ratio:.2g} times as wide"
    yield FitNote.NOT_WHITE(text)


def no_minimum(judged: Judged) -> Iterator[str]:
    """Yield a note on a point where the criterion is flat or falls in some direction."""
    if judged.of_noise.flatness < FLATTEST:
        yield FitNote.NO_MINIMUM(
            "the result is not a minimum of the criterion, or the minimum is flat in some direction: standard "
            "deviations use the Gauss-Newton curvature, and are too small; try other start values (fit_multistart)"
        )


def not_used(judged: Judged) -> Iterator[str]:
    """Yield notes on parameters without effect for the focus, on downweighted outliers, and on the assembly."""
    optimum, assembly = judged.optimum, judged.optimum.problem.assembly
    if assembly.unused:
        yield FitNote.NOT_USED(f"not used in simulation focus, set to 0: {', '.join(assembly.unused)}")
        held = [name for name in assembly.unused if optimum.problem.begin[name] != 0]
        if held:
            yield FitNote.NOT_USED(f"their start values were not used: {', '.join(held)}")
    if optimum.reweighted is not None and optimum.reweighted.outlying:
        yield f"robust loss: {100 * optimum.reweighted.outlying:.2g} % of the samples count less than half"
    yield from assembly.notes


def sign_open(judged: Judged) -> Iterable[str]:
    """Return notes on parameters of undetermined sign; disturbance gains, trends and coefficients may be zero."""
    optimum, free = judged.optimum, judged.free
    structure, short = optimum.problem.task.structure, optimum.problem.assembly.own_names
    known = {q.name for q in structure.parameters}
    if scheduled := kind_of(structure).scheduled:
        known &= {q.name for q in scheduled.base.parameters}
    physical = np.array([short.get(name, name) in known for name in free], bool) & ~judged.of_noise.open
    physical[list(optimum.shooting.noise)] = False
    white = judged.of_noise.white[np.ix_(physical, physical)]
    return hardly_determined(judged.estimate.theta[physical], white, np.array(free)[physical])


def hardly_determined(values: FloatArray, white: FloatArray, names: npt.NDArray[np.str_]) -> list[str]:
    """Return notes on directions whose standard deviation (white errors) exceeds the size of the parameters.

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
    notes, reported = [], np.zeros(len(chosen), bool)
    for direction in axes.T[::-1]:
        strong = np.abs(direction) > _INVOLVED * np.abs(direction).max()
        if reported[strong].all():
            continue
        reported |= strong
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


def far_below_white(judged: Judged) -> Iterator[str]:
    """Yield a note on parameters whose robust standard deviation is far below the one for white errors."""
    spread = judged.of_noise
    white, robust = (np.sqrt(np.maximum(np.diag(c), 0.0)) for c in (spread.white, spread.robust))
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = robust / white
    low = np.flatnonzero(np.isfinite(ratio) & (white > 0) & (ratio < _FAR_BELOW))
    if len(low):
        yield FitNote.FAR_BELOW_WHITE(
            f"standard deviations far below those for white errors (down to {float(ratio[low].min()):.2g} of them): "
            f"{', '.join(np.array(judged.free)[low])}; they hold only if the errors have hardly any power where these "
            "parameters act, as the residuals indicate; std_with('white') is the conservative choice"
        )


def biased(judged: Judged) -> Iterator[str]:
    """Yield notes on systematic errors of the estimates."""
    residuals = judged.residuals
    if residuals.responses is not None and not residuals.whiteness.accepted.all():
        yield from residuals.responses.notes
    yield from judged.bias.notes


def low_coverage(judged: Judged) -> Iterator[str]:
    """Yield notes on confidence intervals with too low coverage; see `may_cover_less`."""
    residuals, data, model = judged.residuals, judged.optimum.problem.task.data, judged.model
    if residuals.responses is None:
        # White residuals tell of disturbances where a gain takes them in; one that is held at zero does not.
        gain = not residuals.coloured and model.K is not None and bool(model.K.any())
        models = judged.error_models or judged.spread.models
        lost = sum(int(record.missing.all(axis=1).sum()) for record in data.records if record.missing is not None)
        n_samples = min(judged.estimate.problem.n_samples + lost, sum(record.n_samples for record in data.records))
        yield from may_cover_less(models, judged.modes, data.sample_time, n_samples, gain=gain)


def may_cover_less(
    models: Sequence[ErrorModel],
    modes: Sequence[tuple[float, float]],
    sample_time: float,
    n_samples: int,
    *,
    gain: bool = False,
) -> list[str]:
    """Return a note on confidence intervals that contain the truth less often than they state.

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
    modes_named = []
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
            modes_named.append(FitNote.MAY_COVER_LESS(text))
        elif decays < _UNSEEN:
            why = "are too short to separate its motion from the effect of disturbances; record longer"
            if not gain:
                why = "do not show whether disturbances excite it; record longer, or free a disturbance gain"
            text = (
                f"intervals may contain the truth less often than they state: the recordings last {decays:.2g} times "
                f"of decay of the mode of {frequency:.3g} Hz, and {why}"
            )
            modes_named.append(FitNote.MAY_COVER_LESS(text))
    return modes_named


def predictor_at_edge(judged: Judged) -> Iterator[str]:
    """Yield a note on a predictor that is nearly unstable."""
    if judged.at_edge:
        yield FitNote.PREDICTOR_AT_EDGE(
            "the disturbance gain makes the predictor almost unstable: the record is too short to estimate it; "
            "fix it (fixed=...) or use focus='simulation'"
        )


def equal_poles(judged: Judged) -> Iterator[str]:
    """Yield a note on each coalescent pair of exchangeable parameters."""
    for i, j in judged.coalescence[1]:
        text = f"{judged.free[i]} and {judged.free[j]} are equal: complex poles may have a lower loss"
        yield FitNote.EQUAL_POLES(f"{text}; fit PiezoPair(poles='any')")


def shaft_as_mode(judged: Judged) -> Iterator[str]:
    """Yield a note on each mode at the shaft frequency: run-out or unbalance, mistaken for a vibration.

    Notes
    -----
    All recordings must state the same ``speed_rpm``. The lines of the shaft have no width. A mode counts as one of them
    if its half-width (frequency times damping factor) and its distance from a multiple of the speed are both below the
    resolution 1 / T of the longest recording.
    """
    data = judged.optimum.problem.task.data
    if not (judged.residuals.finite and data.records):
        return
    speeds = {float(record.conditions.get("speed_rpm", 0.0)) for record in data.records}
    resolution = 1 / (max(record.n_samples for record in data.records) * data.sample_time)
    line = speeds.pop() / 60
    if speeds or abs(line) < _APART * resolution:
        return
    for frequency, damping in judged.modes:
        multiple = round(frequency / abs(line))
        sharp = abs(damping) * frequency < resolution
        if sharp and 1 <= multiple <= _HARMONICS and abs(frequency - multiple * abs(line)) < resolution:
            yield FitNote.SHAFT(
                f"the mode of {frequency:.5g} Hz with damping factor {damping:.2g} is {multiple} times the speed of "
                f"{60 * abs(line):g} rpm: run-out or unbalance, no mode of the rotor; subtract a map from a recording "
                "with piezos at rest (gbid.identify_runout, gbid.prefilter), or give the unbalance as an input "
                "(unbalance=True)"
            )


def before_the_optimum(judged: Judged) -> Iterator[str]:
    """Yield the notes of start values, initial states and solver, and a note on overflows of the model."""
    optimum, task = judged.optimum, judged.optimum.problem.task
    yield from (*optimum.notes, *task.begin.notes, *task.states.notes)
    if optimum.solution.overflows:
        count = optimum.solution.overflows
        yield FitNote.OVERFLOWS(
            f"the model overflows at {count} of the points that the solver tried; the solver stepped back"
        )


def integration(judged: Judged) -> Iterator[str]:
    """Yield a note on estimates that depend on the integrator step or on the length of the pieces."""
    shift = judged.integration_shift
    if shift is None or not judged.status.success:
        return
    shifts = [
        f"{q} by {abs(off):.2g}" for q, off in zip(judged.free, shift, strict=True) if abs(off) > REFINING.tolerated
    ]
    if not shifts:
        return
    task, moved_names = judged.optimum.problem.task, ", ".join(shifts)
    if task.courses:
        yield FitNote.PIECES(
            f"{task.courses.schedule.pieces} pieces with constant parameters are too few for the courses: with shorter "
            f"ones estimates move, in standard deviations: {moved_names}; make piece_s shorter, or fit fewer recordings"
        )
    else:
        yield FitNote.INTEGRATION(
            f"the error of the integration moves estimates, in standard deviations: {moved_names}; take more "
            "steps in a sample (steps=...), or integrator='implicit'"
        )


CHECKS: tuple[Callable[[Judged], Iterable[str]], ...] = (
    parameters_on_bound,
    not_determined,
    not_white,
    no_minimum,
    not_used,
    sign_open,
    far_below_white,
    biased,
    low_coverage,
    predictor_at_edge,
    equal_poles,
    lambda judged: judged.shaft,
    before_the_optimum,
    lambda judged: decay_notes(judged.optimum.problem.task.data),
    lambda judged: data_notes(judged.optimum.problem.task),
    lambda judged: extra_notes(judged.optimum.shooting, judged.optimum.solution.unknowns),
    integration,
)
"""All checks, in the order of their notes in a result."""
