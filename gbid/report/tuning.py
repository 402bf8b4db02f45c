"""Performance of a controller: the Pareto front of robustness and damping, and damping over the operating range."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from gbid.arrays import FloatArray
from gbid.control.assessment.tuned_design import TunedDesign
from gbid.control.tuning.gain_result import GainResult
from gbid.report.canvas import BLACK, RED, panels, series, styled
from gbid.report.reader.designs import comparable_designs, design_performances

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from gbid.lpv import LPVModel
    from gbid.structure import LinearModel


@dataclass(frozen=True, eq=False)
class ParetoFront:
    """Designs between robustness and damping.

    Attributes
    ----------
    peak_sensitivity : dict of str to (n,) array
        Peak of S_o, by structure of the controller.
    damping : dict of str to (n,) array
        Smallest damping factor of the same designs.
    designs : dict of str to (peak, damping)
        Single designs to be marked, as the paper's gains.
    title : str
    """

    peak_sensitivity: Mapping[str, FloatArray]
    damping: Mapping[str, FloatArray]
    designs: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    title: str = ""


def pareto_data(
    designs: Mapping[str, Sequence[tuple[float, float]]],
    marked: Mapping[str, tuple[float, float]] | None = None,
    title: str = "",
) -> ParetoFront:
    """Sort designs by their peak sensitivity.

    Parameters
    ----------
    designs : dict of str to sequence of (peak_sensitivity, damping)
        By structure of the controller.
    marked : dict of str to (peak_sensitivity, damping), optional
    title : str

    Returns
    -------
    ParetoFront
    """
    sorted_designs = {label: np.array(sorted(pairs), float).reshape(-1, 2) for label, pairs in designs.items()}
    peaks = {label: pairs[:, 0] for label, pairs in sorted_designs.items()}
    damping = {label: pairs[:, 1] for label, pairs in sorted_designs.items()}
    return ParetoFront(peaks, damping, dict(marked or {}), title)


def designs_pareto_data(designs: Mapping[str, TunedDesign]) -> ParetoFront:
    """Give the fronts of comparable designs with the published design on them, for `plot_pareto`.

    Parameters
    ----------
    designs : dict of str to TunedDesign
        By name; each with its designs under other caps.

    Returns
    -------
    ParetoFront
        By structure; designs that keep not all their limits are left out.

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
        fronts[label] = [_place(result) for result in results if result.success and result.peak_sensitivity is not None]
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
    return pareto_data(fronts, marked, title)


def _place(result: GainResult) -> tuple[float, float]:
    assert result.peak_sensitivity is not None
    return result.peak_sensitivity, result.value


@styled
def plot_pareto(data: ParetoFront, ax: Axes | None = None) -> Figure:
    """Draw the smallest damping factor over the peak of the output sensitivity.

    Parameters
    ----------
    data : ParetoFront
    ax : matplotlib Axes, optional
        A new figure when left out.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure, (panel, *_) = panels(ax, size=(4.6, 3.1))
    for k, (label, peak) in enumerate(data.peak_sensitivity.items()):
        order = np.argsort(peak)
        values = np.asarray(data.damping[label], float)[order]
        panel.plot(np.asarray(peak, float)[order], values, label=label, markersize=3.5, **series(k))
    for k, (label, (peak_so, damping)) in enumerate(data.designs.items()):
        look: dict[str, Any] = {"color": BLACK, "markersize": 9, "markerfacecolor": "none", "markeredgewidth": 1.3}
        panel.plot(peak_so, damping, "*sPX"[k % 4], label=label, **look)
    panel.set_xlabel("peak of the output sensitivity $S_o$ [-]")
    panel.set_ylabel("smallest damping factor [-]")
    panel.set_ylim(bottom=0.0)
    panel.legend(loc="best")
    if data.title:
        panel.set_title(data.title, loc="left", pad=4)
    return figure


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
        A new figure when left out.

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
