"""Gains and poles of the actuators over the recordings (paper, Fig. 8)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from gbid.characterise import PiezoCurve, StaticMap
from gbid.core.arrays import BoolArray, FloatArray, IntArray
from gbid.core.brief import Brief
from gbid.core.errors import DataError, UsageError
from gbid.core.tables import probability
from gbid.experiment.experiment import fit_models, recordings_of
from gbid.experiment.stages.crossval import validate_pair
from gbid.experiment.stages.fit import fit_result
from gbid.recording import Recording
from gbid.report.canvas import (
    BLACK,
    BLUE,
    GREY,
    ONE_COLUMN,
    RED,
    TWO_COLUMNS,
    ink,
    legend_above,
    letter,
    new_figure,
    own_style,
    panels,
    plain_label,
    series,
    styled,
    symbol,
    unit_label,
)
from gbid.report.named import NamedFigure
from gbid.report.read import Results, place_of
from gbid.validate import NominalActuator, ResidualTest, Validation, ValidationSummary

_ROWS = (("kappa", "\\kappa_{a,%s}", "m/m", 1.0), ("p1", "p_{1,%s}", "rad/s", 1.0), ("p2", "p_{2,%s}", "krad/s", 1e-3))


@dataclass(frozen=True, eq=False)
class ActuatorParameters(Brief):
    """Parameters of the actuators for each recording.

    Attributes
    ----------
    values : dict of str to (n,) array
        Values by name (``kappa_x``, ``p1_x``, ``p2_x``, ``kappa_y``, ...), in SI units.
    outliers : dict of str to (n,) boolean array
        Masks of the outliers by name; a missing name has none.
    nominal : int, optional
        Index of the recording of the nominal model.
    """

    values: Mapping[str, FloatArray]
    outliers: Mapping[str, BoolArray]
    nominal: int | None = None


@styled
def plot_actuator_parameters(data: ActuatorParameters, ax: Sequence[Axes] | None = None) -> npt.NDArray[np.object_]:
    """Draw gains and poles of the actuators over the recordings, with marks for outliers and nominal model (Fig. 8).

    Parameters
    ----------
    data : ActuatorParameters
        Data of the figure.
    ax : sequence of six matplotlib Axes, optional
        Axes by rows: gain, slow pole, fast pole; columns: x, y. A new figure when left out.

    Returns
    -------
    (3, 2) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.
    """
    figure, axes = panels(ax, 3, 2, size=(TWO_COLUMNS, 5.0), sharex=True)
    for i, (name, letters, unit, scale) in enumerate(_ROWS):
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
                panel.plot(number[k], values[k], "o", color=ink(), label=f"nominal, no. {k + 1}", **ring)
            panel.set_ylabel(f"${letters % axis}$ [{unit}]")
            panel.ticklabel_format(axis="y", useOffset=False)
    for panel in axes[4:]:
        panel.set_xlabel("recording")
    letter(axes)
    figure.align_ylabels(axes)
    legend_above(figure, axes[0])
    return axes.reshape(3, 2)


def nominal_data(nominal: NominalActuator) -> ActuatorParameters:
    """Return the parameters of the actuators for `plot_actuator_parameters` (Fig. 8).

    Parameters
    ----------
    nominal : NominalActuator
        Choice of the nominal actuators, with the values of all recordings.

    Returns
    -------
    ActuatorParameters
        Parameters of all recordings.
    """
    values = dict(zip(nominal.parameter_names, nominal.values.T, strict=True))
    off = {(o.model, o.parameter) for o in nominal.outliers}
    outliers = {name: np.array([(model, name) in off for model in nominal.models]) for name in values}
    return ActuatorParameters(values, outliers, nominal.models.index(nominal.name))


# ---- Histograms of the cross-validation fit (paper, Figs. 9 and 10).


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
    for panel, histogram in zip(axes, data, strict=True):
        panel.stairs(histogram.counts, histogram.edges, fill=True, facecolor="#b9d3e6", edgecolor=BLACK, linewidth=0.8)
        panel.axvline(histogram.mean, color=RED, linestyle=(0, (5, 1.5)))
        decimals = 2 if histogram.std >= 0.01 else 4
        word = f"mean {histogram.mean:.2f} %\nstd {histogram.std:.{decimals}f} %\nn = {histogram.n}"
        left = histogram.mean > histogram.edges.mean()
        place: dict[str, Any] = {"x": 0.03, "ha": "left"} if left else {"x": 0.97, "ha": "right"}
        panel.text(y=0.96, s=word, va="top", fontsize=8, transform=panel.transAxes, **place)
        panel.set_title(histogram.label, loc="right", pad=4)
        panel.xaxis.set_major_locator(MaxNLocator(5))
        panel.ticklabel_format(axis="x", useOffset=False)
        panel.set(xlabel="fit [%]", ylim=(0, 1.35 * max(h.counts.max() for h in data)))
    axes[0].set_ylabel("pairs")
    letter(axes)
    return axes


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
    histograms = []
    for j, name in enumerate(summary.output_names):
        label = f"{symbol(name)}" + (f", {summary.below[j]} more to the left" if summary.below[j] else "")
        edges, counts = (np.asarray(values[j]) for values in (summary.edges, summary.counts))
        histograms.append(Histogram(label, edges, counts, float(summary.mean[j]), float(summary.std[j])))
    return histograms


# ---- Staircases and hysteresis of single piezos, with and without PD control (paper, Figs. A.28 and A.29).


@dataclass(frozen=True, eq=False)
class PiezoStaircase(Brief):
    """Staircase of one piezo.

    Attributes
    ----------
    label : str
        Label of the curves, as ``"open loop"`` or ``"PD control"``.
    time : (n,) array
        Time [s].
    command : (n,) array
        Voltage [V] or reference position [m].
    command_unit : {"V", "m"}
        Unit of the command.
    position : (n,) array
        Position [m].
    steps : (n_steps,) integer array
        Samples at which the command changes, in ascending order.
    """

    label: str
    time: FloatArray
    command: FloatArray
    command_unit: str
    position: FloatArray
    steps: IntArray

    def plateaus(self) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return command and position [m] as means over the last tenth of each step, and a mask of rising steps."""
        ends = [*self.steps[1:], len(self.time)]
        parts = [slice(max(b, e - max(1, (e - b) // 10)), e) for b, e in zip(self.steps, ends, strict=True)]
        command = np.array([self.command[part].mean() for part in parts])
        position = np.array([self.position[part].mean() for part in parts])
        return command, position, np.diff(command, prepend=self.command[max(self.steps[0] - 1, 0)]) > 0

    def single_steps(self) -> list[tuple[FloatArray, FloatArray]]:
        """Return time [s] and position [m] of each step, both from its start; falling steps are mirrored."""
        ends = [*self.steps[1:], len(self.time)]
        steps = []
        for begin, end in zip(self.steps, ends, strict=True):
            before = self.position[max(begin - 1, 0)]
            sign = np.sign(self.command[begin] - self.command[max(begin - 1, 0)]) or 1.0
            steps.append((self.time[begin:end] - self.time[begin], sign * (self.position[begin:end] - before)))
        return steps


def piezo_staircase_data(
    label: str, time: npt.ArrayLike, command: npt.ArrayLike, position: npt.ArrayLike, command_unit: str = "V"
) -> PiezoStaircase:
    """Return a staircase with its steps, at which the command changes.

    Parameters
    ----------
    label : str
        Label of the curves.
    time, command, position : (n,) array
        Time [s], command [`command_unit`] and position [m].
    command_unit : {"V", "m"}
        Unit of the command.

    Returns
    -------
    PiezoStaircase
        The staircase.

    Raises
    ------
    UsageError
        When the command never changes, or when the lengths differ.
    """
    t, c, y = (np.asarray(values, float) for values in (time, command, position))
    if not t.shape == c.shape == y.shape or t.ndim != 1:
        raise UsageError(
            f"{label}: time, command and position have shapes {t.shape}, {c.shape}, {y.shape}; give one each"
        )
    steps = np.flatnonzero(np.diff(c)) + 1
    if not len(steps):
        raise UsageError(f"{label}: the command never changes, so there is no staircase")
    return PiezoStaircase(label, t, c, command_unit, y, steps)


@styled
def plot_piezo_hysteresis(data: Sequence[PiezoStaircase], ax: Sequence[Axes] | None = None) -> npt.NDArray[np.object_]:
    """Draw positions at rest over the rising and falling command, and the command over time (Fig. A.28).

    Parameters
    ----------
    data : sequence of PiezoStaircase
        Staircases; each unit of the commands has its own axes.
    ax : sequence of matplotlib Axes, optional
        Axes of the hysteresis for each unit, then axes of the commands; a new figure when left out.

    Returns
    -------
    (n_units + 1,) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.
    """
    units = list(dict.fromkeys(staircase.command_unit for staircase in data))
    _figure, axes = panels(ax, 1, len(units) + 1, size=(TWO_COLUMNS, 2.6))
    for k, staircase in enumerate(data):
        panel = axes[units.index(staircase.command_unit)]
        scale, unit = unit_label(staircase.command_unit)
        command, position, rising = staircase.plateaus()
        line = series(k, marker=None, linewidth=0.9)
        panel.plot(scale * command, 1e6 * position, label=plain_label(staircase.label), **line)
        for direction, marker in ((rising, "^"), (~rising, "v")):
            look = series(k, linestyle="none", marker=marker, markersize=3.5, markerfacecolor="none")
            panel.plot(scale * command[direction], 1e6 * position[direction], **look)
        panel.set(xlabel=f"command [{unit}]", ylabel="piezo position [µm]")
        panel.legend(loc="upper left", fontsize=7.5)
        panel.set_title("△ rising  ▽ falling", loc="right", pad=4, fontsize=7.5)
        share = (staircase.command - staircase.command.min()) / (np.ptp(staircase.command) or 1.0)
        axes[-1].plot(staircase.time, share, label=plain_label(staircase.label), **line)
    axes[-1].set(xlabel="time [s]", ylabel="command [share of its range]")
    letter(axes)
    return axes


@styled
def plot_piezo_staircase(data: Sequence[PiezoStaircase], ax: Sequence[Axes] | None = None) -> npt.NDArray[np.object_]:
    """Draw single steps from their starts, and whole staircases (Fig. A.29).

    Parameters
    ----------
    data : sequence of PiezoStaircase
        Staircases, for example open loop and PD control. Falling steps are mirrored and dashed.
    ax : sequence of two matplotlib Axes, optional
        Axes to draw into; a new figure when left out.

    Returns
    -------
    (2,) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.
    """
    figure, axes = panels(ax, 1, 2, size=(TWO_COLUMNS, 2.7))
    for k, staircase in enumerate(data):
        rising = staircase.plateaus()[2]
        color = (ink(), RED)[k] if k < 2 else series(k)["color"]
        labelled: set[bool] = set()
        for (time, position), up in zip(staircase.single_steps(), rising, strict=True):
            word = None if bool(up) in labelled else f"{plain_label(staircase.label)}, {'up' if up else 'down'}"
            labelled.add(bool(up))
            style = {"linewidth": 0.9, "linestyle": "-" if up else (0, (3, 1.5)), "alpha": 1.0 if k else 0.8}
            axes[0].plot(1e3 * time, 1e6 * position, color=color, label=word, **style)
        axes[1].plot(staircase.time, 1e6 * staircase.position, color=color)
    axes[0].set(xlabel="time from the step [ms]", ylabel="step of the position [µm]")
    axes[1].set(xlabel="time [s]", ylabel="piezo position [µm]")
    letter(axes)
    legend_above(figure, axes[0], columns=4)
    return axes


def piezo_data(
    curve: PiezoCurve, recording: Recording, command: str, command_channel: str | None = None
) -> PiezoStaircase:
    """Return the staircase of a piezo for Figs. A.28 and A.29.

    Parameters
    ----------
    curve : PiezoCurve
        Characterisation of the piezo.
    recording : Recording
        Recording of the staircase.
    command : str
        Name of the signal with the voltage or the reference position.
    command_channel : str, optional
        Channel of the command; that of the position when left out.

    Returns
    -------
    PiezoStaircase
        The staircase.
    """
    position, _, channel = curve.channel.rpartition("_")
    source = recording.channels[command].index(command_channel or channel)
    y = recording.signal(position)[:, recording.channels[position].index(channel)]
    label = "open loop" if curve.units[0] == "V" else "PD control"
    x = recording.signal(command)[:, source]
    return piezo_staircase_data(label, recording.time, x, y, curve.units[0])


# ---- Signals of a recording over time, a panel for each signal.


@styled
def plot_recording(
    recording: Recording,
    ax: Axes | npt.ArrayLike | None = None,
    *,
    signals: Sequence[str] = (),
    from_s: float = 0.0,
    to_s: float | None = None,
) -> npt.NDArray[np.object_]:
    """Draw the signals of a recording over time, a panel for each signal.

    Parameters
    ----------
    recording : Recording
        The recording.
    ax : array of matplotlib Axes, optional
        Axes, one for each signal; a new figure when left out.
    signals : sequence of str
        Signals to draw; by default all.
    from_s, to_s : float
        Time range [s]; to the end when left out.

    Returns
    -------
    (n_signals,) array of matplotlib Axes
        The axes; ``axes[0].figure`` is the figure.

    Raises
    ------
    DataError
        When the recording has no such signal.
    UsageError
        When the range holds no samples, or when there are too few axes.
    """
    names = list(signals) or list(recording.signals)
    shown = (recording.time >= from_s) & (recording.time <= (recording.duration if to_s is None else to_s))
    if not shown.any():
        raise UsageError(f"from_s = {from_s:g} to to_s = {to_s}: no samples of recording {recording.name!r} in there")
    figure, axes = panels(ax, len(names), 1, size=(TWO_COLUMNS, 0.6 + 1.2 * len(names)), sharex=True)
    time = recording.time[shown]
    for panel, name in zip(axes, names, strict=True):
        values = recording.signal(name, gaps=True, irregular=True)[shown]  # a line ends at a missing sample
        channels = recording.channels[name]
        factor, unit = unit_label(recording.units[name])
        for i, channel in enumerate(channels):
            panel.plot(time, factor * values[:, i], label=channel, **series(i, marker=None, linewidth=0.9))
        panel.set_ylabel(f"{symbol(name)} [{unit}]")
        panel.margins(x=0)
        if len(channels) > 1:  # beside the panel, where it covers no curve
            panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=2.2)
    axes[-1].set_xlabel("time [s]")
    if ax is None:
        figure.align_ylabels(axes)
    return axes


# ---- Figure of a residual test: autocorrelations, and cross-correlations with the inputs (paper, Sec. 3.8).

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

    def panel(output: str, against: str, lags: IntArray, correlation: FloatArray, band: float) -> ResidualPanel:
        return ResidualPanel(output, against, lags, np.asarray(milliseconds * lags), correlation, float(band))

    return [
        [
            panel(output, output, test.lags[1:], test.autocorrelation[j, 1:], test.band),
            *(
                panel(output, source, test.cross_lags, test.crosscorrelation[j, i], test.cross_band[j, i])
                for i, source in enumerate(test.input_names)
            ),
        ]
        for j, output in enumerate(test.output_names)
    ]


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
        wide = "shaded: 99 % of the values if the residuals are white,", "or independent of the input"
        figure.supxlabel((" " if n_columns > 2 else "\n").join(wide), fontsize=8)
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
    if len(axes) < len(rows) or any(len(row) < len(tests) for row, tests in zip(axes, rows, strict=False)):
        raise UsageError(f"residuals need {len(rows)} rows of {len(rows[0])} axes")
    for j, tests in enumerate(rows):
        for i, panel in enumerate(tests):
            _plot_panel(panel, axes[j][i])
        white = "white" if test.white[j] else "not white"
        _say(axes[j][0], f"{white}, {probability(test.p_white[j])}")
        for panel_ax, source, p in zip(axes[j][1:], test.input_names, test.p_independent[j], strict=False):
            _say(panel_ax, f"{'follow' if source in test.follows[j] else 'independent'}, {probability(p)}")
        axes[j][0].set_ylabel(symbol(tests[0].output))
    for i, panel in enumerate(rows[0]):
        scale = float(panel.time[-1] / panel.lags[-1])
        above = axes[0][i].secondary_xaxis(
            "top", functions=(partial(np.multiply, scale), partial(np.multiply, 1 / scale))
        )
        above.set_xlabel("lag [ms]", fontsize=8)
        above.tick_params(labelsize=7.5)
        axes[0][i].set_title("autocorrelation" if i == 0 else f"correlation with {symbol(panel.against)}", pad=8)
        axes[len(rows) - 1][i].set_xlabel("lag [samples]")
    return np.array([list(row)[: len(rows[0])] for row in axes[: len(rows)]], dtype=object)


def _plot_panel(panel: ResidualPanel, ax: Axes) -> None:
    """Draw bars from zero; those outside the band have another colour and width."""
    ax.axhspan(-panel.band, panel.band, color=_BAND, linewidth=0)
    ax.axhline(0.0, color=_INSIDE, linewidth=0.6)
    for chosen, color, linewidth in ((~panel.outside, _INSIDE, 0.9), (panel.outside, _OUTSIDE, 1.5)):
        ax.vlines(panel.lags[chosen], 0.0, panel.correlation[chosen], color=color, linewidth=linewidth)
    edge = max(2.0 * panel.band, 1.15 * float(np.abs(panel.correlation).max()))
    ax.set(xlim=(panel.lags[0] - 1, panel.lags[-1] + 1), ylim=(-edge, 1.3 * edge))  # room for the text above


def _say(ax: Axes, text: str) -> None:
    ax.text(
        0.98, 0.96, text, transform=ax.transAxes, horizontalalignment="right", verticalalignment="top", fontsize=7.5
    )


# ---- Measured and simulated outputs, with the inputs below (paper, Fig. 7).

# A thin dark dashed line on a thick light line: they differ also in grey.
_MEASURED: dict[str, Any] = {"color": "#9e9e9e", "linewidth": 2.6, "linestyle": "-"}
_SIMULATED: dict[str, Any] = {"color": "#0072b2", "linewidth": 1.3, "linestyle": (0, (4, 1.5))}
_PANEL_INCHES, _FRAME_INCHES_RESPONSE = 1.35, 0.95


def response_figure(
    validation: Validation, *, from_s: float | None = None, to_s: float | None = None, title: str | None = None
) -> Figure:
    """Draw measured and simulated outputs, with the inputs below (Fig. 7).

    Parameters
    ----------
    validation : Validation
        Result of `gbid.cross_validate`.
    from_s, to_s : float, optional
        Start and end of the part shown [s]; the whole recording when left out.
    title : str, optional
        Title of the figure; operating point and names of the recordings when left out.

    Returns
    -------
    matplotlib.figure.Figure
        Figure with a panel for each output, and below them panels for the inputs.

    Raises
    ------
    UsageError
        When the part shown has fewer than two samples.
    """
    axes = plot_response(validation, from_s=from_s, to_s=to_s)
    figure: Figure = axes[0].figure
    figure.suptitle(_title(validation) if title is None else title, fontsize=10)
    figure.align_ylabels(list(axes))
    return figure


@styled
def plot_response(
    validation: Validation,
    ax: Axes | npt.ArrayLike | None = None,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
) -> npt.NDArray[np.object_]:
    """Draw measured and simulated outputs, with the inputs below.

    Parameters
    ----------
    validation : Validation
        Result of `gbid.cross_validate`.
    ax : array of matplotlib Axes, optional
        Axes for each output. Further axes, if given, show the inputs. A new figure when left out.
    from_s, to_s : float, optional
        Start and end of the part shown [s]; the whole recording when left out.

    Returns
    -------
    (n_panels,) array of matplotlib Axes
        The axes; ``axes[0].figure`` is the figure.

    Raises
    ------
    UsageError
        When the part shown has fewer than two samples, or when there are too few axes.
    """
    shown = _part(validation.time, from_s, to_s)
    time = validation.time[shown]
    n_outputs = len(validation.output_names)
    inputs = _input_panels(validation)
    n_panels = n_outputs + len(inputs)
    if ax is not None and np.size(np.array(ax, dtype=object)) < n_panels:
        inputs, n_panels = [], n_outputs  # the inputs are not drawn
    size = (mpl.rcParams["figure.figsize"][0], _FRAME_INCHES_RESPONSE + _PANEL_INCHES * n_panels)
    _, axes = panels(ax, n_panels, 1, size=size, sharex=True)
    for i, (name, unit) in enumerate(zip(validation.output_names, validation.output_units, strict=True)):
        scale, label = unit_label(unit)
        axes[i].plot(time, scale * validation.measured[shown, i], label="measured", **_MEASURED)
        axes[i].plot(time, scale * validation.simulated[shown, i], label="simulated", **_SIMULATED)
        axes[i].set_ylabel(f"{symbol(name)} [{label}]")
        axes[i].set_title(f"fit {validation.fit_percent[i]:.1f} %", loc="right", pad=3)
    for places, panel in zip(inputs, axes[n_outputs:], strict=False):
        _plot_inputs(validation, panel, shown, places)
    letter(axes)
    _legend_above(axes[0])
    axes[-1].set(xlabel="time [s]", xlim=(time[0], time[-1]))
    return axes


def _input_panels(validation: Validation) -> list[list[int]]:
    """Return the inputs of each panel: at most four, of one unit."""
    chosen: list[list[int]] = []
    for i, unit in enumerate(validation.input_units):
        if not chosen or len(chosen[-1]) == 4 or validation.input_units[chosen[-1][0]] != unit:
            chosen.append([])
        chosen[-1].append(i)
    return chosen


def _plot_inputs(validation: Validation, ax: Axes, shown: BoolArray, places: list[int]) -> None:
    scale, label = unit_label(validation.input_units[places[0]])
    names = [symbol(validation.input_names[i]) for i in places]
    for k, i in enumerate(places):
        ax.plot(validation.time[shown], scale * validation.inputs[shown, i], label=names[k], **series(k, marker=None))
    if len(validation.input_names) > 1:
        _legend_above(ax)
    ax.set_ylabel(f"{', '.join(names) if len(names) < 3 else 'inputs'} [{label}]")


def _legend_above(ax: Axes) -> None:
    """Draw the legend above the panel, between its two titles, so that it covers no curve."""
    ax.legend(
        loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, borderaxespad=0.0, borderpad=0.2, handlelength=2.6
    )


def _part(time: FloatArray, from_s: float | None, to_s: float | None) -> BoolArray:
    begin, end = time[0] if from_s is None else from_s, time[-1] if to_s is None else to_s
    step = (time[-1] - time[0]) / max(len(time) - 1, 1)
    shown = (time >= begin - 1e-6 * step) & (time <= end + 1e-6 * step)
    if shown.sum() < 2:
        raise UsageError(
            f"from {begin:g} s to {end:g} s the recording has {shown.sum()} samples; "
            f"choose a part of its {time[-1]:g} s"
        )
    return np.asarray(shown)


def _title(validation: Validation) -> str:
    units = {"pressure_bar": "bar", "speed_rpm": "rpm"}
    point = ", ".join(
        f"{validation.conditions[key]:g} {unit}" for key, unit in units.items() if key in validation.conditions
    )
    model = validation.fitted_to[0] if len(validation.fitted_to) == 1 else f"{len(validation.fitted_to)} recordings"
    on = f"model of {plain_label(model)} on {plain_label(validation.recording)}"
    if validation.fitted_to == (validation.recording,):
        on = f"model of {model} on its own recording"
    return f"{point}: {on}" if point else on


_ZOOM = (1.2, 1.4)  # part of the recording that Fig. 7 shows [s]


def _response_of_bearing(results: Results) -> Figure:
    """Draw a bearing model on its own recording, at the paper's operating point or the first (Fig. 7)."""
    name = results.fit_with("rotor_bearing")
    made = [
        model
        for model in fit_models(results.experiment, name)
        if fit_result(results.experiment, name, model).path.is_file()
    ]
    if not made:
        raise DataError(f"no model of fit {name!r} is there; run `gbid fit` or `gbid run`")
    model = next((m for m in made if m.startswith("p5_n6000_")), made[0])
    validation = validate_pair(results.job, name, model, recordings_of(results.experiment, name, model)[0])
    from_s, to_s = _ZOOM if validation.time[-1] >= _ZOOM[1] else (None, None)
    return response_figure(validation, from_s=from_s, to_s=to_s)


# ---- Static map from piezo positions to disc position (paper, Fig. 5).

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
            for chosen, marker, color, label in (
                (sweep.rising, "^", BLUE, "rising"),
                (~sweep.rising, "v", RED, "falling"),
            ):
                points: dict[str, Any] = {"color": color, "markersize": 4, "markerfacecolor": "none"}
                u, p = _MICROMETRES * sweep.u[chosen], _MICROMETRES * sweep.p[chosen, i]
                panel.plot(u, p, marker, label=label, **points)
            text = f"$g_{{{output}{sweep.axis}}}$ = {sweep.gain[i]:z.3f} m/m, rms {_MICROMETRES * rms:.2g} µm"
            panel.set_title(text, loc="right", pad=4, fontsize=8)
            if j == 0:
                panel.set_ylabel(f"$p_{output}$ [µm]")
        axes[columns + j].set_xlabel(f"$u_{sweep.axis}$ [µm]")
    letter(axes)
    figure.align_ylabels(axes)
    legend_above(figure, axes[0], title=title)
    return axes.reshape(2, columns)


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


def static_map_figure(result: StaticMap) -> npt.NDArray[np.object_]:
    """Draw a static map with its operating point (Fig. 5)."""
    return plot_static_map(static_map_data(result), title=place_of(result.conditions))


FIGURES = (
    NamedFigure("fig08_actuator_parameters", lambda r: plot_actuator_parameters(nominal_data(r.nominal))),
    NamedFigure("fig09_crossval_bearing", lambda r: plot_fit_histogram(crossval_data(r.summary("rotor_bearing")))),
    NamedFigure("fig10_crossval_actuators", lambda r: plot_fit_histogram(crossval_data(r.summary("piezo_pair")))),
    NamedFigure("figA28_piezo_hysteresis", lambda r: plot_piezo_hysteresis([piezo_data(*q) for q in r.piezos])),
    NamedFigure("figA29_piezo_staircase", lambda r: plot_piezo_staircase([piezo_data(*q) for q in r.piezos])),
    NamedFigure("fig07_identification", _response_of_bearing),
    NamedFigure("fig05_static_map", lambda r: static_map_figure(r.static_map)),
)
