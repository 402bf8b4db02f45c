"""Responses of the disc to an impact, with the force that caused them: paper, Figs. 22 to 27."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.report.canvas import TWO_COLUMNS, legend_above, letter, panels, series, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MICROMETRES = 1e6


@dataclass(frozen=True, eq=False)
class ImpactCurves:
    """Responses of the disc to impacts.

    Attributes
    ----------
    time : (n,) array
        [s]
    responses : dict of str to (n,) array
        Positions [m] by label, as ``{"open loop": ..., "closed loop": ...}``.
    forces : dict of str to (n,) array
        Impact forces [N] by label; empty without.
    axis : {"x", "y"}
    title : str
        Operating point.
    """

    time: FloatArray
    responses: Mapping[str, FloatArray]
    forces: Mapping[str, FloatArray] = field(default_factory=dict)
    axis: str = "x"
    title: str = ""


@styled
def plot_impact(data: ImpactCurves, ax: Sequence[Axes] | None = None) -> Figure:
    """Draw responses to an impact, and below them the forces.

    Parameters
    ----------
    data : ImpactCurves
    ax : sequence of matplotlib Axes, optional
        One, or two where there are forces; a new figure when left out.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    UsageError
        When a curve has another length than the time.
    """
    for label, curve in (*data.responses.items(), *data.forces.items()):
        if np.shape(curve) != np.shape(data.time):
            raise UsageError(f"curve {label!r} has shape {np.shape(curve)}, the time {np.shape(data.time)}")
    rows = 2 if data.forces else 1
    ratios = {"height_ratios": [2, 1][:rows]}
    size = (TWO_COLUMNS, 1.1 + 1.35 * rows)
    figure, axes = panels(ax, rows, 1, size=size, sharex=True, **ratios)
    labels = list(dict.fromkeys([*data.responses, *data.forces]))
    for curves, panel, scale in ((data.responses, axes[0], _MICROMETRES), (data.forces, axes[rows - 1], 1.0)):
        for label, curve in curves.items():
            style = series(labels.index(label), marker=None, linewidth=1.1)
            panel.plot(1e3 * data.time, scale * curve, label=label, **style)
    axes[0].set_ylabel(f"$p_{data.axis}$ [µm]")
    if data.forces:
        axes[1].set_ylabel("force [N]")
        letter(axes)
    axes[rows - 1].set_xlabel("time [ms]")
    axes[rows - 1].set_xlim(1e3 * data.time[0], 1e3 * data.time[-1])
    figure.align_ylabels(axes)
    legend_above(figure, axes[0], title=data.title)
    return figure
