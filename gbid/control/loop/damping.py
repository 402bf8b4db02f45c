"""Smallest damping factor of a loop, continuous or sampled."""

from __future__ import annotations

from math import inf, pi

from gbid.poles import is_real
from gbid.structure import LinearModel


def smallest_damping(model: LinearModel) -> float:
    """Return the smallest damping factor over all modes; -1 for an unstable real pole, infinite without modes.

    Parameters
    ----------
    model : LinearModel
        Model in continuous time, or sampled. Of a sampled model only modes that last longer than a sample count,
        ``|eigenvalue| > 1/e``. Faster modes, most of them from the delays, have a damping factor but do not oscillate
        visibly.
    """
    poles = model.poles()
    real = poles[is_real(poles)].real
    if (real >= 0).any():
        return -1.0
    lasting = inf if model.dt is None else 1 / model.dt
    return min((damping for hz, damping in model.modes() if 2 * pi * hz * damping < lasting), default=inf)
