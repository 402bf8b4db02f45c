"""Bounds over frequency: a number, breakpoints, or the gain of a transfer function."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gbid.arrays import FloatArray, is_finite
from gbid.errors import UsageError
from gbid.structure import LinearModel

BoundLike = float | Sequence[tuple[float, float]] | LinearModel
"""A number, ``(frequency_hz, bound)`` breakpoints, or a model with one input and one output whose gain is the bound."""


def bound_over_frequency(bound: BoundLike, what: str) -> Callable[[FloatArray], FloatArray]:
    """Return a bound as a function of frequency [Hz], for arrays of any shape.

    Parameters
    ----------
    bound : float, sequence of (frequency_hz, bound), or LinearModel
        Between breakpoints the bound is straight in logarithmic axes; outside it is constant.
    what : str
        Name for messages.

    Raises
    ------
    UsageError
        When numbers are not positive, when breakpoints do not rise in frequency, or when a model has more than one
        input or output.
    """
    if isinstance(bound, LinearModel):
        if bound.D.shape != (1, 1):
            raise UsageError(f"{what}: model {bound.name!r} as a bound has {bound.D.shape} channels; give one by one")
        model = bound
        return lambda hz: np.abs(model.frequency_response(np.ravel(hz))[:, 0, 0]).reshape(np.shape(hz))
    if isinstance(bound, int | float | np.integer | np.floating):
        value = float(bound)
        if not (is_finite(bound) and value > 0):
            raise UsageError(f"{what} = {bound!r}; give a positive number")
        return lambda hz: np.full(np.shape(hz), value)
    try:
        points = np.array([(float(hz), float(value)) for hz, value in bound])
    except (TypeError, ValueError):
        points = np.zeros((0, 2))
    if len(points) < 2 or not (np.isfinite(points) & (points > 0)).all() or not (np.diff(points[:, 0]) > 0).all():
        raise UsageError(
            f"{what} = {bound!r}; give a positive number, or (frequency_hz, bound) with rising frequencies"
        )
    x, y = np.log(points).T
    return lambda hz: np.exp(np.interp(np.log(np.maximum(hz, 1e-12)), x, y))
