"""Figures of an LPV model: quantities over pressure and surfaces of key parameters (paper, Figs. 11 to 18)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from gbid.core.arrays import FloatArray, point_label
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.tables import exponent_of
from gbid.lpv import LPVFit, LPVModel
from gbid.lpv.model import CHARACTERISTICS, SCHEDULING, characteristics
from gbid.lpv.model_file import SI_UNITS
from gbid.report.canvas import (
    BLUE,
    PRESSURE,
    RED,
    TWO_COLUMNS,
    ink,
    legend_above,
    letter,
    panels,
    scheduling_axis,
    series,
    styled,
    symbol,
)
from gbid.structure import KEY_PARAMETERS
from gbid.structure.built_in import PAIRS

Estimates = Mapping[str, npt.ArrayLike]
Quantity = Literal["delay", "frequency", "damping", "gain"]
_QUANTITIES: Mapping[Quantity, Mapping[str, tuple[str, str]]] = {
    "delay": {f"tau_{axis}": (f"tau_{axis}", f"$\\tau_{axis}$ [samples at {{:g}} kHz]") for axis in "xy"},
    "frequency": {f"frequency_{i}": (f"omega_{i}", f"natural frequency $\\omega_{i}$ [Hz]") for i in (1, 2)},
    "damping": {f"damping_{i}": (f"zeta_{i}", f"damping factor $\\zeta_{i}$ [-]") for i in (1, 2)},
    "gain": {f"g_{pair}": (f"g_{pair}", f"static gain $g_{{{{{pair}}}}}$ [m/m]") for pair in PAIRS},
}
"""Characteristic of an LPV model and label of each panel, by quantity and name."""


@dataclass(frozen=True, eq=False)
class PressurePanel(Brief):
    """Curves of a quantity over injection pressure, with estimates.

    Attributes
    ----------
    name : str
        Key of the quantity, as ``frequency_1``.
    label : str
        Label of the axis, with unit.
    pressure_bar : (n_pressures,) array
        Injection pressures [bar].
    speed_rpm : (n_speeds,) array
        Speeds [rpm].
    values : (n_speeds, n_pressures) array
        Values of the model.
    points : (n_points, 2) array
        Pressure [bar] and speed [rpm] of the estimates.
    estimates : (n_points,) array
        Estimates at these points.
    """

    name: str
    label: str
    pressure_bar: FloatArray
    speed_rpm: FloatArray
    values: FloatArray
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    estimates: FloatArray = field(default_factory=lambda: np.zeros(0))


def over_pressure_data(
    model: LPVModel,
    what: Quantity,
    *,
    speeds_rpm: Sequence[float] | FloatArray = (0.0, 4000.0, 6000.0),
    points: npt.ArrayLike | None = None,
    estimates: Estimates | None = None,
    sample_time: float = 2e-4,
) -> list[PressurePanel]:
    """Return delays, natural frequencies, damping factors or static gains over pressure (Figs. 14 to 18).

    Parameters
    ----------
    model : LPVModel
        LPV model.
    what : {"delay", "frequency", "damping", "gain"}
        Quantity: delays [samples], natural frequencies [Hz] and damping factors of the two modes of the shaft in
        ascending order of frequency, or static gains from u to p [m/m].
    speeds_rpm : sequence of float
        Speeds [rpm].
    points : (n_points, 2) array, optional
        Pressure [bar] and speed [rpm] of the estimates.
    estimates : dict of str to (n_points,) array, optional
        Estimates by name: ``tau_x``, ``tau_y`` [s]; ``frequency_1``, ``frequency_2`` [Hz]; ``damping_1``,
        ``damping_2``; ``g_xx``, ``g_xy``, ``g_yx``, ``g_yy`` [m/m].
    sample_time : float
        Unit of the delays: sample time of the recordings [s].

    Returns
    -------
    list of PressurePanel
        Panel of each delay, mode or gain.

    Raises
    ------
    UsageError
        When the model has fewer than two modes at a point.
    """
    unit = sample_time if what == "delay" else 1.0
    pressure, speeds = np.linspace(*model.domain.pressure_bar, 25), np.asarray(speeds_rpm, float)
    at = [np.ravel(values) for values in np.meshgrid(pressure, speeds)]
    keys = model.key_parameters(*at)
    curves = dict(
        zip(CHARACTERISTICS, characteristics(np.column_stack([keys[k] for k in KEY_PARAMETERS])).T, strict=True)
    )
    panels_of_quantity = []
    for name, (characteristic, label) in _QUANTITIES[what].items():
        values = curves[characteristic] / unit
        if np.isnan(values).any():
            point = point_label(*(column[np.isnan(values)][0] for column in at))
            raise UsageError(f"{model.name} at {point} does not have two modes; two are drawn")
        where, marks = _marked(name, points, estimates)
        shown = values.reshape(len(speeds), -1), where, marks / unit
        panels_of_quantity.append(PressurePanel(name, label.format(1e-3 / unit), pressure, speeds, *shown))
    return panels_of_quantity


@styled
def plot_over_pressure(
    data: Sequence[PressurePanel] | LPVFit, ax: Sequence[Axes] | None = None, *, what: Quantity = "frequency"
) -> npt.NDArray[np.object_]:
    """Draw one curve per speed over the pressure, with the estimates as marks of equal colour.

    Parameters
    ----------
    data : sequence of PressurePanel, or LPVFit
        Panels of `over_pressure_data`, or a fit, which is drawn with its estimates.
    ax : sequence of matplotlib Axes, optional
        Axes for each panel; a new figure when left out.
    what : {"delay", "frequency", "damping", "gain"}
        Quantity of a fit.

    Returns
    -------
    (n_panels,) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.
    """
    data = fit_over_pressure_data(data, what) if isinstance(data, LPVFit) else data
    rows = -(-len(data) // 2)
    figure, axes = panels(ax, rows, min(2, len(data)), size=(TWO_COLUMNS, 0.5 + 2.15 * rows), sharex=True)
    for i, (panel, quantity) in enumerate(zip(axes, data, strict=False)):
        for k, speed in enumerate(quantity.speed_rpm):
            line = series(k, marker=None)
            panel.plot(quantity.pressure_bar, quantity.values[k], label=f"model, {speed:g} rpm", **line)
            at_speed = quantity.points[:, 1] == speed
            if at_speed.any():
                marks = series(k, linestyle="none", markersize=4.5, markerfacecolor="none", markeredgewidth=0.9)
                bars, estimates = quantity.points[at_speed, 0], quantity.estimates[at_speed]
                panel.plot(bars, estimates, label=f"estimates, {speed:g} rpm", **marks)
        panel.set_ylabel(quantity.label)
        if i >= len(data) - 2:
            panel.set_xlabel(PRESSURE)
    if len(data) > 1:
        letter(axes[: len(data)])
    legend_above(figure, axes, columns=max(1, len(data[0].speed_rpm)))
    return axes[: len(data)]


def _marked(name: str, points: npt.ArrayLike | None, estimates: Estimates | None) -> tuple[FloatArray, FloatArray]:
    """Return operating points and estimates of one quantity; both empty without estimates."""
    where = np.zeros((0, 2)) if points is None else np.atleast_2d(np.asarray(points, float))
    values = np.asarray((estimates or {}).get(name, np.zeros(0)), float)
    if len(values) not in (0, len(where)):
        raise UsageError(f"{name}: {len(values)} estimates for {len(where)} points; give one for each")
    return (where if len(values) else np.zeros((0, 2))), values


def fit_over_pressure_data(fit: LPVFit, what: Quantity, *, sample_time: float = 2e-4) -> list[PressurePanel]:
    """Return delays, modes or static gains of surfaces and single fits, for `plot_over_pressure` (Figs. 14 to 18).

    Parameters
    ----------
    fit : LPVFit
        Fit of an LPV model.
    what : {"delay", "frequency", "damping", "gain"}
        Quantity.
    sample_time : float
        Unit of the delays: sample time of the recordings [s].

    Returns
    -------
    list of PressurePanel
        Panels of the quantity.
    """
    values = dict(zip(CHARACTERISTICS, fit.characteristics[0].T, strict=True))
    estimates = {name: values[characteristic] for name, (characteristic, _) in _QUANTITIES[what].items()}
    points, speeds = fit.estimates.points, np.unique(fit.estimates.points[:, 1])
    return over_pressure_data(
        fit.model, what, speeds_rpm=speeds, points=points, estimates=estimates, sample_time=sample_time
    )


_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


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
    variables : (str, str)
        Names of the two scheduling variables, where they are not pressure and speed.
    """

    name: str
    unit: str
    pressure_bar: FloatArray
    speed_rpm: FloatArray
    values: FloatArray
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    estimates: FloatArray = field(default_factory=lambda: np.zeros(0))
    at_points: FloatArray = field(default_factory=lambda: np.zeros(0))
    variables: tuple[str, ...] = SCHEDULING


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
    if len(model.scheduling) != 2:
        raise UsageError(f"surfaces are over two scheduling variables; {model.name!r} has {len(model.scheduling)}")
    pressure, speed = (np.linspace(*ends, n) for ends in model.domain.bounds)
    grid = model.key_parameters(pressure[:, None], speed[None, :])
    unknown = [name for name in names if name not in grid]
    if unknown:
        raise UsageError(f"no key parameter {unknown[0]!r}; choose from {', '.join(grid)}")
    surfaces = []
    for name in names:
        values = np.broadcast_to(np.asarray(grid[name], float), (n, n))
        where, measured = _marked(name, points, estimates)
        at = np.asarray(model.key_parameters(*where.T, extrapolate=True)[name], float) if len(measured) else np.zeros(0)
        unit = SI_UNITS[name.split("_")[0]]
        surfaces.append(Surface(name, unit, pressure, speed, values, where, measured, at, model.scheduling))
    return surfaces


@styled
def plot_surfaces(
    data: Sequence[Surface] | LPVFit, ax: Sequence[Axes] | None = None, *, letter: Literal["k", "d", "b"] = "k"
) -> npt.NDArray[np.object_]:
    """Draw a surface for each parameter, with the estimates as stems.

    Marks of the estimates are filled above the surface and open below it. Where the model has one speed or one
    pressure, each parameter is a curve over the other.

    Parameters
    ----------
    data : sequence of Surface, or LPVFit
        Surfaces of `surfaces_data`, or a fit, which is drawn with its estimates.
    ax : sequence of three-dimensional Axes, optional
        Axes for each surface; a new figure when left out.
    letter : {"k", "d", "b"}
        Parameters of a fit: stiffness, damping or input gain.

    Returns
    -------
    (n_surfaces,) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.

    Raises
    ------
    UsageError
        When the axes are two-dimensional, or when there are too few.
    """
    data = fit_surfaces_data(data, letter) if isinstance(data, LPVFit) else data
    columns = max(1, min(2, len(data)))
    rows = -(-len(data) // columns)
    size = (TWO_COLUMNS, 2.9 * rows)
    is_curve = any(np.ptp(surface.speed_rpm) == 0 or np.ptp(surface.pressure_bar) == 0 for surface in data)
    if is_curve:
        size = (TWO_COLUMNS, 0.5 + 2.15 * rows)
    figure, axes = (
        panels(ax, rows, columns, size=size, subplot_kw={} if is_curve else {"projection": "3d"})
        if ax is None
        else panels(ax, len(data), size=size)
    )
    for panel, surface in zip(axes, data, strict=False):
        if is_curve:
            _plot_curve(panel, surface)
            continue
        if not hasattr(panel, "plot_surface"):
            raise UsageError("surfaces need three-dimensional axes; make them with projection='3d'")
        _plot_surface(panel, surface)
    if ax is None and not is_curve and any(len(surface.points) for surface in data):
        figure.supxlabel("estimates: \N{BLACK CIRCLE} above the surface, \N{WHITE CIRCLE} below", fontsize=9)
    for panel in axes[len(data) :]:
        panel.set_axis_off()
    return axes[: len(data)]


def _scaled(surface: Surface) -> tuple[float, str]:
    """Return factor and label of a surface, with the unit times a power of ten."""
    exponent = exponent_of(float(np.abs(np.concatenate([surface.values.ravel(), surface.estimates])).max()))
    unit = f"10{str(exponent).translate(_SUPERSCRIPTS)} {surface.unit}" if exponent else surface.unit
    return 10.0**-exponent, f"{symbol(surface.name)} [{unit}]"


def _plot_curve(ax: Any, surface: Surface) -> None:
    """Draw a parameter over pressure; over speed if there is only one pressure."""
    scale, label = _scaled(surface)
    over_speed = bool(np.ptp(surface.pressure_bar) == 0)
    factor, across = scheduling_axis(surface.variables[over_speed])
    where = factor * (surface.speed_rpm if over_speed else surface.pressure_bar)
    ax.plot(where, scale * (surface.values[0] if over_speed else surface.values[:, 0]), color=BLUE, linewidth=1.2)
    ax.plot(factor * surface.points[:, int(over_speed)], scale * surface.estimates, "o", color=RED, markersize=3.2)
    ax.set(xlabel=across, ylabel=label)


def _plot_surface(ax: Any, surface: Surface) -> None:
    scale, label = _scaled(surface)
    (first, across), (second, along) = map(scheduling_axis, surface.variables)
    pressure, speed = np.meshgrid(first * surface.pressure_bar, second * surface.speed_rpm, indexing="ij")
    look = {"color": BLUE, "alpha": 0.3, "edgecolor": "#33505f", "linewidth": 0.25, "rcount": 11, "ccount": 11}
    ax.plot_surface(pressure, speed, scale * surface.values, **look)
    for (bar, rpm), value, at in zip(surface.points, surface.estimates, surface.at_points, strict=True):
        x, y = [first * bar] * 2, [second * rpm] * 2
        ax.plot(x, y, [scale * at, scale * value], color=RED, linewidth=0.8)
        mark = {"color": RED, "markerfacecolor": RED if value >= at else "white", "markeredgewidth": 0.8}
        ax.plot(x[:1], y[:1], [scale * value], "o", markersize=3.2, **mark)
    ax.set_title(label, color=ink(), y=1.0, pad=0)
    ax.set_xlabel(across.removeprefix("injection "), labelpad=-4)
    ax.set_ylabel(along, labelpad=-4)
    ax.tick_params(pad=-2, labelsize=7)
    ax.tick_params(axis="z", pad=2)
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.set_major_locator(MaxNLocator(5))
    ax.view_init(elev=24, azim=-128)
    ax.set_box_aspect((1.0, 1.0, 0.8), zoom=0.9)


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
    names = [f"{letter}_{pair}" for pair in PAIRS]
    estimates = dict(zip(KEY_PARAMETERS, fit.estimates.values.T, strict=True))
    return surfaces_data(fit.model, names, points=fit.estimates.points, estimates=estimates)
