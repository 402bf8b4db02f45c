"""Bounds over frequency: a number, breakpoints, or the gain of a transfer function."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from gbid.arrays import FloatArray, is_finite
from gbid.errors import UsageError
from gbid.structure import LinearModel

BoundLike = float | Sequence[tuple[float, float]] | LinearModel
"""A number, ``(frequency_hz, bound)`` breakpoints, or a model with one input and one output whose gain is the bound."""


@dataclass(frozen=True, eq=False)
class Bound:
    """Bound as a function of frequency.

    Attributes
    ----------
    of_hz : callable
        From frequencies [Hz] to bounds, for arrays of any shape.
    places_hz : (k,) array
        Frequencies at which it has a corner, a step, or a narrow dip [Hz].
    """

    of_hz: Callable[[FloatArray], FloatArray]
    places_hz: FloatArray


def bound_over_frequency(bound: BoundLike, what: str) -> Bound:
    """Return a bound as a function of frequency.

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
        return _gain(bound)
    if isinstance(bound, int | float | np.integer | np.floating):
        value = float(bound)
        if not (is_finite(bound) and value > 0):
            raise UsageError(f"{what} = {bound!r}; give a positive number")
        return Bound(lambda hz: np.full(np.shape(hz), value), np.zeros(0))
    try:
        points = np.array([(float(hz), float(value)) for hz, value in bound])
    except (TypeError, ValueError):
        points = np.zeros((0, 2))
    if len(points) < 2 or not (np.isfinite(points) & (points > 0)).all() or not (np.diff(points[:, 0]) > 0).all():
        raise UsageError(
            f"{what} = {bound!r}; give a positive number, or (frequency_hz, bound) with rising frequencies"
        )
    x, y = np.log(points).T
    return Bound(lambda hz: np.exp(np.interp(np.log(np.maximum(hz, 1e-300)), x, y)), points[:, 0])


def _gain(model: LinearModel) -> Bound:
    """Return the gain of a model; next to its zero at rest and its poles without damping, where it is 0 or infinite."""
    places, poles = _places(model), np.linalg.eigvals(model.A)
    still = np.unique(np.abs(poles.imag[np.abs(poles.real) <= 1e-9 * np.abs(poles)])) / (2 * np.pi)
    scale = float(places[places > 0].min()) if places.any() else 1.0

    def of_hz(hz: FloatArray) -> FloatArray:
        at = np.maximum(np.ravel(hz), 1e-6 * scale)
        for pole in still:
            at = np.where(np.abs(at - pole) <= 1e-9 * pole, pole * (1 + 2e-9), at)
        return np.asarray(np.abs(model.frequency_response(at)[:, 0, 0]).reshape(np.shape(hz)))

    return Bound(of_hz, places)


def _places(model: LinearModel) -> FloatArray:
    """Return the frequencies of the poles and zeros of a model with one input and one output [Hz]."""
    A, B, C, D = model.A, model.B, model.C, model.D
    whole = np.block([[A, B], [C, D]])
    zeros = scipy.linalg.eigvals(whole, np.diag([*np.ones(len(A)), 0.0]))
    found = np.concatenate([np.linalg.eigvals(A), zeros[np.isfinite(zeros)]]) if len(A) else np.zeros(0)
    places = np.unique(np.concatenate([np.abs(found), np.abs(found.imag)])) / (2 * np.pi)
    fastest = np.abs(np.linalg.eigvals(A)).max(initial=0.0) / (2 * np.pi)  # what rounding leaves of 0 and of infinity
    return np.asarray(places[(places > 1e-9 * fastest) & (places < 1e9 * max(fastest, 1e-9))])
