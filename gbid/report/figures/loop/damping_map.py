"""Damping map: smallest damping factor over pressure and speed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from gbid.arrays import FloatArray
from gbid.report.figures.canvas import (
    BLACK,
    RED,
    panels,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from gbid.lpv import LPVModel
    from gbid.structure import LinearModel


@dataclass(frozen=True, eq=False)
class DampingMap:
    """Smallest damping factor over the operating range.

    Attributes
    ----------
    pressure_bar : (n,) array
    speed_rpm : (m,) array
    damping : (n, m) array
        Negative where the loop is not stable.
    points : (k, 2) array
        Operating points to be marked: pressure [bar], speed [rpm].
    title : str
    """

    pressure_bar: FloatArray
    speed_rpm: FloatArray
    damping: FloatArray
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    title: str = ""


def damping_map_data(
    model: LPVModel,
    controller: LinearModel | Callable[[tuple[float, float]], LinearModel] | None = None,
    *,
    n: int = 21,
    points: npt.ArrayLike | None = None,
    pade_order: int | None = None,
    title: str = "",
) -> DampingMap:
    """Compute the smallest damping factor of the modes over a model's domain.

    Parameters
    ----------
    model : LPVModel
    controller : LinearModel or callable, optional
        From p to r, or a function that gives it at ``(pressure_bar, speed_rpm)``; the open loop when left out.
    n : int
        Points in each direction.
    points : (k, 2) array, optional
        Operating points to be marked; the model's when left out.
    pade_order : int, optional
        Order of the delays' approximation; the model's own when left out.
    title : str

    Returns
    -------
    DampingMap
        Below zero where the loop is not stable.
    """
    from gbid.control import close_loop, smallest_damping

    pressure, speed = (np.linspace(*ends, n) for ends in (model.domain.pressure_bar, model.domain.speed_rpm))
    damping = np.empty((n, n))
    for i, bar in enumerate(map(float, pressure)):
        for j, rpm in enumerate(map(float, speed)):
            plant = model.plant_at(bar, rpm, pade_order=pade_order)
            here = controller((bar, rpm)) if callable(controller) else controller
            damping[i, j] = smallest_damping(plant if here is None else close_loop(plant, here))
    marked = np.array(model.operating_points if points is None else points, float).reshape(-1, 2)
    return DampingMap(pressure, speed, damping, marked, title)


@styled
def plot_damping_map(data: DampingMap, ax: Axes | None = None) -> Figure:
    """Draw lines of equal damping over pressure and speed; what is not stable is hatched.

    Parameters
    ----------
    data : DampingMap
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure, (panel, *_) = panels(ax, size=(4.6, 3.1))
    grid = (data.pressure_bar, 1e-3 * data.speed_rpm, data.damping.T)
    shades = panel.contourf(*grid, levels=12, cmap="viridis")
    lines = panel.contour(*grid, levels=shades.levels, colors="white", linewidths=0.5)
    panel.clabel(lines, list(lines.levels)[1:-1:2], fmt="%.3g", fontsize=7, inline=True)
    if (data.damping < 0).any():
        panel.contourf(*grid, levels=[-np.inf, 0.0], colors="none", hatches=["////"])
        panel.contour(*grid, levels=[0.0], colors=RED, linewidths=1.4)
    if len(data.points):
        look: dict[str, Any] = {
            "color": BLACK,
            "markersize": 4.5,
            "markerfacecolor": "white",
            "markeredgewidth": 0.8,
            "clip_on": False,
        }
        panel.plot(data.points[:, 0], 1e-3 * data.points[:, 1], "o", **look)
    bar = figure.colorbar(shades, ax=panel, pad=0.02)
    bar.set_label("smallest damping factor [-]")
    bar.ax.tick_params(labelsize=8)
    panel.set_xlabel("injection pressure [bar]")
    panel.set_ylabel("speed [1000 rpm]")
    panel.grid(False)
    if data.title:
        panel.set_title(data.title, loc="left", pad=6)
    return figure
