"""Damping map: smallest damping factor over pressure and speed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.brief import Brief
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
class DampingMap(Brief):
    """Smallest damping factor over the operating range.

    Attributes
    ----------
    pressure_bar : (n,) array
        Injection pressures [bar].
    speed_rpm : (m,) array
        Speeds [rpm].
    damping : (n, m) array
        Smallest damping factor; negative for an unstable loop.
    points : (k, 2) array
        Operating points with a mark: pressure [bar], speed [rpm].
    title : str
        Title of the figure.
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
    """Return the smallest damping factor of the modes over the domain of a model.

    Parameters
    ----------
    model : LPVModel
        LPV model.
    controller : LinearModel or callable, optional
        Controller from p to r, or a function from ``(pressure_bar, speed_rpm)`` to it; open loop when left out.
    n : int
        Number of points in each direction.
    points : (k, 2) array, optional
        Operating points with a mark; those of the model when left out.
    pade_order : int, optional
        Order of the Padé approximation of the delays; that of the model when left out.
    title : str
        Title of the figure.

    Returns
    -------
    DampingMap
        Smallest damping factors; negative for an unstable loop.
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
def plot_damping_map(data: DampingMap, ax: Axes | None = None) -> Axes:
    """Draw lines of equal damping over pressure and speed; regions of instability are hatched.

    Parameters
    ----------
    data : DampingMap
        Data of the figure.
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.

    Returns
    -------
    matplotlib Axes
        The axes; ``axes.figure`` is the figure.
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
    return panel
