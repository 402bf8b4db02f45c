"""Figures of control loops: damping map, root locus, magnitudes, Pareto fronts, price of robustness, cycles."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from gbid.control.assessment import DesignFigures, TunedDesign, assessed_alike
from gbid.control.loop.close import Method, close_loop, sample_controller, sample_plant, smallest_damping
from gbid.control.loop.sampled import exact_plant
from gbid.control.loop.sensitivity import SensitivityData
from gbid.core.arrays import ComplexArray, FloatArray, Point, point_label
from gbid.core.brief import Brief
from gbid.core.errors import DataError, UsageError
from gbid.experiment.stages.cycle import CycleRow
from gbid.lpv import LPVModel
from gbid.lpv.model import SCHEDULING
from gbid.report.canvas import (
    BLACK,
    GREY,
    RED,
    SERIES,
    TWO_COLUMNS,
    channel_pairs,
    ink,
    legend_above,
    letter,
    one_panel,
    panels,
    scheduling_axis,
    series,
    styled,
)
from gbid.structure import LinearModel


@dataclass(frozen=True, eq=False)
class DampingMap(Brief):
    """Smallest damping factor of the modes over the operating range.

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
    variables : (str, str)
        Names of the two scheduling variables, where they are not pressure and speed.
    title : str
        Title of the figure.
    """

    pressure_bar: FloatArray
    speed_rpm: FloatArray
    damping: FloatArray
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    title: str = ""
    variables: tuple[str, ...] = SCHEDULING


def damping_map_data(
    model: LPVModel,
    controller: LinearModel | Callable[[Point], LinearModel] | None = None,
    *,
    n: int = 21,
    points: npt.ArrayLike | None = None,
    title: str = "",
    sample_time: float | None = None,
    method: Method = "tustin",
) -> DampingMap:
    """Return the smallest damping factor of the modes over the domain of a model.

    Parameters
    ----------
    model : LPVModel
        LPV model.
    controller : LinearModel or callable, optional
        Controller from p to r, or a function from the operating point to it; open loop when left out.
    n : int
        Number of points in each direction.
    points : (k, 2) array, optional
        Operating points with a mark; those of the model when left out.
    title : str
        Title of the figure.
    sample_time : float, optional
        Sample time of the controller [s]: the damping is that of the sampled loop with exact delays and one sample for
        computation (`gbid.control.sampled_loop`). Without it, it is that of the continuous loop.
    method : {"tustin", "zoh"}
        Discretisation of the controller.

    Returns
    -------
    DampingMap
        Smallest damping factors; negative for an unstable loop.
    """
    if len(model.scheduling) != 2:
        raise UsageError(f"a damping map is over two scheduling variables; {model.name!r} has {len(model.scheduling)}")
    pressure, speed = (np.linspace(*ends, n) for ends in model.domain.bounds)
    damping = np.empty((n, n))
    for i, bar in enumerate(map(float, pressure)):
        for j, rpm in enumerate(map(float, speed)):
            law = controller((bar, rpm)) if callable(controller) else controller
            if law is None or sample_time is None:
                plant = model.plant_at(bar, rpm)
            else:
                plant = sample_plant(exact_plant(model, bar, rpm), sample_time, sample_time)
                law = sample_controller(law, sample_time, method)
            damping[i, j] = smallest_damping(plant if law is None else close_loop(plant, law))
    marked = np.array(model.operating_points if points is None else points, float).reshape(-1, 2)
    return DampingMap(pressure, speed, damping, marked, title, model.scheduling)


@styled
def plot_damping_map(data: DampingMap, ax: Axes | None = None) -> Axes:
    """Draw lines of equal damping over two variables; regions of instability are hatched.

    Where the model has one value of a variable, such as one speed, the damping is a curve over the other.

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
    figure, panel = one_panel(ax, (4.6, 3.1))
    at_one = [float(np.ptp(ends)) == 0.0 for ends in (data.pressure_bar, data.speed_rpm)]
    if any(at_one):
        _damping_curve(panel, data, over_speed=not at_one[1])
        return panel
    (x, across), (y, up) = map(scheduling_axis, data.variables)
    grid = (x * data.pressure_bar, y * data.speed_rpm, data.damping.T)
    shades = panel.contourf(*grid, levels=12, cmap="viridis")
    lines = panel.contour(*grid, levels=shades.levels, colors="white", linewidths=0.5)
    panel.clabel(lines, list(lines.levels)[1:-1:2], fmt="%.3g", fontsize=7, inline=True)
    if (data.damping < 0).any():
        panel.contourf(*grid, levels=[-np.inf, 0.0], colors="none", hatches=["////"])
        panel.contour(*grid, levels=[0.0], colors=RED, linewidths=1.4)
    if len(data.points):
        look: dict[str, Any] = {"color": BLACK, "markersize": 4.5, "markerfacecolor": "white", "markeredgewidth": 0.8}
        panel.plot(x * data.points[:, 0], y * data.points[:, 1], "o", clip_on=False, **look)
    bar = figure.colorbar(shades, ax=panel, pad=0.02)
    bar.set_label("smallest damping factor [-]")
    bar.ax.tick_params(labelsize=8)
    panel.set(xlabel=across, ylabel=up)
    panel.grid(False)
    panel.set_title(data.title, loc="left", pad=6)
    return panel


def _damping_curve(panel: Axes, data: DampingMap, *, over_speed: bool) -> None:
    """Draw the smallest damping factor over speed or pressure, with marks at the operating points."""
    factor, label = scheduling_axis(data.variables[over_speed])
    where = factor * (data.speed_rpm if over_speed else data.pressure_bar)
    damping = data.damping[0] if over_speed else data.damping[:, 0]
    panel.plot(where, damping, **series(0, marker=None))
    if len(data.points):
        marked = factor * data.points[:, int(over_speed)]
        panel.plot(marked, np.interp(marked, where, damping), **series(0, linestyle="none", markerfacecolor="none"))
    if damping.min() < 0:
        panel.axhline(0.0, color=RED, linewidth=1.0)
    constant = int(not over_speed)
    fixed = point_label((data.pressure_bar, data.speed_rpm)[constant][0], variables=data.variables[constant:][:1])
    panel.set(xlabel=label, ylabel="smallest damping factor [-]")
    panel.set_title(", ".join(filter(None, (data.title, fixed))), loc="left", pad=6)


@dataclass(frozen=True, eq=False)
class RootLocus(Brief):
    """Poles of a closed loop for a factor on the controller gain.

    Attributes
    ----------
    factor : (n,) array
        Factors.
    poles : (n, n_poles) complex array
        Poles for each factor [rad/s].
    title : str
        Title of the figure.
    """

    factor: FloatArray
    poles: ComplexArray
    title: str = ""


def root_locus_data(
    plant: LinearModel,
    controller: Callable[[float], LinearModel],
    factor: npt.ArrayLike,
    *,
    title: str = "",
) -> RootLocus:
    """Return the poles of a closed loop over a factor on the controller.

    Parameters
    ----------
    plant : LinearModel
        Plant.
    controller : callable
        Function from the factor to the controller, as ``lambda f: p_controller(f * 1.125, f * 0.99)``.
    factor : (n,) array
        Factors.
    title : str
        Title of the figure.

    Returns
    -------
    RootLocus
        Poles for each factor.
    """
    factors = np.atleast_1d(np.asarray(factor, float))
    poles = np.array([close_loop(plant, controller(float(f))).poles() for f in factors])
    return RootLocus(factors, poles, title)


@styled
def plot_root_locus(data: RootLocus, ax: Axes | None = None, *, largest_hz: float = 160.0) -> Axes:
    """Draw the path of the poles in the upper half plane, from circles to squares.

    Parameters
    ----------
    data : RootLocus
        Data of `root_locus_data`.
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.
    largest_hz : float
        Largest distance from zero of the poles shown [Hz].

    Returns
    -------
    matplotlib Axes
        The axes; ``axes.figure`` is the figure.
    """
    figure, panel = one_panel(ax, (5.2, 3.6))
    poles = np.asarray(data.poles / (2 * np.pi), np.complex128)
    shown = (np.abs(poles) <= largest_hz) & (poles.imag >= -1e-9)
    factor = np.broadcast_to(data.factor[:, None], poles.shape)
    cloud = panel.scatter(poles.real[shown], poles.imag[shown], s=5, c=factor[shown], cmap="viridis", linewidths=0)
    for row, marker in ((0, "o"), (-1, "s")):
        at, near = poles[row], shown[row]
        look: dict[str, Any] = {"color": ink(), "markersize": 5, "markerfacecolor": "none"}
        panel.plot(at.real[near], at.imag[near], marker, label=f"{data.factor[row]:g}", **look)
    bar = figure.colorbar(cloud, ax=panel, pad=0.02)
    bar.set_label("factor on the gains [-]")
    _finish_plane(panel, largest_hz)
    panel.legend(loc="lower left", title="factor", title_fontsize=8)
    panel.set_title(data.title, loc="left", pad=6)
    return panel


def _finish_plane(ax: Any, largest_hz: float) -> None:
    """Add lines of equal damping, labels with units, and the limit of stability to a pole plot."""
    ax.axvline(0.0, color=ink(), linewidth=0.9)
    left, right = ax.get_xlim()
    left = min(left, -0.05 * largest_hz)
    right = max(right, 0.02 * largest_hz)
    top = min(1.05 * largest_hz, 1.15 * ax.get_ylim()[1])
    written = 0.0
    for zeta in (0.7, 0.4, 0.2, 0.1, 0.05, 0.02):
        slope = np.sqrt(1 - zeta**2) / zeta
        reach = min(-left, top / slope)
        ax.plot([0, -reach], [0, reach * slope], color=GREY, linewidth=0.6, linestyle=(0, (4, 3)), zorder=0)
        at_edge = reach < top / slope
        if at_edge or not written or written - reach > 0.07 * (right - left):  # otherwise the numbers overlap
            word = {"fontsize": 7, "color": "#666666", "textcoords": "offset points", "xytext": (3, -3)}
            ax.annotate(f"{zeta:g}", (-reach, reach * slope), ha="left", va="top", **word)  # within the panel
            written = written if at_edge else reach
    ax.set(xlim=(left, right), ylim=(-0.02 * top, top))
    ax.set(xlabel="real part / 2π [Hz]; dashed: equal damping factor", ylabel="imaginary part / 2π [Hz]")


_RANGE_DB = 90.0


@styled
def plot_magnitudes(
    data: SensitivityData,
    ax: npt.ArrayLike | None = None,
    *,
    curves: Literal["sensitivity", "bode"] = "sensitivity",
    title: str = "",
) -> npt.NDArray[np.object_]:
    """Draw magnitudes of a loop over frequency, in decibels relative to 1 m/m.

    Parameters
    ----------
    data : SensitivityData
        Result of `gbid.control.sensitivity_data`.
    ax : array of matplotlib Axes, optional
        Axes with a row for each output and a column for each input; a new figure when left out.
    curves : {"sensitivity", "bode"}
        The sensitivities ``S_o`` and ``K_pl S_o`` (Fig. 20), or the transfer functions ``G`` of the open loop and
        ``S_o G`` of the closed loop (Fig. 21).
    title : str
        Title of the figure, as operating point and controller.

    Returns
    -------
    (n_outputs, n_inputs) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.
    """
    if curves == "sensitivity":
        responses = {"output sensitivity $S_o$": data.output, "controller sensitivity $K_{pl} S_o$": data.control}
        input_names = data.output_names
    else:
        responses = {"open loop $G$": data.open_loop, "closed loop $S_o G$": data.plant}
        input_names = data.input_names
    shape = len(data.output_names), len(input_names)
    figure, flat = panels(ax, *shape, size=(TWO_COLUMNS, 0.7 + 1.9 * shape[0]), sharex=True, sharey=True)
    axes = flat.reshape(shape)
    with np.errstate(divide="ignore"):
        levels = {label: 20 * np.log10(np.abs(response)) for label, response in responses.items()}
    for i, j, panel in channel_pairs(axes, data.output_names, input_names):
        panel.axhline(0.0, color=GREY, linewidth=0.7)
        for k, (label, level) in enumerate(levels.items()):
            shown = np.where(np.isfinite(level[:, i, j]), level[:, i, j], np.nan)
            panel.semilogx(data.frequency_hz, shown, label=label, **series(k, marker=None, linewidth=2.2 - 1.2 * k))
        panel.set_xlim(data.frequency_hz[0], data.frequency_hz[-1])
    for panel in axes[:, 0]:
        panel.set_ylabel("magnitude [dB]")
    for panel in axes[-1]:
        panel.set_xlabel("frequency [Hz]")
    tops = [10 * np.ceil(level.max() / 10) for level in levels.values()]
    axes[0, 0].set_ylim(min(tops) - _RANGE_DB, max(tops) + 3)
    letter(flat)
    legend_above(figure, axes, title=title)
    return axes


def comparable_designs(designs: Mapping[str, TunedDesign]) -> dict[str, TunedDesign]:
    """Return the designs that were assessed like the first one and tuned for the same objective.

    Raises
    ------
    DataError
        When there are no designs.
    """
    if not designs:
        raise DataError("there is no tuned design of the present settings and fits; run `gbid tune` or `gbid run`")
    group = assessed_alike(designs)[0]
    aims = {name: (design.result.objective, design.result.sample_time) for name, design in group.items()}
    return {name: design for name, design in group.items() if aims[name] == aims[next(iter(group))]}


def design_performances(designs: Mapping[str, TunedDesign]) -> list[DesignFigures]:
    """Return the performance of comparable designs; the published controller is last.

    Raises
    ------
    DataError
        When there are no designs.
    """
    chosen = list(comparable_designs(designs).values())
    return [*(design.performance[0] for design in chosen if design.performance), *chosen[0].performance[1:]]


@dataclass(frozen=True, eq=False)
class ParetoCurves(Brief):
    """Pareto fronts of robustness and damping, and single designs.

    Attributes
    ----------
    fronts : dict of str to sequence of (peak, damping)
        Peaks of S_o and smallest damping factors of the designs, by structure of the controller.
    designs : dict of str to (peak, damping)
        Single designs with a mark, as the paper's gains.
    title : str
        Title of the figure.
    """

    fronts: Mapping[str, Sequence[tuple[float, float]]]
    designs: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    title: str = ""


def designs_pareto_data(designs: Mapping[str, TunedDesign]) -> ParetoCurves:
    """Return the fronts of comparable designs, with the published designs, for `plot_pareto`.

    Parameters
    ----------
    designs : dict of str to TunedDesign
        Designs by name; each has its designs for other limits of the peak sensitivity.

    Returns
    -------
    ParetoCurves
        Fronts by structure; designs that violate a limit are left out.

    Raises
    ------
    DataError
        When there are no designs.
    """
    chosen = comparable_designs(designs)
    fronts: dict[str, list[tuple[float, float]]] = {}
    for name, design in chosen.items():
        results = [design.result, *(result for _, result in design.front)]
        label = design.performance[0].structure if design.performance else name
        label = name if label in fronts else label
        pairs = [(q.peak_sensitivity, q.value) for q in results if q.success and q.peak_sensitivity is not None]
        fronts[label] = sorted(pairs)
    first, marked = next(iter(chosen.values())), {}
    runs = first.result.sample_time is not None
    figures = ("sampled_peak_output", "sampled_damping") if runs else ("peak_output", "damping")
    for performance in design_performances(designs)[len(chosen) :]:
        peak, damping = (performance.worst[figure][0] for figure in figures)
        if np.isfinite([peak, damping]).all():
            marked[performance.name] = (peak, damping)
    title = f"{first.plant}, worst of {len(first.result.points)} operating points"
    if first.result.sample_time is not None:
        title += f", sampled at {1e3 * first.result.sample_time:g} ms"
    return ParetoCurves(fronts, marked, title)


@styled
def plot_pareto(data: ParetoCurves, ax: Axes | None = None) -> Axes:
    """Draw the smallest damping factor over the peak of the output sensitivity.

    Parameters
    ----------
    data : ParetoCurves
        Data of the figure.
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.

    Returns
    -------
    matplotlib Axes
        The axes; ``axes.figure`` is the figure.
    """
    many = len(data.fronts) > len(SERIES)  # too many lines for a legend among them
    _figure, panel = one_panel(ax, (5.9 if many else 4.6, 3.1))
    for k, (label, front) in enumerate(data.fronts.items()):
        pairs = np.array(sorted(front), float).reshape(-1, 2)
        again = k % (2 * len(SERIES)) >= len(SERIES)  # with the same colours
        look = series(k, markersize=3.5, markerfacecolor="white" if again else None)
        panel.plot(*pairs.T, label=label, **look)
    for k, (label, (peak_so, damping)) in enumerate(data.designs.items()):
        mark: dict[str, Any] = {"color": ink(), "markersize": 9, "markerfacecolor": "none", "markeredgewidth": 1.3}
        panel.plot(peak_so, damping, "*sPX"[k % 4], label=label, **mark)
    panel.set(xlabel="peak of the output sensitivity $S_o$ [-]", ylabel="smallest damping factor [-]")
    panel.set_ylim(bottom=0.0)
    panel.legend(**({"loc": "center left", "bbox_to_anchor": (1.02, 0.5)} if many else {"loc": "best"}))
    panel.set_title(data.title, loc="left", pad=4)
    return panel


@styled
def plot_robustness_price(designs: Mapping[str, TunedDesign], ax: Axes | None = None) -> Axes:
    """Draw the objective that robust and nominal designs reach with each probability.

    Parameters
    ----------
    designs : dict of str to TunedDesign
        Designs by name; those without promises are left out.
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.

    Returns
    -------
    matplotlib Axes
        The axes; ``axes.figure`` is the figure.

    Raises
    ------
    DataError
        When no design has promises.
    """
    robust = {name: design for name, design in designs.items() if design.promises}
    if not robust:
        raise DataError("no design is robust; write robust: {probability: 0.95, price: [0.5, 0.8]} in its section")
    _, panel = one_panel(ax, (4.6, 3.1))
    for k, (name, design) in enumerate(robust.items()):
        look = series(k)
        at = [p.probability for p in design.promises]
        panel.plot(at, [p.promised for p in design.promises], label=name, **look)
        plain = [p.of_nominal for p in design.promises]
        label = f"{name} for the nominal plant (limits kept: {100 * design.promises[0].limits_of_nominal:.0f} %)"
        panel.plot(at, plain, label=label, **{**look, "linestyle": ":", "markerfacecolor": "none"})
    unit = {"damping": "promised damping factor [-]", "decay": "promised decay [1/s]"}
    objectives = {design.result.objective for design in robust.values()}
    panel.set_xlabel("probability [-]")
    panel.set_ylabel(unit.get(objectives.pop(), "promised objective") if len(objectives) == 1 else "promised objective")
    panel.legend(loc="best")
    return panel


_INTERVAL = 1.96  # standard deviations of an interval of 95 %
_APART = 0.06  # of the points of one round, so that their intervals do not cover each other


@styled
def plot_cycle(rows: Sequence[CycleRow], ax: Sequence[Axes] | None = None) -> Axes:
    """Draw the result of each round of a cycle: measured damping of the loop, and certainty of the model.

    Parameters
    ----------
    rows : sequence of CycleRow
        Rounds and operating points.
    ax : sequence of matplotlib Axes, optional
        Two axes to draw into; a new figure when left out.

    Returns
    -------
    matplotlib Axes
        The first axes; ``axes.figure`` is the figure.

    Raises
    ------
    DataError
        When there are no rows.
    """
    if not rows:
        raise DataError("no rounds of a cycle; run `gbid cycle` or `gbid run`")
    damping: Axes
    _, (damping, certainty) = panels(ax, 1, 2, size=(TWO_COLUMNS, 2.9))
    points = list(dict.fromkeys((row.pressure_bar, row.speed_rpm) for row in rows))
    for i, point in enumerate(points):
        rounds = [row for row in rows if (row.pressure_bar, row.speed_rpm) == point]
        at = np.array([row.round for row in rounds])
        look = series(i)
        away = _APART * (i - (len(points) - 1) / 2)
        reached, std = np.array([row.reached for row in rounds]).T
        bars = {**look, "linestyle": "none", "capsize": 2.5, "elinewidth": 0.9}
        damping.errorbar(at + away, reached, _INTERVAL * std, label=point_label(*point), **bars)
        damping.plot(at + away, [row.expected_damping for row in rounds], **series(i, marker=None, linewidth=0.8))
        first = rounds[0]
        for name, mark in (("damping", "full"), ("frequency", "none")):
            stds = [_relative(row, name) / _relative(first, name) for row in rounds]
            certainty.plot(at + away, stds, **{**look, "fillstyle": mark}, label=f"{name}, {point_label(*point)}")
    promised = {row.round: row.promised_damping for row in rows}
    damping.plot(list(promised), list(promised.values()), color=GREY, linewidth=0.8, label="promised by the design")
    damping.set_ylabel("smallest damping factor [-]")
    certainty.set_ylabel("std of the model, round 0 = 1 [-]")
    certainty.set_ylim(bottom=0)
    for panel in (damping, certainty):
        panel.set_xlabel("round")
        panel.set_xticks(sorted(promised))
        panel.legend(loc="best", fontsize="small")
    letter((damping, certainty))
    return damping


def _relative(row: CycleRow, name: str) -> float:
    """Return the root sum of squares of the standard deviations of both modes of the bearing."""
    if name == "damping":
        return float(np.hypot(row.model_damping_1_std, row.model_damping_2_std))
    return float(np.hypot(row.model_frequency_1_hz_std, row.model_frequency_2_hz_std))
