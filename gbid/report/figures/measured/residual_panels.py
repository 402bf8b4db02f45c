"""Figure of a residual test: autocorrelations, and cross-correlations with the inputs (paper, Sec. 3.8)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from gbid.arrays import BoolArray, FloatArray, IntArray
from gbid.brief import Brief
from gbid.errors import UsageError
from gbid.report.figures.canvas import new_figure, own_style, styled
from gbid.report.figures.save import plain_label, symbol
from gbid.tables.numbers import probability

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from gbid.validate import ResidualTest

_INSIDE, _OUTSIDE, _BAND = "#4d4d4d", "#d55e00", "#dbe9f4"
_ROW_INCHES, _FRAME_INCHES, _COLUMN_INCHES = 1.3, 1.25, 2.1


@dataclass(frozen=True, eq=False)
class ResidualPanel(Brief):
    """Correlation of a residual with itself or with an input.

    Attributes
    ----------
    output : str
        Name of the output of the residual.
    against : str
        Name of the input; the name of the output for an autocorrelation.
    lags : (n,) integer array
        Lags of the residual behind the input [samples]. Autocorrelations start at 1, because their value at 0 is 1.
    time : (n,) array
        Lags [ms].
    correlation : (n,) array
        Correlation coefficients.
    band : float
        Limit of the absolute value for 99 % of the values of white, or independent, residuals.
    """

    output: str
    against: str
    lags: IntArray
    time: FloatArray
    correlation: FloatArray
    band: float

    @property
    def outside(self) -> BoolArray:
        """Mask of the values outside the band."""
        return np.asarray(np.abs(self.correlation) > self.band)


def residuals_data(test: ResidualTest) -> list[list[ResidualPanel]]:
    """Return the correlations of a residual test for `plot_residuals`.

    Parameters
    ----------
    test : ResidualTest
        Result of `gbid.check_residuals`.

    Returns
    -------
    list of list of ResidualPanel
        Row for each output: autocorrelation, then cross-correlation with each input.
    """
    milliseconds = 1e3 * float(test.time[-1]) / max(int(test.lags[-1]), 1)
    rows = []
    for j, output in enumerate(test.output_names):
        own, lags, cross = test.autocorrelation[j, 1:], test.lags[1:], test.cross_lags
        row = [ResidualPanel(output, output, lags, np.asarray(milliseconds * lags), own, test.band)]
        for i, source in enumerate(test.input_names):
            band = float(test.cross_band[j, i])
            values = test.crosscorrelation[j, i]
            row.append(ResidualPanel(output, source, cross, np.asarray(milliseconds * cross), values, band))
        rows.append(row)
    return rows


def residuals_figure(test: ResidualTest, *, title: str | None = None) -> Figure:
    """Draw the correlations of a residual test, with a row for each output.

    Parameters
    ----------
    test : ResidualTest
        Result of `gbid.check_residuals`.
    title : str, optional
        Title of the figure; the name of the recording when left out.

    Returns
    -------
    matplotlib.figure.Figure
        Figure with lags in samples below and in milliseconds above. The band of 99 % is shaded.
    """
    with own_style():
        n_rows, n_columns = len(test.output_names), 1 + len(test.input_names)
        size = (_COLUMN_INCHES * max(n_columns, 2), _FRAME_INCHES + _ROW_INCHES * n_rows)
        figure = new_figure(size)
        axes = figure.subplots(n_rows, n_columns, sharex="col", squeeze=False)
        plot_residuals(test, [list(row) for row in axes])
        figure.supxlabel(
            "shaded: 99 % of the values if the residuals are white, or independent of the input", fontsize=8
        )
        figure.suptitle(f"residuals on {plain_label(test.recording)}" if title is None else title, fontsize=10)
    return figure


@styled
def plot_residuals(test: ResidualTest, ax: Sequence[Sequence[Axes]] | None = None) -> npt.NDArray[np.object_]:
    """Draw the correlations of a residual test with the band of white residuals.

    Parameters
    ----------
    test : ResidualTest
        Result of `gbid.check_residuals`.
    ax : array of matplotlib Axes, optional
        Row of axes for each output: autocorrelation, then cross-correlation with each input. A new figure with a title
        when left out.

    Returns
    -------
    (n_outputs, 1 + n_inputs) array of matplotlib Axes
        The axes; ``axes[0, 0].figure`` is the figure.

    Raises
    ------
    UsageError
        When there are too few axes.
    """
    if ax is None:
        n_rows, n_columns = len(test.output_names), 1 + len(test.input_names)
        return np.array(residuals_figure(test).axes[: n_rows * n_columns], dtype=object).reshape(n_rows, n_columns)
    axes, rows = ax, residuals_data(test)
    if len(axes) < len(rows) or any(len(row) < len(panels) for row, panels in zip(axes, rows, strict=False)):
        raise UsageError(f"residuals need {len(rows)} rows of {len(rows[0])} axes")
    for j, panels in enumerate(rows):
        for i, panel in enumerate(panels):
            _plot_panel(panel, axes[j][i])
        white = "white" if test.white[j] else "not white"
        _say(axes[j][0], f"{white}, {probability(test.p_white[j])}")
        for panel_ax, source, p in zip(axes[j][1:], test.input_names, test.p_independent[j], strict=False):
            _say(panel_ax, f"{'follow' if source in test.follows[j] else 'independent'}, {probability(p)}")
        axes[j][0].set_ylabel(symbol(panels[0].output))
    for i, panel in enumerate(rows[0]):
        _milliseconds_above(axes[0][i], panel)
        axes[0][i].set_title("autocorrelation" if i == 0 else f"correlation with {symbol(panel.against)}", pad=8)
        axes[len(rows) - 1][i].set_xlabel("lag [samples]")
    return np.array([list(row)[: len(rows[0])] for row in axes[: len(rows)]], dtype=object)


def _plot_panel(panel: ResidualPanel, ax: Axes) -> None:
    """Draw bars from zero; those outside the band have another colour and width."""
    ax.axhspan(-panel.band, panel.band, color=_BAND, linewidth=0)
    ax.axhline(0.0, color=_INSIDE, linewidth=0.6)
    styles: tuple[tuple[Any, dict[str, Any]], ...] = (
        (~panel.outside, {"color": _INSIDE, "linewidth": 0.9}),
        (panel.outside, {"color": _OUTSIDE, "linewidth": 1.5}),
    )
    for chosen, style in styles:
        ax.vlines(panel.lags[chosen], 0.0, panel.correlation[chosen], **style)
    edge = max(2.0 * panel.band, 1.15 * float(np.abs(panel.correlation).max()))
    ax.set_ylim(-edge, 1.3 * edge)  # room for the text above
    ax.set_xlim(panel.lags[0] - 1, panel.lags[-1] + 1)


def _say(ax: Axes, text: str) -> None:
    ax.text(
        0.98, 0.96, text, transform=ax.transAxes, horizontalalignment="right", verticalalignment="top", fontsize=7.5
    )


def _milliseconds_above(ax: Axes, panel: ResidualPanel) -> None:
    scale = float(panel.time[-1] / panel.lags[-1])

    def to_time(lag: npt.ArrayLike) -> FloatArray:
        return np.asarray(lag, float) * scale

    def to_lag(time: npt.ArrayLike) -> FloatArray:
        return np.asarray(time, float) / scale

    above = ax.secondary_xaxis("top", functions=(to_time, to_lag))
    above.set_xlabel("lag [ms]", fontsize=8)
    above.tick_params(labelsize=7.5)
