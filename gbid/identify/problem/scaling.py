"""Shooting problem of an assembled fit: scales, starts of windows, bounds, priors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import inf
from typing import Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.identify.data import FitData
from gbid.identify.kernel.sweep import Sweep, tied
from gbid.identify.nlp.record_group import Prior
from gbid.identify.nlp.shooting import Criterion, Shooting
from gbid.identify.nonlinear.nonlinear_kernel import NonlinearKernel
from gbid.identify.nonlinear.nonlinear_predictor import NonlinearPredictor
from gbid.identify.nonlinear.window_starts import window_starts
from gbid.identify.problem.assembly import Assembly
from gbid.identify.problem.initial_states import InitialStates


def build_problem(
    assembly: Assembly,
    data: FitData,
    criterion: Criterion,
    output_weights: Sequence[float] | None,
    begin: Mapping[str, float],
    prior: Mapping[str, tuple[float, float]],
    scaling: bool,
) -> tuple[Shooting, FloatArray]:
    """Scale the unknowns, and find window starts for the start values.

    Parameters
    ----------
    assembly : Assembly
    data : FitData
    criterion, output_weights, prior, scaling
        As for `gbid.fit`.
    begin : dict of str to float
        Start values by full name.

    Returns
    -------
    Shooting
    (n_unknowns,) array
        Where to start, scaled: each window's own least-squares start for the start values.
    """
    weights = _checked_weights(output_weights, data)
    if criterion == "det" and output_weights is None:  # outputs count equally at the start, in any units
        variance = np.average([_variances(r.outputs) for r in data.records], axis=0)
        weights = 1 / np.where(variance > 0, variance, 1.0)
    theta = np.array([begin[q.name] for q in assembly.free])
    n = assembly.parts[0].predictor.n_states
    power = sum(float(_variances(r.outputs) @ weights) * r.n_samples for r in data.records)
    ones = np.ones(len(theta))
    known = _prior(assembly, prior)
    scale = float(np.sqrt(power / data.n_samples))
    problem = Shooting(assembly.parts, assembly.links, criterion, weights, scale, ones, np.ones(n), known)
    values = problem.values(theta)
    size = _sizes_of_states(problem, values, np.zeros((problem.n_windows, n)))
    sweeps = problem.sweeps(values, np.zeros((problem.n_windows, n)), np.diag(weights) / power)
    hessian = np.concatenate([s.hessian_start for s in sweeps])
    seen = np.sqrt(hessian.sum(axis=0).diagonal())  # of the outputs' own size, over states at the starts of windows
    alone = np.where(np.isfinite(seen) & (seen > 0), 1 / np.maximum(seen, np.finfo(float).tiny), 1.0)
    state_scale = np.where(np.isfinite(size) & (size > 0), size, alone)
    starts = -_ridge_solve(hessian, np.concatenate([s.gradient_start for s in sweeps]), state_scale)
    if any(isinstance(part.kernel, NonlinearKernel) for part in problem.parts):
        starts, sweeps = _nonlinear_starts(problem, values, np.diag(weights) / power, starts)
        size = _sizes_of_states(problem, values, starts)
        state_scale = np.where(np.isfinite(size) & (size > 0), size, state_scale)
    products = problem.error_products(values, starts)
    curvature = known.information / problem.likelihood_size
    if np.isfinite(products).all():  # the pass above, in units of the errors at these starts
        unit = power / (float(weights @ np.diag(products)) + 1e-13 * power)
        for s, part in zip(sweeps, problem.parts, strict=True):
            curvature[part.index] += unit * np.diag(s.hessian)
    magnitude = np.where(theta != 0, np.abs(theta), 1.0)
    theta_scale = np.where(curvature > 0, 1 / np.sqrt(np.maximum(curvature, 1e-300)), magnitude)
    if not scaling:
        theta_scale, state_scale = ones, np.ones(n)
    problem = replace(problem, theta_scale=theta_scale, state_scale=state_scale, _last={}, _met={})
    return replace(problem, stable_only=problem.growth(values, sweeps) <= 1), problem.pack(theta, starts)


def _sizes_of_states(problem: Shooting, values: list[Any], starts: FloatArray) -> FloatArray:
    """Return the root mean square of each state in a simulation from the starts of windows, in the largest part."""
    firsts = zip(problem.first_window[:-1], problem.first_window[1:], strict=True)
    squares = [
        _mean_squares(part.kernel.predict(v, part.blocks, starts[a:b]).states)
        for v, part, (a, b) in zip(values, problem.parts, firsts, strict=True)
    ]
    return np.asarray(np.sqrt(np.max(squares, axis=0)))


def _mean_squares(states: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("gknl,gknl->n", states, states) / (states.size // states.shape[2]))


def _variances(outputs: FloatArray) -> FloatArray:
    return np.asarray(np.ascontiguousarray(outputs.T).var(axis=1))


def _nonlinear_starts(
    problem: Shooting, values: list[Any], weight: FloatArray, first: FloatArray
) -> tuple[FloatArray, list[Sweep]]:
    """Return the starts of all windows and the passes from there, see `window_starts`."""
    starts, sweeps = [], []
    firsts = zip(problem.first_window[:-1], problem.first_window[1:], strict=True)
    for v, part, (a, b) in zip(values, problem.parts, firsts, strict=True):
        assert isinstance(part.predictor, NonlinearPredictor)
        assert isinstance(part.kernel, NonlinearKernel)
        found = window_starts(part.predictor, part.kernel, v, part.blocks, weight, first[a:b])
        starts.append(found[0])
        sweeps.append(tied(found[1], part.tie))
    return np.concatenate(starts), sweeps


def unknown_bounds(
    problem: Shooting, assembly: Assembly, states: InitialStates | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the scaled bounds of all unknowns; given and spare initial states are fixed."""
    free = np.full((problem.n_windows, problem.n_states), inf)
    lowest, highest = -free, free
    for part, first, last in zip(problem.parts, problem.first_window[:-1], problem.first_window[1:], strict=True):
        spare = part.predictor.spare
        for side in (lowest, highest):
            side[first:last, problem.n_states - spare :] = 0.0
    if states is not None:
        n, fixed = assembly.n_states, ~np.isnan(states.shooting)
        for window, values, held in zip(assembly.record_window, states.shooting, fixed, strict=True):
            for side in (lowest, highest):
                side[window, :n][held] = values[held]
    lower = problem.pack(np.array([q.lower for q in assembly.free]), lowest)
    upper = problem.pack(np.array([q.upper for q in assembly.free]), highest)
    return lower, upper


def window_length(problem: Shooting) -> int:
    """Return the number of samples in a shooting window."""
    blocks = problem.parts[0].blocks
    return blocks.length * blocks.per_window


def _checked_weights(output_weights: Sequence[float] | None, data: FitData) -> FloatArray:
    n_y = len(data.output_names)
    weights = np.ones(n_y) if output_weights is None else np.asarray(output_weights, float)
    if weights.shape != (n_y,) or not (np.isfinite(weights).all() and (weights > 0).all()):
        names = ", ".join(data.output_names)
        raise UsageError(f"output_weights = {output_weights}; give one positive number for each of {names}")
    return weights


def _prior(assembly: Assembly, prior: Mapping[str, tuple[float, float]]) -> Prior:
    """Priors by full or by own names; the latter hold for every group."""
    full = {q.name: i for i, q in enumerate(assembly.free)}
    mean, information = np.zeros(len(full)), np.zeros(len(full))
    for name, (value, std) in prior.items():
        own = [i for long, i in full.items() if name in (long, assembly.own_names.get(long))]
        if not own:
            raise UsageError(f"prior names a parameter that is not estimated: {name}")
        if not (np.isfinite(value) and np.isfinite(std) and std > 0):
            raise UsageError(f"prior of {name} = ({value}, {std}); give a value and a positive standard deviation")
        mean[own], information[own] = value, 1 / std**2
    return Prior(mean, information)


def _ridge_solve(hessian: FloatArray, gradient: FloatArray, scale: FloatArray) -> FloatArray:
    """Solve for each window; a ridge keeps states near zero that the window does not determine."""
    scaled = hessian * np.outer(scale, scale)
    n = len(scale)
    ridge = 1e-6 * np.trace(scaled, axis1=1, axis2=2)[:, None, None] / n + 1e-300
    matrix = scaled + ridge * np.eye(n)
    if not np.isfinite(matrix).all():
        return np.zeros_like(gradient)
    return np.asarray(np.linalg.solve(matrix, (gradient * scale)[:, :, None])[:, :, 0] * scale)
