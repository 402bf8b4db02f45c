"""Gradient of the Lagrangian of each part, by the adjoint of its kernel."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.nlp.record_group import GroupGradient
from gbid.identify.nlp.shooting import Shooting


def on_ends(problem: Shooting, lam_gaps: FloatArray) -> FloatArray:
    """Return the multipliers at the window ends, (n_windows, n), in physical units; zero without a next window."""
    ends = np.zeros((problem.n_windows, problem.n_states))
    ends[problem.links[:, 0]] = lam_gaps.reshape(-1, problem.n_states) / problem.state_scale
    return ends


def own_gradients(
    problem: Shooting,
    values: list[Any],
    starts: FloatArray,
    ends: FloatArray,
    weight: FloatArray,
) -> list[GroupGradient]:
    """Return gradients of cost and weighted window ends, by the parameters of each predictor and its window starts.

    Parameters
    ----------
    problem : Shooting
        Problem of the fit.
    values : list
        Predictor of each part at the parameters.
    starts : (n_windows, n) array
        States at the starts of the windows.
    ends : (n_windows, n) array
        Multipliers at the ends of the windows.
    weight : (n_y, n_y) array
        Constant weight of the errors; with it, parts do not depend on each other.

    Returns
    -------
    list of GroupGradient
        Gradients of each part in physical units, without the prior; not finite when the errors overflow.
    """
    windows = [slice(a, b) for a, b in pairwise(problem.first_window)]
    return [
        GroupGradient(*part.kernel.gradient(v, part.blocks, starts[own], ends[own], weight))
        for v, part, own in zip(values, problem.parts, windows, strict=True)
    ]
