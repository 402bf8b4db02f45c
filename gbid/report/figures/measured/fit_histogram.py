"""Histograms of the cross-validation fit (paper, Figs. 9 and 10)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from matplotlib.ticker import MaxNLocator

from gbid.arrays import FloatArray, IntArray
from gbid.brief import Brief
from gbid.report.figures.canvas import (
    BLACK,
    RED,
    TWO_COLUMNS,
    letter,
    panels,
    styled,
)
from gbid.report.figures.named import NamedFigure
from gbid.report.figures.save import symbol
from gbid.validate import ValidationSummary

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False)
class Histogram(Brief):
    """Histogram of the fit of one output.

    Attributes
    ----------
    label : str
        Title of the panel.
    edges : (n_bins + 1,) array
        Edges of the bins [%].
    counts : (n_bins,) integer array
        Number of values in each bin.
    mean, std : float
        Mean and standard deviation [%]; the latter with n - 1 degrees of freedom.
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


@styled
def plot_fit_histogram(data: Sequence[Histogram], ax: Sequence[Axes] | None = None) -> npt.NDArray[np.object_]:
    """Draw histograms of the cross-validation fit with mean and standard deviation (Figs. 9, 10).

    Parameters
    ----------
    data : sequence of Histogram
        Histograms of `crossval_data`.
    ax : sequence of matplotlib Axes, optional
        Axes for each histogram; a new figure when left out.

    Returns
    -------
    (n_histograms,) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.
    """
    _figure, axes = panels(ax, 1, len(data), size=(TWO_COLUMNS, 2.4), sharey=True)
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
    return np.array(axes[: len(data)], dtype=object)


def crossval_data(summary: ValidationSummary) -> list[Histogram]:
    """Return the histograms of a cross-validation for `plot_fit_histogram` (Figs. 9, 10).

    Parameters
    ----------
    summary : ValidationSummary
        Summary of the cross-validation.

    Returns
    -------
    list of Histogram
        Histogram of each output; its label states the number of pairs below the first bin.
    """
    found = []
    for j, name in enumerate(summary.output_names):
        label = f"{symbol(name)}" + (f", {summary.below[j]} more to the left" if summary.below[j] else "")
        edges, counts = (np.asarray(values[j]) for values in (summary.edges, summary.counts))
        found.append(Histogram(label, edges, counts, float(summary.mean[j]), float(summary.std[j])))
    return found


def _histogram(summary: ValidationSummary) -> npt.NDArray[np.object_]:
    return plot_fit_histogram(crossval_data(summary))


FIGURES = (
    NamedFigure("fig09_crossval_bearing", lambda results: results.summary("rotor_bearing"), _histogram),
    NamedFigure("fig10_crossval_actuators", lambda results: results.summary("piezo_pair"), _histogram),
)
