"""Results across recordings: histograms of the fit and parameters of the actuators. Paper, Figs. 8 to 10."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from gbid.arrays import BoolArray, FloatArray, IntArray
from gbid.errors import UsageError
from gbid.report.canvas import BLACK, BLUE, GREY, RED, TWO_COLUMNS, legend_above, letter, panels, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False)
class Histogram:
    """How often the fit fell into each bin.

    Attributes
    ----------
    label : str
        What was counted.
    edges : (n_bins + 1,) array
        [%]
    counts : (n_bins,) integer array
    mean, std : float
        [%]; std with one degree of freedom less than values.
    """

    label: str
    edges: FloatArray
    counts: IntArray
    mean: float
    std: float

    @property
    def n(self) -> int:
        """Number of values."""
        return int(self.counts.sum())


def histogram_data(values: Mapping[str, npt.ArrayLike], bins: int = 15) -> list[Histogram]:
    """Count fit percentages, with the same bins for all.

    Parameters
    ----------
    values : dict of str to (n,) array
        Fit [%] by label, as ``{"p_x": ..., "p_y": ...}``.
    bins : int

    Returns
    -------
    list of Histogram

    Raises
    ------
    UsageError
        When there are no finite values.
    """
    arrays = {label: np.asarray(v, float).ravel() for label, v in values.items()}
    finite = {label: v[np.isfinite(v)] for label, v in arrays.items()}
    if not finite or not all(len(v) for v in finite.values()):
        raise UsageError("a histogram needs at least one finite value of each kind; there are none")
    edges = np.histogram_bin_edges(np.concatenate(list(finite.values())), bins)
    return [
        Histogram(label, edges, np.histogram(v, edges)[0], float(v.mean()), float(v.std(ddof=1)) if len(v) > 1 else 0.0)
        for label, v in finite.items()
    ]


@styled
def plot_fit_histogram(data: Sequence[Histogram], ax: Sequence[Axes] | None = None) -> Figure:
    """Draw histograms of the cross-validation fit with mean and standard deviation (Figs. 9, 10).

    Parameters
    ----------
    data : sequence of Histogram
        From `histogram_data`.
    ax : sequence of matplotlib Axes, optional
        One for each; a new figure when left out.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure, axes = panels(ax, 1, len(data), size=(TWO_COLUMNS, 2.4), sharey=True)
    for panel, histogram in zip(axes, data, strict=False):
        panel.stairs(histogram.counts, histogram.edges, fill=True, facecolor="#b9d3e6", edgecolor=BLACK, linewidth=0.8)
        panel.axvline(histogram.mean, color=RED, linestyle=(0, (5, 1.5)))
        decimals = 2 if histogram.std >= 0.01 else 4
        word = f"mean {histogram.mean:.2f} %\nstd {histogram.std:.{decimals}f} %\nn = {histogram.n}"
        left = histogram.mean > histogram.edges.mean()
        place: dict[str, Any] = {"x": 0.03, "ha": "left"} if left else {"x": 0.97, "ha": "right"}
        panel.text(y=0.96, s=word, va="top", fontsize=8, transform=panel.transAxes, **place)
        panel.set_title(histogram.label, loc="right", pad=4)
        panel.set_xlabel("fit [%]")
        panel.xaxis.set_major_locator(MaxNLocator(5))
        panel.ticklabel_format(axis="x", useOffset=False)
        panel.set_ylim(0, 1.35 * max(h.counts.max() for h in data))
    axes[0].set_ylabel("pairs")
    letter(axes)
    return figure


@dataclass(frozen=True, eq=False)
class ActuatorParameters:
    """Parameters of the actuators, one value for each recording.

    Attributes
    ----------
    values : dict of str to (n,) array
        By name: ``kappa_x``, ``p1_x``, ``p2_x``, ``kappa_y``, ... in SI.
    outliers : dict of str to (n,) boolean array
        Which values are; names may be missing.
    nominal : int, optional
        Index of the recording whose model is the nominal one.
    """

    values: Mapping[str, FloatArray]
    outliers: Mapping[str, BoolArray]
    nominal: int | None = None


_ROWS = (("kappa", "\\kappa_{a,%s}", "m/m", 1.0), ("p1", "p_{1,%s}", "rad/s", 1.0), ("p2", "p_{2,%s}", "krad/s", 1e-3))


@styled
def plot_actuator_parameters(data: ActuatorParameters, ax: Sequence[Axes] | None = None) -> Figure:
    """Draw gains and poles of the actuators across recordings, outliers and the nominal model marked (Fig. 8).

    Parameters
    ----------
    data : ActuatorParameters
    ax : sequence of six matplotlib Axes, optional
        Rows: gain, slow pole, fast pole; columns: x, y. A new figure when left out.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure, axes = panels(ax, 3, 2, size=(TWO_COLUMNS, 5.0), sharex=True)
    for i, (name, symbol, unit, scale) in enumerate(_ROWS):
        for j, axis in enumerate("xy"):
            panel, values = axes[2 * i + j], scale * np.asarray(data.values[f"{name}_{axis}"], float)
            number = np.arange(1, len(values) + 1)
            out = np.asarray(data.outliers.get(f"{name}_{axis}", np.zeros(len(values), bool)))
            panel.plot(number[~out], values[~out], "o", color=BLUE, markersize=3, label="estimates")
            panel.plot(number[out], values[out], "x", color=RED, markersize=5, markeredgewidth=1.2, label="outliers")
            if data.nominal is not None:
                k = data.nominal
                panel.axhline(values[k], color=GREY, linewidth=0.9, linestyle=(0, (5, 1.5)), zorder=0)
                ring: dict[str, Any] = {"markersize": 8, "markerfacecolor": "none", "markeredgewidth": 1.1}
                panel.plot(number[k], values[k], "o", color=BLACK, label=f"nominal, no. {k + 1}", **ring)
            panel.set_ylabel(f"${symbol % axis}$ [{unit}]")
            panel.ticklabel_format(axis="y", useOffset=False)
    for panel in axes[4:6]:
        panel.set_xlabel("recording")
    letter(axes)
    figure.align_ylabels(axes)
    legend_above(figure, axes[0])
    return figure
