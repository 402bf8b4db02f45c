"""Generalised least squares of a simulation: an autoregression of the errors filters errors and sensitivities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from gbid.core.arrays import BoolArray, FloatArray, IntArray
from gbid.core.errors import UsageError
from gbid.core.notes import FitNote
from gbid.identify.options import FitArguments
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
from gbid.identify.uncertainty.covariance import Estimate, grows, information_over_records

_AT_REST = 1e-3  # length of a step that is nothing, in standard deviations
_SETTLED = 1e-2  # the same for a round with a new model of the errors
_REST = 0.1  # length up to which a point from which no step leads lower counts as the minimum
_APART = 3.0  # distance of two minima, in standard deviations
_ROUNDS = 30  # models of the errors
_FREE_ORDERS = 5  # rounds in which the order is chosen anew: later it may go back and forth between two
_HALVINGS = 12
_FLAT = 1e-13  # curvature of an undetermined direction, as a part of the largest


class WeightedErrors(NamedTuple):
    """Minimum of generalised least squares.

    Attributes
    ----------
    filters : tuple of Whitening
        Filter of the errors of each record.
    log_likelihood : float
        Gaussian log-likelihood of all errors.
    notes : tuple of str
        Note on another minimum.
    """

    filters: tuple[Whitening, ...]
    log_likelihood: float
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class WeightedProblem:
    """Problem of generalised least squares: a simulation whose segments are one window each.

    Attributes
    ----------
    shooting : Shooting
        The problem.
    box : (n_unknowns,) array, (n_unknowns,) array
        Bounds of its unknowns, scaled.
    record_window : (n_records,) integer array
        First window of each record.
    known : (n_records, n) boolean array
        Initial states that are not estimated.
    options : FitArguments
        Options of the fit.
    """

    shooting: Shooting
    box: tuple[FloatArray, FloatArray]
    record_window: IntArray
    known: BoolArray
    options: FitArguments

    def estimate(self, z: FloatArray, filters: tuple[Whitening, ...] = ()) -> Estimate:
        """Return the point of parameters and, after them, initial states of all records, with all gaps closed."""
        problem, n = self.shooting, self.shooting.n_states
        theta, starts = z[: problem.n_theta], np.zeros((problem.n_windows, n))
        starts[self.record_window] = z[problem.n_theta :].reshape(-1, n)
        values, weight = problem.values(theta), np.eye(len(problem.output_weights))
        for a, b in problem.links.tolist():
            starts[b] = np.concatenate([sweep.end for sweep in problem.sweeps(values, starts, weight)])[a]
        return Estimate(problem, theta, starts, self.record_window, self.known, filters)

    def coordinates(self, unknowns: FloatArray) -> FloatArray:
        """Return parameters and initial states of scaled unknowns."""
        theta, starts = self.shooting.unpack(unknowns)
        return np.concatenate([theta, starts[self.record_window].ravel()])

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Bounds of parameters and initial states."""
        lower, upper = (self.coordinates(edge) for edge in self.box)
        return lower, upper


class _Normal(NamedTuple):
    """Normal equations at a point: cost, minus its gradient, its Gauss-Newton Hessian, and the log-likelihood."""

    cost: float
    descent: FloatArray
    hessian: FloatArray
    log_likelihood: float


class _Descended(NamedTuple):
    """Minimum of a descent: point, filters, normal equations, status, iterations, length of the next step."""

    z: FloatArray
    filters: tuple[Whitening, ...]
    normal: _Normal
    status: FitStatus
    iterations: int
    rest: float


def weighted_solution(
    problem: Shooting,
    first: Solution,
    start: FloatArray,
    box: tuple[FloatArray, FloatArray],
    record_window: IntArray,
    known: BoolArray,
    options: FitArguments,
    names: Sequence[str],
) -> tuple[WeightedErrors, Solution]:
    """Return the minimum of generalised least squares.

    Parameters
    ----------
    problem : Shooting
        Problem of least squares.
    first : Solution
        Its solution.
    start : (n_unknowns,) array
        Start of the fit, scaled.
    box : (n_unknowns,) array, (n_unknowns,) array
        Bounds, scaled.
    record_window : (n_records,) integer array
        First window of each record.
    known : (n_records, n) boolean array
        Initial states that are not estimated.
    options : FitArguments
        Options of the fit.
    names : sequence of str
        Names of the parameters.

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

    Errors with a peak at a lightly damped mode give the likelihood several minima along its frequency. Least squares
    may have gone from the start to a far one, so the descent begins at both. Of the n / 2 frequencies that n samples
    tell apart, the best one gains log(n / 2) of log-likelihood by chance. The minimum that is reached from the start
    counts unless the other one is better by more.
    """
    if any(part.predictor.feeds_back for part in problem.parts):
        raise UsageError("errors = 'ar' is for a simulation: this predictor feeds measured outputs back")
    joined, kept = in_one_window(problem)
    windows = (kept[problem.n_theta :: problem.n_states] - problem.n_theta) // problem.n_states
    task = WeightedProblem(
        joined, (box[0][kept], box[1][kept]), np.searchsorted(windows, record_window), known, options
    )
    origin, begin, notes = task.coordinates(first.unknowns[kept]), task.coordinates(start[kept]), tuple[str, ...]()
    minimum = _descend(task, origin, first.iterations)
    if not minimum.status.success or _distance(minimum, begin, joined.n_theta).max() > _APART:
        other = _descend(task, begin, minimum.iterations)
        minimum, notes = _chosen(minimum, other, names, float(np.log(joined.n_samples / 2)))
    unknowns = joined.pack(*(getattr(task.estimate(minimum.z), name) for name in ("theta", "starts")))
    solution = replace(
        first,
        unknowns=in_windows(problem, joined, unknowns),
        status=minimum.status,
        iterations=minimum.iterations,
        rest=minimum.rest,
    )
    return WeightedErrors(minimum.filters, minimum.normal.log_likelihood, notes), solution


def _chosen(
    minimum: _Descended, other: _Descended, names: Sequence[str], chance: float
) -> tuple[_Descended, tuple[str, ...]]:
    """Return the minimum that counts, of that from least squares and the `other` from the start, and a note."""
    kept = minimum._replace(iterations=other.iterations)
    if not other.status.success:
        return kept, ()
    if not minimum.status.success:
        return other, ()
    gain, apart = minimum.normal.log_likelihood - other.normal.log_likelihood, _distance(other, minimum.z, len(names))
    worst = int(np.argmax(apart))
    if apart[worst] < _APART or abs(gain) > chance:
        return (kept if gain > 0 else other), ()
    text = (
        f"the likelihood has two maxima whose logarithms differ by {abs(gain):.2g}, which chance explains: "
        f"{names[worst]} is {minimum.z[worst]:.6g} at the other one, {apart[worst]:.2g} standard deviations "
        "away; this is the one reached from the start values"
    )
    return other, (FitNote.LIKELY_ELSEWHERE(text),)


def _distance(minimum: _Descended, z: FloatArray, n_theta: int) -> FloatArray:
    """Return how far the parameters of a point are from a minimum, in its standard deviations, (n_theta,)."""
    variance = np.diag(_inverse(minimum.normal.hessian))[:n_theta]
    moved = np.abs(z - minimum.z)[:n_theta]
    return np.where(moved > 0, moved / np.sqrt(np.maximum(variance, np.finfo(float).tiny)), 0.0)


def _descend(task: WeightedProblem, z: FloatArray, iterations: int) -> _Descended:
    """Return the minimum that models of the errors and Gauss-Newton steps reach in turn from a point."""
    orders: list[int] | None = None
    C, status, rest = np.zeros((len(z), len(z))), FitStatus.ITERATION_LIMIT, np.inf
    filters, normal = tuple[Whitening, ...](), None
    for turn in range(_ROUNDS):
        at = task.estimate(z)
        if grows(at):
            return _Descended(z, filters, _nowhere(len(z)), FitStatus.GROWS, iterations, np.inf)
        records = information_over_records(at, np.eye(len(task.shooting.output_weights))).sensitivities
        every = np.arange(at.n_all)
        models = error_models((transformed(record, every) for record in records), C, orders)
        orders = [model.order for model in models] if turn >= _FREE_ORDERS else None
        lengths = [int(n) for n in _samples(at)]
        filters = tuple(whitening(model, n) for model, n in zip(models, lengths, strict=True))
        before, normal = z, _normal(task, z, filters)
        if normal is None:
            return _Descended(z, filters, _nowhere(len(z)), FitStatus.GROWS, iterations, np.inf)
        while iterations < task.options.max_iterations:
            step, rest = _step(task, z, normal)
            if rest < _AT_REST:
                break
            lower = _lower(task, z, step, normal, filters)
            if lower is None:
                if rest > _REST:
                    return _Descended(z, filters, normal, FitStatus.STEPS_TOO_SMALL, iterations, rest)
                break
            (z, normal), iterations = lower, iterations + 1
            if task.options.progress is not None:
                size = float(np.linalg.norm(step)) / max(float(np.linalg.norm(z)), np.finfo(float).tiny)
                task.options.progress(Progress(iterations, normal.cost, 0.0, size, rest))
        else:
            break
        C = _inverse(normal.hessian)
        moved = z - before
        if turn and _length(moved, normal) < _SETTLED:
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
    """Return the normal equations at a point; None where the model grows over a record or has no finite value."""
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
    away, known = z[:n_theta] - problem.prior.mean, problem.prior.information
    descent[:n_theta] -= known * away
    hessian[np.arange(n_theta), np.arange(n_theta)] += known
    fixed = np.concatenate([np.zeros(n_theta, bool), task.known.ravel()])
    descent[fixed], hessian[fixed], hessian[:, fixed] = 0.0, 0.0, 0.0
    return _Normal(cost + 0.5 * float(known @ away**2), descent, hessian, likelihood)


def _nowhere(size: int) -> _Normal:
    return _Normal(np.inf, np.zeros(size), np.zeros((size, size)), -np.inf)


def _axes(hessian: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return eigenvalues and eigenvectors of the Hessian in units of its diagonal, without flat directions."""
    unit = np.sqrt(np.maximum(np.diag(hessian), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(hessian / np.outer(unit, unit))
    curved = values > _FLAT * values[-1]
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
    """Return the first point along a step, halved again and again, that has a lower cost; None without one."""
    for halving in range(_HALVINGS):
        point = z + step / 2**halving
        tried = _normal(task, point, filters)
        if tried is not None and tried.cost < normal.cost:
            return point, tried
    return None
