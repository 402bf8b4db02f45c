"""Gain explorer of the report: damping, peak of S_o and static amplification over the gains of P controllers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from typing import Any

import numpy as np

from gbid.control.controllers.built_in import PStructure
from gbid.control.controllers.structures import p_controller
from gbid.control.loop.close import close_loop
from gbid.control.loop.norm import largest_singular_values
from gbid.core.arrays import FloatArray, is_real
from gbid.lpv import LPVModel
from gbid.report.page import Templated, packed

GAINS = np.linspace(-0.5, 2.5, 31)
"""Gains of each axis at which the page has the loop [m/m]; it interpolates between them."""
PEAK_SENSITIVITY = 2.6
"""Largest peak of S_o without a warning: the default cap of `gbid.tune`."""
_FREQUENCY_HZ = np.concatenate([[0.0], np.geomspace(10.0, 1000.0, 160)])
_MOST_POINTS = 5
_LARGEST_PEAK = 20.0
_CORNER_HZ = 1000.0


def explorer_part(model: LPVModel, source: str, designs: Sequence[tuple[str, Any, Mapping[str, float]]]) -> Templated:
    """Return the gain explorer as a block of the report.

    Parameters
    ----------
    model : LPVModel
        Model with actuators, of which at most five operating points are shown.
    words : str
        Description of the model.
    designs : sequence of (name, structure, gains)
        Designs. The explorer has the low-pass of the last P controller with a first-order low-pass; the P controllers
        with this low-pass are its buttons.
    """
    buttons: list[tuple[str, float, float, float]] = []
    for name, structure, gains in designs:
        if isinstance(structure, PStructure) and structure.order == 1:
            corner = 1e3 * gains["lowpass_khz"] if structure.tune_corner else structure.lowpass_hz
            buttons.append((name, gains["kappa_x"], gains["kappa_y"], corner))
    corner = buttons[-1][-1] if buttons else _CORNER_HZ
    points = model.operating_points or [[sum(ends) / 2 for ends in model.domain.bounds]]
    spread = np.unique(np.linspace(0, len(points) - 1, _MOST_POINTS).round().astype(int))
    chosen = [points[i] for i in spread]
    grids = [{"label": model.domain.label(*point), **loop_grid(model, point, corner)} for point in chosen]
    shown = [
        ("no feedback", 0.0, 0.0),
        *((name, x, y) for name, x, y, button_corner in buttons if button_corner == corner),
    ]
    data = {"gains": GAINS.tolist(), "points": grids, "designs": shown, "cap": PEAK_SENSITIVITY}
    return Templated("explorer.html.j2", {"words": source, "corner": corner, "data": data})


def loop_grid(model: LPVModel, point: Sequence[float], corner_hz: float) -> dict[str, Any]:
    """Return damping, peak of S_o and static amplification over `GAINS` of x (rows) and y, as packed numbers.

    The matrix of the closed loop is affine in both gains, so that three loops give those of the whole grid. The damping
    factor is that of the oscillatory modes; it is -1 where a real pole grows. Peak and amplification of an unstable
    loop are missing.
    """
    plant = model.plant_at(*point)
    pairs = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
    neither, along_x, along_y = (close_loop(plant, p_controller(*gains, corner_hz)).A for gains in pairs)
    x, y = np.meshgrid(GAINS, GAINS, indexing="ij")
    steps = x[..., None, None] * (along_x - neither) + y[..., None, None] * (along_y - neither)
    poles = np.linalg.eigvals(neither + steps).astype(complex)
    real, stable = is_real(poles), (poles.real < 0).all(axis=-1)
    damping = np.where(real, inf, -poles.real / np.abs(poles)).min(axis=-1)
    damping = np.where((real & (poles.real >= 0)).any(axis=-1), -1.0, damping)
    filtered = p_controller(1.0, 1.0, corner_hz).frequency_response(_FREQUENCY_HZ)
    loop = plant.frequency_response(_FREQUENCY_HZ) @ filtered
    inverse = np.eye(2) - loop * np.stack([x, y], axis=-1)[..., None, None, :]  # of S_o; a gain scales its column
    sensitivity = largest_singular_values(inverse) / np.abs(np.linalg.det(inverse))

    def of_stable(values: FloatArray) -> dict[str, Any]:
        return packed(np.where(stable, np.minimum(values, _LARGEST_PEAK), np.nan).ravel())

    return {
        "damping": packed(damping.ravel()),
        "peak": of_stable(sensitivity.max(axis=-1)),
        "static": of_stable(sensitivity[..., 0]),
    }
