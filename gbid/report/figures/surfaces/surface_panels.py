"""Key parameters over injection pressure and speed, with the estimates on stems (paper, Figs. 11 to 13)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from matplotlib.ticker import MaxNLocator

from gbid.arrays import FloatArray
from gbid.brief import Brief
from gbid.errors import UsageError
from gbid.lpv import LPVFit
from gbid.report.figures.canvas import (
    BLUE,
    RED,
    TWO_COLUMNS,
    ink,
    panels,
    styled,
)
from gbid.report.figures.named import NamedFigure
from gbid.report.figures.save import symbol
from gbid.structure import KEY_PARAMETERS
from gbid.tables.numbers import exponent_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from gbid.lpv import LPVModel

_UNITS = {"k": "N/(kg m)", "d": "N s/(kg m)", "b": "N/(kg m)", "tau": "s"}
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_PAIRS = ("xx", "xy", "yx", "yy")


@dataclass(frozen=True, eq=False)
class Surface(Brief):
    """Key parameter over the operating range, with estimates.

    Attributes
    ----------
    name, unit : str
        Name and unit of the parameter.
    pressure_bar : (n_pressures,) array
        Injection pressures [bar].
    speed_rpm : (n_speeds,) array
        Speeds [rpm].
    values : (n_pressures, n_speeds) array
        Values of the model.
    points : (n_points, 2) array
        Operating points of the estimates: pressure [bar], speed [rpm].
    estimates : (n_points,) array
        Estimates at these points.
    at_points : (n_points,) array
        Values of the model at these points.
    """

    name: str
    unit: str
    pressure_bar: FloatArray
    speed_rpm: FloatArray
    values: FloatArray
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    estimates: FloatArray = field(default_factory=lambda: np.zeros(0))
    at_points: FloatArray = field(default_factory=lambda: np.zeros(0))


def surfaces_data(
    model: LPVModel,
    names: Sequence[str] = ("k_xx", "k_xy", "k_yx", "k_yy"),
    *,
    points: npt.ArrayLike | None = None,
    estimates: Mapping[str, npt.ArrayLike] | None = None,
    n: int = 21,
) -> list[Surface]:
    """Return key parameters over the domain of a model.

    Parameters
    ----------
    model : LPVModel
        LPV model.
    names : sequence of str
        Names of the key parameters.
    points : (n_points, 2) array, optional
        Pressure [bar] and speed [rpm] of the estimates.
    estimates : dict of str to (n_points,) array, optional
        Estimates by name of the parameter.
    n : int
        Number of grid points in each direction.

    Returns
    -------
    list of Surface
        Surface of each parameter.

    Raises
    ------
    UsageError
        When a name is not that of a key parameter, or when the numbers of estimates and points differ.
    """
    pressure, speed = (np.linspace(*ends, n) for ends in (model.domain.pressure_bar, model.domain.speed_rpm))
    grid = model.key_parameters(pressure[:, None], speed[None, :])
    unknown = [name for name in names if name not in grid]
    if unknown:
        raise UsageError(f"no key parameter {unknown[0]!r}; there is {', '.join(grid)}")
    where = np.zeros((0, 2)) if points is None else np.atleast_2d(np.asarray(points, float))
    there = model.key_parameters(where[:, 0], where[:, 1], extrapolate=True) if len(where) else {}
    surfaces = []
    for name in names:
        values = np.broadcast_to(np.asarray(grid[name], float), (n, n))
        found = np.asarray((estimates or {}).get(name, np.zeros(0)), float)
        if len(found) not in (0, len(where)):
            raise UsageError(f"{name}: {len(found)} estimates for {len(where)} points; give one for each")
        marked, at = (where, np.asarray(there[name], float)) if len(found) else (np.zeros((0, 2)), np.zeros(0))
        surfaces.append(Surface(name, _UNITS[name.split("_")[0]], pressure, speed, values, marked, found, at))
    return surfaces


@styled
def plot_surfaces(data: Sequence[Surface], ax: Sequence[Axes] | None = None) -> npt.NDArray[np.object_]:
    """Draw a surface for each parameter, with the estimates on stems.

    Marks of the estimates are filled above the surface and open below it.

    Parameters
    ----------
    data : sequence of Surface
        Surfaces of `surfaces_data`.
    ax : sequence of three-dimensional Axes, optional
        Axes for each surface; a new figure when left out.

    Returns
    -------
    (n_surfaces,) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.

    Raises
    ------
    UsageError
        When the axes are two-dimensional, or when there are too few.
    """
    columns = min(2, len(data))
    rows = -(-len(data) // columns)
    size = (TWO_COLUMNS, 2.9 * rows)
    _figure, axes = (
        panels(ax, rows, columns, size=size, subplot_kw={"projection": "3d"})
        if ax is None
        else panels(ax, len(data), size=size)
    )
    for panel, surface in zip(axes, data, strict=False):
        if not hasattr(panel, "plot_surface"):
            raise UsageError("surfaces need three-dimensional axes; make them with projection='3d'")
        _plot_surface(panel, surface)
    for panel in axes[len(data) :]:
        panel.set_axis_off()
    return np.array(axes[: len(data)], dtype=object)


def _plot_surface(ax: Any, surface: Surface) -> None:
    exponent = exponent_of(float(np.abs(np.concatenate([surface.values.ravel(), surface.estimates])).max()))
    scale = 10.0**-exponent
    pressure, speed = np.meshgrid(surface.pressure_bar, 1e-3 * surface.speed_rpm, indexing="ij")
    look = {"color": BLUE, "alpha": 0.3, "edgecolor": "#33505f", "linewidth": 0.25, "rcount": 11, "ccount": 11}
    ax.plot_surface(pressure, speed, scale * surface.values, **look)
    for (bar, rpm), value, at in zip(surface.points, surface.estimates, surface.at_points, strict=True):
        x, y = [bar, bar], [1e-3 * rpm, 1e-3 * rpm]
        ax.plot(x, y, [scale * at, scale * value], color=RED, linewidth=0.8)
        fill = RED if value >= at else "white"
        ax.plot(
            x[:1], y[:1], [scale * value], "o", markersize=3.2, color=RED, markerfacecolor=fill, markeredgewidth=0.8
        )
    unit = f"10{str(exponent).translate(_SUPERSCRIPTS)} {surface.unit}" if exponent else surface.unit
    ax.set_title(f"{symbol(surface.name)} [{unit}]", color=ink(), y=1.0, pad=0)
    ax.set_xlabel("pressure [bar]", labelpad=-4)
    ax.set_ylabel("speed [1000 rpm]", labelpad=-4)
    ax.tick_params(pad=-2, labelsize=7)
    ax.tick_params(axis="z", pad=2)
    ax.xaxis.set_major_locator(_few())
    ax.yaxis.set_major_locator(_few())
    ax.zaxis.set_major_locator(_few())
    ax.view_init(elev=24, azim=-128)
    ax.set_box_aspect((1.0, 1.0, 0.8), zoom=0.9)


def _few() -> Any:

    return MaxNLocator(5)


def fit_surfaces_data(fit: LPVFit, letter: Literal["k", "d", "b"]) -> list[Surface]:
    """Return stiffness, damping or input gain with the estimates, for `plot_surfaces` (Figs. 11 to 13).

    Parameters
    ----------
    fit : LPVFit
        Fit of an LPV model.
    letter : {"k", "d", "b"}
        First letter of the parameters: stiffness, damping or input gain.

    Returns
    -------
    list of Surface
        Surfaces of the four parameters.
    """
    names = [f"{letter}_{pair}" for pair in _PAIRS]
    estimates = dict(zip(KEY_PARAMETERS, fit.estimates.values.T, strict=True))
    return surfaces_data(fit.model, names, points=fit.estimates.points, estimates=estimates)


def _drawn(letter: Literal["k", "d", "b"], fit: LPVFit) -> npt.NDArray[np.object_]:
    return plot_surfaces(fit_surfaces_data(fit, letter))


FIGURES = (
    NamedFigure("fig11_stiffness", lambda results: results.surface_fit, partial(_drawn, "k")),
    NamedFigure("fig12_damping", lambda results: results.surface_fit, partial(_drawn, "d")),
    NamedFigure("fig13_input_gain", lambda results: results.surface_fit, partial(_drawn, "b")),
)
