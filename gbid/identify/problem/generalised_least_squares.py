"""Generalised least squares of a simulation: an autoregression of the errors whitens errors and sensitivities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy

from gbid.core.arrays import BoolArray, FloatArray, IntArray
from gbid.core.errors import UsageError
from gbid.core.notes import FitNote
from gbid.discretise.dual import Dual
from gbid.identify.options import FitArguments
from gbid.identify.predictor import Predictor
from gbid.identify.problem.hessian import in_one_window, in_windows
from gbid.identify.problem.nlp import Shooting
from gbid.identify.problem.solve import Progress, Solution
from gbid.identify.result import FitStatus
from gbid.identify.uncertainty.coloured import (
    Whitening,
    error_models,
    log_likelihood,
    transformed,
    whitened,
    whitening,
)
from gbid.identify.uncertainty.covariance import Estimate, grows, information_over_records, mode_slopes


@dataclass(frozen=True)
class Weighting:
    """Limits of the local searches and of the frequency scan; lengths are in standard deviations.

    Attributes
    ----------
    at_rest : float
        Length of a step that is nothing.
    settled : float
        The same for a round with a new model of the errors.
    rest : float
        Length up to which a point from which no step leads lower counts as the minimum.
    apart : float
        Distance of two minima.
    likely : float
        Difference of log-likelihoods up to which data do not tell two minima apart: odds of 20 to 1.
    rounds : int
        Models of the errors.
    free_orders : int
        Rounds in which the order is chosen anew: later it may go back and forth between two.
    halvings : int
        Halvings of a step that does not lead lower.
    flat : float
        Curvature of an undetermined direction, as a part of the largest.
    light : float
        Damping factor below which a mode is so narrow that noise has lines like it.
    cells : int
        Frequencies that the recordings tell apart, 1 / T from each other, to each side of a mode.
    beside : tuple
        Of these, the ones at which the mode explains nothing but noise.
    held : float
        Information on what is held, in units of that of the data.
    most_modes : int
        Modes that are scanned: recordings with local parameters have modes of their own.
    """

    at_rest: float = 1e-3
    settled: float = 1e-2
    rest: float = 0.1
    apart: float = 3.0
    likely: float = 3.0
    rounds: int = 30
    free_orders: int = 5
    halvings: int = 12
    flat: float = 1e-13
    light: float = 0.1
    cells: int = 16
    beside: tuple[int, ...] = (2, 3)
    held: float = 1e6
    most_modes: int = 8


WEIGHTING = Weighting()


class WeightedErrors(NamedTuple):
    """Result of generalised least squares.

    Attributes
    ----------
    filters : tuple of Whitening
        Filter of the errors of each record.
    log_likelihood : float
        Gaussian log-likelihood of all errors.
    elsewhere : (n_maxima, n_theta) array
        How far other maxima of the likelihood are, times the root of their share of it.
    notes : tuple of str
        Note on another minimum.
    """

    filters: tuple[Whitening, ...]
    log_likelihood: float
    elsewhere: FloatArray
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class WeightedProblem:
    """Problem of generalised least squares for a simulation.

    Attributes
    ----------
    shooting : Shooting
        The problem.
    record_window : (n_records,) integer array
        First window of each record.
    known : (n_records, n) boolean array
        Initial states that are not estimated.
    options : FitArguments
        Options of the fit.
    names : tuple of str
        Names of its parameters.
    """

    shooting: Shooting
    record_window: IntArray
    known: BoolArray
    options: FitArguments
    names: tuple[str, ...]

    def in_one_window(self) -> tuple[WeightedProblem, IntArray]:
        """Return the problem with one window for each segment, and the indices of the remaining unknowns."""
        joined, kept = in_one_window(self.shooting)
        windows = (kept[joined.n_theta :: joined.n_states] - joined.n_theta) // joined.n_states
        return replace(self, shooting=joined, record_window=np.searchsorted(windows, self.record_window)), kept

    def estimate(self, z: FloatArray) -> Estimate:
        """Return the point with given parameters and initial states of all records, with all gaps closed."""
        problem, n = self.shooting, self.shooting.n_states
        theta, starts = z[: problem.n_theta], np.zeros((problem.n_windows, n))
        starts[self.record_window] = z[problem.n_theta :].reshape(-1, n)
        values, weight = problem.values(theta), np.eye(len(problem.output_weights))
        for a, b in problem.links.tolist():
            starts[b] = np.concatenate([sweep.end for sweep in problem.sweeps(values, starts, weight)])[a]
        return Estimate(problem, theta, starts, self.record_window, self.known)

    def coordinates(self, unknowns: FloatArray) -> FloatArray:
        """Return parameters and initial states from scaled unknowns."""
        theta, starts = self.shooting.unpack(unknowns)
        return np.concatenate([theta, starts[self.record_window].ravel()])

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Bounds of parameters and initial states."""
        lower, upper = (self.coordinates(edge) for edge in self.shooting.box)
        return lower, upper

    def is_elsewhere(self, z: FloatArray, minimum: _Descended) -> bool:
        """Return whether a point is far from a minimum, in standard deviations."""
        return not minimum.status.success or bool(_distance(minimum, z, self.shooting.n_theta).max() > WEIGHTING.apart)

    def filters(self, at: Estimate, C: FloatArray, orders: Sequence[int] | None = None) -> tuple[Whitening, ...]:
        """Return the whitening filters from the residuals at a point, corrected for the degrees of freedom.

        `C` is the covariance of the estimates; `orders` replace those of Akaike's criterion.
        """
        every, weight = np.arange(at.n_all), np.eye(len(self.shooting.output_weights))
        records = information_over_records(at, weight).sensitivities
        models = error_models((transformed(record, every) for record in records), C, orders)
        return tuple(whitening(model, n) for model, n in zip(models, _samples(at), strict=True))


class _Normal(NamedTuple):
    """Normal equations at a point: cost, negative gradient, Gauss-Newton Hessian, log-likelihood."""

    cost: float
    descent: FloatArray
    hessian: FloatArray
    log_likelihood: float


class _Descended(NamedTuple):
    """Result of a local search: point, filters, normal equations, status, iterations, length of the next step."""

    z: FloatArray
    filters: tuple[Whitening, ...]
    normal: _Normal
    status: FitStatus
    iterations: int
    rest: float

    @property
    def score(self) -> float:
        """Log-likelihood minus the number of coefficients of the error models (AIC)."""
        return _score(self.normal, self.filters)


def weighted_solution(problem: WeightedProblem, first: Solution, start: FloatArray) -> tuple[WeightedErrors, Solution]:
    """Return the minimum of generalised least squares, searched from a least-squares solution.

    Parameters
    ----------
    problem : WeightedProblem
        Problem of least squares, in any windows.
    first : Solution
        Its solution.
    start : (n_unknowns,) array
        Start of the fit, scaled.

    Returns
    -------
    WeightedErrors
        Filters of the errors and the likelihood.
    Solution
        The solution, with the iterations of all rounds.

    Raises
    ------
    UsageError
        When the predictor feeds measured outputs back.

    Notes
    -----
    Cochrane and Orcutt, Journal of the American Statistical Association 44, 1949. Each record has a vector
    autoregression of its residuals: records may be taken under other conditions, and outputs of one rotor are moved by
    the same forces. The largest order is a twentieth of the samples over the outputs. What the fit took from the errors
    is given back to the residuals. Gauss-Newton steps go to the minimum for a model of the errors; from its residuals
    comes the next model.

    Coloured errors give the likelihood several maxima along the frequency of a light mode, about one in each interval
    of 1 / T that recordings of length T tell apart. Least squares may have gone from the start to a far one, so the
    descent begins at both, and a scan goes along the frequency (`_scanned`). Of the n / 2 frequencies that n samples
    tell apart, the best one gains log(n / 2) of log-likelihood by chance. The maximum that is reached from the start
    counts unless another one is better by more. The others widen the intervals, each by its likelihood.
    """
    if not all(segment.is_plain for part in problem.shooting.parts for segment in part.blocks.segments):
        raise UsageError(
            "errors='ar' needs every output sample, and some are missing (NaN) or at irregular times; use "
            "errors='white'"
        )
    if any(part.predictor.feeds_back for part in problem.shooting.parts):
        raise UsageError("errors = 'ar' is for a simulation: this predictor feeds measured outputs back")
    task, kept = problem.in_one_window()
    joined = task.shooting
    begin, chance = task.coordinates(start[kept]), float(np.log(joined.n_samples / 2))
    minimum = _descend(task, task.coordinates(first.unknowns[kept]))
    points = list[_Point | _Descended]()
    if task.is_elsewhere(begin, minimum):
        points.append(minimum)
        minimum = _likelier(_descend(task, begin), minimum, chance)
    if minimum.status.success:
        scanned = _scanned(task, minimum, chance + WEIGHTING.likely)
        points += scanned
        top = max(scanned, key=lambda point: point.score, default=minimum)
        if top.score > minimum.score and task.is_elsewhere(top.z, minimum):
            points.append(minimum)
            minimum = _likelier(minimum, _descend(task, top.z), chance)
    elsewhere = [point for point in points if task.is_elsewhere(point.z, minimum)] if minimum.status.success else []
    unknowns = joined.pack(*(getattr(task.estimate(minimum.z), name) for name in ("theta", "starts")))
    solution = replace(
        first,
        unknowns=in_windows(problem.shooting, joined, unknowns),
        status=minimum.status,
        iterations=first.iterations + minimum.iterations,
        rest=minimum.rest,
    )
    likelihood = minimum.normal.log_likelihood
    return WeightedErrors(minimum.filters, likelihood, *_elsewhere(minimum, elsewhere, problem.names)), solution


def _likelier(minimum: _Descended, other: _Descended, chance: float) -> _Descended:
    """Return the better of two minima; the second must be better by more than chance, or the only converged one."""
    better = other.score > minimum.score + chance if minimum.status.success else True
    iterations = minimum.iterations + other.iterations
    return (other if other.status.success and better else minimum)._replace(iterations=iterations)


def _elsewhere(
    minimum: _Descended, points: Sequence[_Point | _Descended], names: Sequence[str]
) -> tuple[FloatArray, tuple[str, ...]]:
    """Return distances of other maxima, times the root of their likelihood share, and a note.

    The covariance about the estimate, of a mixture of normal distributions with these shares, is that of the minimum
    and the sum of the products of the rows.
    """
    n = len(names)
    if not points:
        return np.zeros((0, n)), ()
    scores = np.array([minimum.score, *(point.score for point in points)])
    likely = np.exp(scores - scores.max())
    rows = np.sqrt(likely / likely.sum())[1:, None] * np.array([point.z[:n] - minimum.z[:n] for point in points])
    best = max(points, key=lambda point: point.score)
    distances, gain = _distance(minimum, best.z, n), minimum.score - best.score
    if gain > WEIGHTING.likely:
        return rows, ()
    worst = int(np.argmax(distances))
    text = (
        f"the likelihood has two maxima whose logarithms differ by {abs(gain):.2g}, which chance explains: "
        f"{names[worst]} is {best.z[worst]:.6g} at the other one, {distances[worst]:.2g} standard deviations away; the "
        "result is the maximum reached from the start values, and intervals are widened by the other maxima"
    )
    return rows, (FitNote.LIKELY_ELSEWHERE(text),)


class _Point(NamedTuple):
    """Point of the likelihood: log-likelihood minus number of error-model coefficients, and the unknowns."""

    score: float
    z: FloatArray


class _Mode(NamedTuple):
    """Lightly damped mode: frequency in cycles per sample, and derivatives of frequency and damping."""

    frequency: float
    slopes: FloatArray


def _scanned(task: WeightedProblem, minimum: _Descended, enough: float) -> list[_Point]:
    """Return maxima of the likelihood along the frequencies of lightly damped modes.

    The frequency of each light mode goes by halves of 1 / T to both sides, alone. A Gauss-Newton step that holds
    frequencies and dampings of all light modes brings the other unknowns along. A mode is left out if the likelihood
    beside its frequency is lower by more than `enough`: then noise has no line that explains as much.
    """
    if not any(each.model.order for each in minimum.filters):  # white errors have one maximum
        return []
    half = 0.5 / max(len(segment.outputs) for part in task.shooting.parts for segment in part.blocks.segments)
    tops = list[_Point]()
    for mode in _light_modes(task, minimum.z)[: WEIGHTING.most_modes]:
        below, above = (_along(task, minimum.z, mode.frequency, side * half) for side in (-1, 1))
        beside = [
            _with_modes_held(task, side[2 * i - 1])
            for side in (below, above)
            for i in WEIGHTING.beside
            if len(side) >= 2 * i
        ]
        if max((point.score for point in beside), default=-np.inf) < minimum.score - enough:
            continue
        row = [_with_modes_held(task, z) for z in [*below[::-1], minimum.z, *above]]
        height = np.array([-np.inf, *(point.score for point in row), -np.inf])
        tops += [row[i] for i in np.flatnonzero((height[1:-1] > height[:-2]) & (height[1:-1] >= height[2:]))]
    return tops


def _along(task: WeightedProblem, z: FloatArray, frequency: float, step: float) -> list[FloatArray]:
    """Return points with the frequency of a mode changed step by step; the steps end at a bound."""
    lower, upper = task.bounds
    n, points = task.shooting.n_theta, list[FloatArray]()
    size = task.shooting.theta_scale**2
    for _ in range(2 * WEIGHTING.cells):
        modes = _light_modes(task, z)
        if not modes:
            break
        mode = min(modes, key=lambda each: abs(each.frequency - frequency))
        frequency += step
        slope = size * mode.slopes[:, 0]
        z = z.copy()
        z[:n] += slope * (frequency - mode.frequency) / max(float(slope @ mode.slopes[:, 0]), np.finfo(float).tiny)
        if (z < lower).any() or (z > upper).any():
            break
        points.append(z)
    return points


def _light_modes(task: WeightedProblem, z: FloatArray) -> list[_Mode]:
    """Return the lightly damped modes of all linear predictors."""
    problem, modes_of = task.shooting, dict[int, list[_Mode]]()
    for part, v in zip(problem.parts, problem.values(z[: problem.n_theta]), strict=True):
        if id(v) in modes_of or not isinstance(part.predictor, Predictor):
            continue
        modes, slopes = mode_slopes(Dual(v.F, v.dF), 1.0)
        modes_of[id(v)] = []
        for (frequency, damping), slope in zip(modes.tolist(), slopes.transpose(1, 0, 2), strict=True):
            if 0 < damping < WEIGHTING.light:
                every = np.zeros((problem.n_theta, 2))
                every[part.index] = slope if part.tie is None else part.tie.T @ slope
                modes_of[id(v)].append(_Mode(frequency, every))
    return [mode for modes in modes_of.values() for mode in modes]


def _with_modes_held(task: WeightedProblem, z: FloatArray) -> _Point:
    """Return a point after a Gauss-Newton step with fixed lightly damped modes."""
    held = np.hstack([mode.slopes for mode in _light_modes(task, z)])
    held = np.vstack([held, np.zeros((len(z) - len(held), held.shape[1]))])
    C, score = np.zeros((len(z), len(z))), -np.inf
    for last in (False, True):
        at = task.estimate(z)
        filters = () if grows(at) else task.filters(at, C)
        normal = _normal(task, z, filters) if filters else None
        if normal is None:
            break
        if last:
            score = _score(normal, filters)
            break
        C = _inverse(normal.hessian)
        weight = WEIGHTING.held / np.maximum(np.einsum("im,ij,jm->m", held, C, held), np.finfo(float).tiny)
        z = z + _step(task, z, normal._replace(hessian=normal.hessian + held * weight @ held.T))[0]
    return _Point(score, z)


def _score(normal: _Normal, filters: Sequence[Whitening]) -> float:
    """Return the log-likelihood minus the number of coefficients of the error models (AIC)."""
    return normal.log_likelihood - sum(each.model.coefficients.size for each in filters)


def _distance(minimum: _Descended, z: FloatArray, n_theta: int) -> FloatArray:
    """Return the distance of a point's parameters from a minimum, in standard deviations, (n_theta,)."""
    variance = np.diag(_inverse(minimum.normal.hessian))[:n_theta]
    change = np.abs(z - minimum.z)[:n_theta]
    return np.where(change > 0, change / np.sqrt(np.maximum(variance, np.finfo(float).tiny)), 0.0)


def _descend(task: WeightedProblem, z: FloatArray) -> _Descended:
    """Search a minimum from a point by Gauss-Newton steps and error models in turn."""
    orders: list[int] | None = None
    iterations = 0
    C, status, rest = np.zeros((len(z), len(z))), FitStatus.ITERATION_LIMIT, np.inf
    filters, normal = tuple[Whitening, ...](), None
    for turn in range(WEIGHTING.rounds):
        at = task.estimate(z)
        if grows(at):
            return _Descended(z, filters, _nowhere(len(z)), FitStatus.GROWS, iterations, np.inf)
        filters = task.filters(at, C, orders)
        orders = [each.model.order for each in filters] if turn >= WEIGHTING.free_orders else None
        before, normal = z, _normal(task, z, filters)
        if normal is None:
            return _Descended(z, filters, _nowhere(len(z)), FitStatus.GROWS, iterations, np.inf)
        while iterations < task.options.max_iterations:
            step, rest = _step(task, z, normal)
            if rest < WEIGHTING.at_rest:
                break
            lower = _lower(task, z, step, normal, filters)
            if lower is None:
                if rest > WEIGHTING.rest:
                    return _Descended(z, filters, normal, FitStatus.STEPS_TOO_SMALL, iterations, rest)
                break
            (z, normal), iterations = lower, iterations + 1
            if task.options.progress is not None:
                size = float(np.linalg.norm(step)) / max(float(np.linalg.norm(z)), np.finfo(float).tiny)
                task.options.progress(Progress(iterations, normal.cost, 0.0, size, rest))
        else:
            break
        C = _inverse(normal.hessian)
        change = z - before
        if turn and _length(change, normal) < WEIGHTING.settled:
            status = FitStatus.CONVERGED
            break
    assert normal is not None
    return _Descended(z, filters, normal, status, iterations, rest)


def _samples(at: Estimate) -> list[int]:
    """Return the number of samples of each record."""
    firsts = {
        int(first + window): len(segment.outputs)
        for part, first in zip(at.problem.parts, at.problem.first_window[:-1], strict=True)
        for window, segment in zip(part.blocks.segment_first, part.blocks.segments, strict=True)
    }
    return [firsts[int(window)] for window in at.record_window]


def _normal(task: WeightedProblem, z: FloatArray, filters: tuple[Whitening, ...]) -> _Normal | None:
    """Return the normal equations at a point; None where the model grows too much or is not finite."""
    problem = task.shooting
    if problem.valid_values(z[: problem.n_theta]) is None:
        return None
    at, n_theta = task.estimate(z), problem.n_theta
    if grows(at):
        return None
    cost, likelihood, descent, hessian = 0.0, 0.0, np.zeros(at.n_all), np.zeros((at.n_all, at.n_all))
    records = information_over_records(at, np.eye(len(problem.output_weights))).sensitivities
    for each, filter_ in zip(records, filters, strict=True):
        record = whitened(each, filter_)
        if not (np.isfinite(record.errors).all() and np.isfinite(record.psi).all()):
            return None
        psi = record.psi.transpose(1, 0, 2).reshape(record.psi.shape[1], -1)
        cost += 0.5 * float((record.errors**2).sum())
        likelihood += log_likelihood(record, filter_)
        descent[record.columns] += psi @ record.errors.T.ravel()
        hessian[np.ix_(record.columns, record.columns)] += psi @ psi.T
    known = problem.known(z[:n_theta])
    descent[:n_theta] -= known.gradient
    hessian[:n_theta, :n_theta] += known.hessian
    fixed = np.concatenate([np.zeros(n_theta, bool), task.known.ravel()])
    descent[fixed], hessian[fixed], hessian[:, fixed] = 0.0, 0.0, 0.0
    return _Normal(cost + known.cost, descent, hessian, likelihood)


def _nowhere(size: int) -> _Normal:
    return _Normal(np.inf, np.zeros(size), np.zeros((size, size)), -np.inf)


def _axes(hessian: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return eigenvalues and eigenvectors of the scaled Hessian, without flat directions, and the scale."""
    unit = np.sqrt(np.maximum(np.diag(hessian), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(hessian / np.outer(unit, unit))
    curved = values > WEIGHTING.flat * values[-1]
    return values[curved], vectors[:, curved], unit


def _inverse(hessian: FloatArray) -> FloatArray:
    values, vectors, unit = _axes(hessian)
    root = vectors / np.sqrt(values) / unit[:, None]
    return np.asarray(root @ root.T)


def _step(task: WeightedProblem, z: FloatArray, normal: _Normal) -> tuple[FloatArray, float]:
    """Return the Gauss-Newton step within the bounds, and its length in standard deviations."""
    values, vectors, unit = _axes(normal.hessian)
    across = vectors.T @ (normal.descent / unit)
    step = vectors @ (across / values) / unit
    lower, upper = task.bounds
    if (z + step < lower).any() or (z + step > upper).any():
        low, high = np.minimum((lower - z) * unit, 0.0), np.maximum((upper - z) * unit, 0.0)
        free = high > low
        rows, target = np.sqrt(values)[:, None] * vectors.T, across / np.sqrt(values)
        step = np.zeros(len(z))
        step[free] = scipy.optimize.lsq_linear(rows[:, free], target, (low[free], high[free]), tol=1e-12).x
        step /= unit
    return step, _length(step, normal)


def _length(step: FloatArray, normal: _Normal) -> float:
    """Return the length of a step in standard deviations."""
    return float(np.sqrt(max(float(step @ normal.hessian @ step), 0.0)))


def _lower(
    task: WeightedProblem, z: FloatArray, step: FloatArray, normal: _Normal, filters: tuple[Whitening, ...]
) -> tuple[FloatArray, _Normal] | None:
    """Return the first lower point along a step that is halved repeatedly; None without such a point."""
    for halving in range(WEIGHTING.halvings):
        point = z + step / 2**halving
        tried = _normal(task, point, filters)
        if tried is not None and tried.cost < normal.cost:
            return point, tried
    return None
