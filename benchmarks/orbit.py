"""Stiffness of small motions about the orbit of the unbalance, in a film that stiffens."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.rig import Unbalance


def about_the_orbit(
    true: Mapping[str, Any], speed_rpm: FloatArray, inverse_square_length: float
) -> dict[str, FloatArray]:
    """Return the true parameters with the stiffness of small motions about the orbit of the unbalance.

    The prefilter subtracts the orbit together with the run-out: both turn with the shaft. About a steady orbit the film
    is stiffer, by the mean of its derivative over a turn.
    """
    unbalance, moved = Unbalance(), {key: np.array(value) for key, value in true.items()}
    for i, speed in enumerate(speed_rpm * (np.pi / 30)):
        K, D = (np.array([[true[f"{a}_{b}{c}"][i] for c in "xy"] for b in "xy"]) for a in "kd")
        force = unbalance.eccentricity * speed**2 * np.array([1.0, -1j])
        orbit = np.linalg.solve(-(speed**2) * np.eye(2) - 1j * speed * D - K, force)
        product = np.real(np.outer(orbit, orbit.conj())) / 2
        stiff = K + inverse_square_length * (K * np.trace(product) + 2 * K @ product)
        for row, b in enumerate("xy"):
            for column, c in enumerate("xy"):
                moved[f"k_{b}{c}"][i] = stiff[row, column]
    return moved
