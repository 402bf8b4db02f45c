"""Sensitivity of the axes of a loop over the zones of ISO 14839-3."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gbid.control import ISO_LIMITS, Sensitivities, SensitivityZones, sensitivity_zones
from gbid.report.figures.canvas import legend_above, panels, series, styled
from gbid.report.figures.model.frequency_axis import frequency_axis
from gbid.report.figures.save import symbol

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHADES = {"A": 0.0, "B": 0.13, "C": 0.27, "D": 0.45}  # opacity of a grey, on any background


@styled
def plot_iso_zones(loop: Sensitivities | SensitivityZones, ax: Axes | None = None) -> Axes:
    """Draw the sensitivity of each axis of a loop over the zones A to D of ISO 14839-3.

    Parameters
    ----------
    loop : Sensitivities or SensitivityZones
        Result of `gbid.sensitivities` or `gbid.control.sensitivity_zones`.
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.

    Returns
    -------
    matplotlib Axes
        The axes; ``axes.figure`` is the figure.
    """
    data = loop if isinstance(loop, SensitivityZones) else sensitivity_zones(loop)
    figure, (axes, *_) = panels(ax, size=(4.6, 3.2))
    low, high = float(data.frequency_hz[0]), float(data.frequency_hz[-1])
    top = max(6.0, 1.1 * float(np.max(data.magnitude)))
    floor = 0.0
    for zone, limit in ISO_LIMITS.items():
        ceiling = min(limit, top)
        axes.axhspan(floor, ceiling, color="0.5", alpha=_SHADES[zone], linewidth=0, zorder=0)
        axes.text(0.985, 0.5 * (floor + ceiling), zone, transform=axes.get_yaxis_transform(), ha="right", va="center")
        floor = ceiling
    for k, axis in enumerate(data.axes):
        label = f"{symbol(axis)}: peak {data.peak[k]:.2f}, zone {data.zone[k]}"
        axes.semilogx(data.frequency_hz, data.magnitude[:, k], label=label, **series(k, marker=None))
    frequency_axis(axes, low, high)
    axes.set_ylim(0.0, top)
    axes.grid(False)
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel("sensitivity [-]")
    legend_above(figure, axes, columns=2)
    return axes
