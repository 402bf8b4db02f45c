"""Smallest damping factor of a loop, continuous or sampled."""

from __future__ import annotations

from math import inf, pi

from gbid.poles import is_real
from gbid.structure import LinearModel


def smallest_damping(model: LinearModel) -> float:
    """Return the smallest damping factor over all modes; -1 where a real pole grows, infinite without modes.

    Parameters
    ----------
    model : LinearModel
        In continuous time, or sampled: then over the modes that last longer than a sample,
        ``|eigenvalue| > 1/e``. What dies out within a sample, most of it the delays' own modes, has a damping factor
        but does not ring.
    """
    poles = model.poles()
    real = poles[is_real(poles)].real
    growing = real >= 0 if model.dt is None else real >= 1
    if growing.any():
        return -1.0
    lasting = inf if model.dt is None else 1 / model.dt
    return min((damping for hz, damping in model.modes() if 2 * pi * hz * damping < lasting), default=inf)
