"""Static map from piezo positions to disc position (paper, Fig. 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from gbid.arrays import BoolArray, FloatArray
from gbid.brief import Brief
from gbid.characterise import StaticMap
from gbid.operating_point import point_label
from gbid.report.figures.canvas import (
    BLUE,
    ONE_COLUMN,
    RED,
    TWO_COLUMNS,
    ink,
    legend_above,
    letter,
    panels,
    styled,
)
from gbid.report.figures.named import NamedFigure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MICROMETRES = 1e6


@dataclass(frozen=True, eq=False)
class StaticSweep(Brief):
    """Positions at rest along a rising and falling staircase of one input.

    Attributes
    ----------
    axis : {"x", "y"}
        Axis of the input.
    u : (n,) array
        Difference of piezo positions [m].
    p : (n, 2) array
        Disc position [m].
    rising : (n,) boolean array
        Mask of the rising steps.
    gain, offset : (2,) array
        Gain [m/m] and offset [m] of the lines ``p = gain u + offset``.
    """

    axis: str
    u: FloatArray
    p: FloatArray
    rising: BoolArray
    gain: FloatArray
    offset: FloatArray


@styled
def plot_static_map(
    data: Sequence[StaticSweep], ax: Sequence[Axes] | None = None, *, title: str = ""
) -> npt.NDArray[np.object_]:
    """Draw the positions at rest over the inputs, with fitted straight lines.

    Parameters
    ----------
    data : sequence of StaticSweep
        Sweep of each input, from `static_map_data`.
    ax : sequence of matplotlib Axes, optional
        Axes with a row for each output and a column for each input; a new figure when left out.
    title : str
        Title of the figure, as the operating point.

    Returns
    -------
    (2, n_inputs) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.
    """
    columns = len(data)
    width = TWO_COLUMNS if columns > 1 else ONE_COLUMN
    figure, axes = panels(ax, 2, columns, size=(width, 4.4), sharex="col", sharey="row")
    for j, sweep in enumerate(data):
        ends = np.array([sweep.u.min(), sweep.u.max()])
        for i, output in enumerate("xy"):
            panel = axes[columns * i + j]
            rms = float(np.sqrt(np.mean((sweep.p[:, i] - sweep.gain[i] * sweep.u - sweep.offset[i]) ** 2)))
            line = sweep.gain[i] * ends + sweep.offset[i]
            panel.plot(_MICROMETRES * ends, _MICROMETRES * line, color=ink(), linewidth=0.9, label="straight line")
            for there, marker, color, label in (
                (sweep.rising, "^", BLUE, "rising"),
                (~sweep.rising, "v", RED, "falling"),
            ):
                points: dict[str, Any] = {
                    "color": color,
                    "markersize": 4,
                    "markerfacecolor": "none",
                    "linestyle": "none",
                }
                u, p = _MICROMETRES * sweep.u[there], _MICROMETRES * sweep.p[there, i]
                panel.plot(u, p, marker=marker, label=label, **points)
            text = f"$g_{{{output}{sweep.axis}}}$ = {sweep.gain[i]:z.3f} m/m, rms {_MICROMETRES * rms:.2g} µm"
            panel.set_title(text, loc="right", pad=4, fontsize=8)
            if j == 0:
                panel.set_ylabel(f"$p_{output}$ [µm]")
        axes[columns + j].set_xlabel(f"$u_{sweep.axis}$ [µm]")
    letter(axes)
    figure.align_ylabels(axes)
    legend_above(figure, axes[0], title=title)
    return np.array(axes[: 2 * columns], dtype=object).reshape(2, columns)


def static_map_data(result: StaticMap) -> list[StaticSweep]:
    """Return the sweeps of a static map for `plot_static_map` (Fig. 5).

    Parameters
    ----------
    result : StaticMap
        Static map with two outputs. Its positions are relative to the equilibrium; the lines have its gains.

    Returns
    -------
    list of StaticSweep
        Sweep of each input that moves.
    """
    sweeps = []
    for j, source in enumerate(result.input_names):
        if not np.isfinite(result.gain[:, j]).all():
            continue
        panels = [result.panel(i, j) for i in range(len(result.output_names))]
        u, p = panels[0]["input"], np.column_stack([panel["output"] for panel in panels])
        rising = panels[0]["direction"] >= 0
        sweeps.append(StaticSweep(source[-1], u, p, rising, result.gain[:, j], np.zeros(len(panels))))
    return sweeps


def static_map_figure(found: StaticMap) -> npt.NDArray[np.object_]:
    """Draw a static map with its operating point (Fig. 5)."""
    known = {"pressure_bar", "speed_rpm"} <= set(found.conditions)
    title = point_label(found.conditions["pressure_bar"], found.conditions["speed_rpm"]) if known else ""
    return plot_static_map(static_map_data(found), title=title)


FIGURES = (NamedFigure("fig05_static_map", lambda results: results.static_map, static_map_figure),)
