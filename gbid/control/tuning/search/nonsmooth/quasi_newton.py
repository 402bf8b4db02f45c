"""BFGS with a weak Wolfe line search, which makes progress where a function has no gradient (Lewis, Overton, 2013)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gbid.arrays import BoolArray, FloatArray

Evaluate = Callable[[FloatArray], tuple[float, FloatArray]]
"""From a point to value and gradient; minus infinity where the function is not defined."""
_DECREASE, _CURVATURE = 1e-4, 0.5
"""Constants of the weak Wolfe conditions."""
_TRIALS = 40
"""Largest number of step lengths of a line search."""
_CREEP = 40
"""Number of steps after which a gain below the tolerance ends the ascent."""


@dataclass(frozen=True)
class Ascent:
    """Point that an ascent reached, its value, and the number of evaluations."""

    x: FloatArray
    value: float
    evaluations: int


def ascend(
    evaluate: Evaluate,
    start: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    unit: FloatArray,
    *,
    max_evaluations: int,
    tolerance: float = 1e-9,
    enough: float = np.inf,
) -> Ascent:
    """Return a point from which BFGS climbs no higher.

    The line search asks for the weak Wolfe conditions only. The inverse Hessian then stays positive definite without a
    second derivative, and becomes ill-conditioned across the ridges on which the function has no gradient. So the steps
    follow the ridges (A. S. Lewis, M. L. Overton, "Nonsmooth optimization via quasi-Newton methods", Mathematical
    Programming 141, 2013, algorithms 2.1 and 2.6). Coordinates at a bound towards which the gradient points are held.
    A step ends at the first bound.

    Parameters
    ----------
    evaluate : callable
        From x (d,) to value and gradient of the function to be maximised.
    start : (d,) array
        Start value within the bounds.
    lower, upper : (d,) array
        Bounds.
    unit : (d,) array
        Typical changes of x, in which steps are measured.
    max_evaluations : int
        Largest number of evaluations.
    tolerance : float
        Gain over 40 steps, in units of the value, below which the ascent ends.
    enough : float
        Value at which the ascent ends.

    Returns
    -------
    Ascent
    """
    d = len(start)
    low, high = lower / unit, upper / unit
    u = np.clip(start / unit, low, high)
    value, gradient = evaluate(u * unit)
    count, H, fresh = 1, np.eye(d), True
    milestone, steps = value, 0
    while count < max_evaluations and np.isfinite(value) and value < enough:
        g = gradient * unit
        held = ((u <= low) & (g < 0)) | ((u >= high) & (g > 0))
        direction = _direction(H, g, held)
        slope = float(g @ direction)
        if not slope > 0:
            if fresh:
                break
            H, fresh = np.eye(d), True
            continue
        if fresh:  # the first step is a tenth of a unit at most
            factor = min(1.0, 0.1 / float(np.linalg.norm(direction)))
            direction, slope = factor * direction, factor * slope
        length, to_bound = _to_bound(u, direction, low, high)
        found = _line_search(evaluate, u, value, direction, slope, unit, length, max_evaluations - count)
        count += found.evaluations
        if found.value <= value:
            if fresh:
                break
            H, fresh = np.eye(d), True
            continue
        moved = np.clip(u + found.length * direction, low, high)
        if found.length == length:
            moved = np.where(to_bound, np.where(direction > 0, high, low), moved)
        H = _update(H, moved - u, (gradient - found.gradient) * unit, fresh)
        u, value, gradient, fresh = moved, found.value, found.gradient, False
        steps += 1
        if steps % _CREEP == 0:
            if value - milestone < tolerance * max(1.0, abs(value)):
                break
            milestone = value
    return Ascent(u * unit, value, count)


@dataclass(frozen=True)
class _Found:
    """Best accepted length of a line search, with value and gradient there."""

    length: float
    value: float
    gradient: FloatArray
    evaluations: int


def _line_search(
    evaluate: Evaluate,
    u: FloatArray,
    value: float,
    direction: FloatArray,
    slope: float,
    unit: FloatArray,
    longest: float,
    most: int,
) -> _Found:
    """Return a length that meets the weak Wolfe conditions, by doubling and bisection; the bound ends it, too."""
    low, high, length = 0.0, np.inf, min(1.0, longest)
    best = _Found(0.0, value, np.zeros_like(u), 0)
    count = 0
    for _ in range(min(_TRIALS, max(most, 1))):
        reached, gradient = evaluate((u + length * direction) * unit)
        count += 1
        if not reached >= value + _DECREASE * length * slope:
            high = length
        else:
            best = _Found(length, reached, gradient, count)
            if length >= longest or float((gradient * unit) @ direction) <= _CURVATURE * slope:
                break
            low = length
        length = (low + high) / 2 if np.isfinite(high) else min(2 * length, longest)
        if high - low <= 1e-14 * max(high, 1e-300) and np.isfinite(high):
            break
    return _Found(best.length, best.value, best.gradient, count)


def _direction(H: FloatArray, g: FloatArray, held: BoolArray) -> FloatArray:
    """Return the quasi-Newton direction with some coordinates held."""
    if not held.any():
        return np.asarray(H @ g)
    free = ~held
    direction = np.zeros_like(g)
    direction[free] = H[np.ix_(free, free)] @ g[free]
    return direction


def _to_bound(u: FloatArray, direction: FloatArray, low: FloatArray, high: FloatArray) -> tuple[float, BoolArray]:
    """Return the length of a direction up to the first bound, and the coordinates that then are at it."""
    room = np.where(direction > 0, high - u, np.where(direction < 0, low - u, np.inf))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        lengths = np.where(direction != 0, room / np.where(direction == 0, 1.0, direction), np.inf)
    length = float(lengths.min())
    return length, lengths <= length * (1 + 1e-12)


def _update(H: FloatArray, s: FloatArray, y: FloatArray, fresh: bool) -> FloatArray:
    """Return the BFGS update of the inverse Hessian of minus the function; unchanged without curvature."""
    product = float(s @ y)
    if not product > 1e-300 or not np.isfinite(y).all():
        return H
    if fresh:
        H = np.eye(len(s)) * product / float(y @ y)
    rho = 1.0 / product
    left = np.eye(len(s)) - rho * np.outer(s, y)
    updated = left @ H @ left.T + rho * np.outer(s, s)
    return updated if np.isfinite(updated).all() else H
