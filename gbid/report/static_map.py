"""The static map from piezo positions to disc position: paper, Fig. 5."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from gbid.arrays import BoolArray, FloatArray
from gbid.report.canvas import BLACK, BLUE, ONE_COLUMN, RED, TWO_COLUMNS, legend_above, letter, panels, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MICROMETRES = 1e6


@dataclass(frozen=True, eq=False)
class StaticSweep:
    """Positions at rest while one input goes up and down its staircase.

    Attributes
    ----------
    axis : {"x", "y"}
        Of the input.
    u : (n,) array
        Difference of piezo positions [m].
    p : (n, 2) array
        Disc position [m].
    rising : (n,) boolean array
        Whether the step went up.
    gain, offset : (2,) array
        Of the lines ``p = gain u + offset``.
    """

    axis: str
    u: FloatArray
    p: FloatArray
    rising: BoolArray
    gain: FloatArray
    offset: FloatArray


def static_sweep_data(axis: str, u: npt.ArrayLike, p: npt.ArrayLike, rising: npt.ArrayLike) -> StaticSweep:
    """Lay straight lines through positions at rest, by least squares.

    Parameters
    ----------
    axis : {"x", "y"}
    u : (n,) array
        [m]
    p : (n, 2) array
        [m]
    rising : (n,) boolean array

    Returns
    -------
    StaticSweep
    """
    u, p = np.asarray(u, float), np.asarray(p, float)
    (gain, offset), *_ = np.linalg.lstsq(np.column_stack([u, np.ones(len(u))]), p, rcond=None)
    return StaticSweep(axis, u, p, np.asarray(rising, bool), gain, offset)


@styled
def plot_static_map(data: Sequence[StaticSweep], ax: Sequence[Axes] | None = None, title: str = "") -> Figure:
    """Draw the positions at rest over the inputs, with straight lines through them.

    Parameters
    ----------
    data : sequence of StaticSweep
        One for each input; from `static_sweep_data`.
    ax : sequence of matplotlib Axes, optional
        Outputs down, inputs across; a new figure when left out.
    title : str
        Operating point.

    Returns
    -------
    matplotlib.figure.Figure
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
            panel.plot(_MICROMETRES * ends, _MICROMETRES * line, color=BLACK, linewidth=0.9, label="straight line")
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
    return figure
