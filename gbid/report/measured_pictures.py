"""Figures of measurements: signals, responses, residual tests, static maps, staircases, and fits over recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from gbid.core.arrays import BoolArray, FloatArray, IntArray
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.tables import probability
from gbid.prefilter import PiezoCurve, StaticMap
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
    panels,
    plain_label,
    series,
    styled,
    symbol,
    unit_label,
)
from gbid.report.read import place_of
from gbid.validate import NominalActuator, ResidualTest, Validation, ValidationSummary

_ROWS = (("kappa", "\\kappa_{a,%s}", "m/m", 1.0), ("p1", "p_{1,%s}", "rad/s", 1.0), ("p2", "p_{2,%s}", "krad/s", 1e-3))


@styled
def plot_actuator_parameters(nominal: NominalActuator, ax: Sequence[Axes] | None = None) -> npt.NDArray[np.object_]:
    """Draw gains and poles of the actuators over the recordings, with marks for outliers and nominal model (Fig. 8).

    Parameters
    ----------
    nominal : NominalActuator
        Result of `gbid.validate.nominal_actuator`, with the values of all recordings.
    ax : sequence of six matplotlib Axes, optional
        Axes by rows: gain, slow pole, fast pole; columns: x, y. A new figure when left out.

    Returns
    -------
    (3, 2) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.
    """
    figure, axes = panels(ax, 3, 2, size=(TWO_COLUMNS, 5.0), sharex=True)
    off = {(o.model, o.parameter) for o in nominal.outliers}
    number, k = np.arange(1, len(nominal.models) + 1), nominal.models.index(nominal.name)
    for i, (name, letters, unit, scale) in enumerate(_ROWS):
        for j, axis in enumerate("xy"):
            panel, parameter = axes[2 * i + j], f"{name}_{axis}"
            values = scale * nominal.values[:, nominal.parameter_names.index(parameter)]
            out = np.array([(model, parameter) in off for model in nominal.models])
            panel.plot(number[~out], values[~out], "o", color=BLUE, markersize=3, label="estimates")
            word = "outliers" if off else "_none"  # Matplotlib leaves labels that begin with "_" out
            panel.plot(number[out], values[out], "x", color=RED, markersize=5, markeredgewidth=1.2, label=word)
            panel.axhline(values[k], color=GREY, linewidth=0.9, linestyle=(0, (5, 1.5)), zorder=0)
            ring: dict[str, Any] = {"markersize": 8, "markerfacecolor": "none", "markeredgewidth": 1.1}
            panel.plot(number[k], values[k], "o", color=ink(), label=f"nominal, no. {k + 1}", **ring)
            panel.set_ylabel(f"${letters % axis}$ [{unit}]")
            panel.ticklabel_format(axis="y", useOffset=False)
    for panel in axes[4:]:
        panel.set_xlabel("recording")
    letter(axes)
    figure.align_ylabels(axes)
    legend_above(figure, axes)
    return axes.reshape(3, 2)


@styled
def plot_fit_histogram(summary: ValidationSummary, ax: Sequence[Axes] | None = None) -> npt.NDArray[np.object_]:
    """Draw histograms of the cross-validation fit with mean and standard deviation (Figs. 9, 10).

    Parameters
    ----------
    summary : ValidationSummary
        Summary of a cross-validation. The titles state the number of pairs below the first bin.
    ax : sequence of matplotlib Axes, optional
        Axes for each output; a new figure when left out.

    Returns
    -------
    (n_outputs,) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.
    """
    _figure, axes = panels(ax, 1, len(summary.output_names), size=(TWO_COLUMNS, 2.4), sharey=True)
    for j, (panel, name) in enumerate(zip(axes, summary.output_names, strict=True)):
        edges, counts, mean, std = summary.edges[j], summary.counts[j], summary.mean[j], summary.std[j]
        panel.stairs(counts, edges, fill=True, facecolor="#b9d3e6", edgecolor=BLACK, linewidth=0.8)
        panel.axvline(mean, color=RED, linestyle=(0, (5, 1.5)))
        decimals = 2 if std >= 0.01 else 4
        word = f"mean {mean:.2f} %\nstd {std:.{decimals}f} %\nn = {counts.sum() + summary.below[j]}"
        place: dict[str, Any] = {"x": 0.03, "ha": "left"} if mean > edges.mean() else {"x": 0.97, "ha": "right"}
        panel.text(y=0.96, s=word, va="top", fontsize=8, transform=panel.transAxes, **place)
        more = f", {summary.below[j]} more to the left" if summary.below[j] else ""
        panel.set_title(f"{symbol(name)}{more}", loc="right", pad=4)
        panel.xaxis.set_major_locator(MaxNLocator(5))
        panel.ticklabel_format(axis="x", useOffset=False)
        panel.set(xlabel="fit [%]", ylim=(0, 1.35 * summary.counts.max()))
    axes[0].set_ylabel("pairs")
    letter(axes)
    return axes


@dataclass(frozen=True, eq=False)
class PiezoStaircase(Brief):
    """Measured staircase of one piezo.

    Attributes
    ----------
    curve : PiezoCurve
        Its characterisation.
    time : (n,) array
        Time [s].
    command, position : (n,) array
        Voltage [V] or reference position [m], and position [m].
    """

    curve: PiezoCurve
    time: FloatArray
    command: FloatArray
    position: FloatArray

    @property
    def label(self) -> str:
        """Label of the curves of this staircase."""
        return "open loop" if self.curve.units[0] == "V" else "PD control"


@styled
def plot_piezo_hysteresis(
    data: Sequence[PiezoStaircase | PiezoCurve], ax: Sequence[Axes] | None = None
) -> npt.NDArray[np.object_]:
    """Draw positions at rest over the rising and falling command, and the command over time (Fig. A.28).

    Parameters
    ----------
    data : sequence of PiezoStaircase or PiezoCurve
        Staircases, or curves, which have one command for each plateau; each unit of the commands has its own axes.
    ax : sequence of matplotlib Axes, optional
        Axes of the hysteresis for each unit, then axes of the commands; a new figure when left out.

    Returns
    -------
    (n_units + 1,) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.
    """
    staircases = [*map(_staircase, data)]
    units = list(dict.fromkeys(staircase.curve.units[0] for staircase in staircases))
    _figure, axes = panels(ax, 1, len(units) + 1, size=(TWO_COLUMNS, 2.6))
    for k, staircase in enumerate(staircases):
        curve = staircase.curve
        panel, (scale, unit) = axes[units.index(curve.units[0])], unit_label(curve.units[0])
        command, position, rising = scale * curve.command, 1e6 * curve.position, curve.direction >= 0
        line = series(k, marker=None, linewidth=0.9)
        panel.plot(command, position, label=staircase.label, **line)
        for direction, marker in ((rising, "^"), (~rising, "v")):
            look = series(k, linestyle="none", marker=marker, markersize=3.5, markerfacecolor="none")
            panel.plot(command[direction], position[direction], **look)
        panel.set(xlabel=f"command [{unit}]", ylabel="piezo position [µm]")
        panel.legend(loc="upper left", fontsize=7.5)
        panel.set_title("△ rising  ▽ falling", loc="right", pad=4, fontsize=7.5)
        share = (staircase.command - staircase.command.min()) / (np.ptp(staircase.command) or 1.0)
        axes[-1].plot(staircase.time, share, label=staircase.label, **line)
    axes[-1].set(xlabel="time [s]", ylabel="command [share of its range]")
    letter(axes)
    return axes


@styled
def plot_piezo_staircase(
    data: Sequence[PiezoStaircase | PiezoCurve], ax: Sequence[Axes] | None = None
) -> npt.NDArray[np.object_]:
    """Draw single steps from their starts, and whole staircases (Fig. A.29).

    Parameters
    ----------
    data : sequence of PiezoStaircase or PiezoCurve
        Staircases or curves, for example open loop and PD control. Falling steps are mirrored. Steps at the end of the
        travel are dashed.
    ax : sequence of two matplotlib Axes, optional
        Axes to draw into; a new figure when left out.

    Returns
    -------
    (2,) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.
    """
    figure, axes = panels(ax, 1, 2, size=(TWO_COLUMNS, 2.7))
    for k, staircase in enumerate(map(_staircase, data)):
        curve = staircase.curve
        color = (ink(), RED)[k] if k < 2 else series(k)["color"]
        labelled: set[bool] = set()
        for step, response, at_end in zip(curve.step, curve.responses.T, curve.saturated.tolist(), strict=True):
            word = None if at_end in labelled else f"{staircase.label}{', at the end of the travel' * at_end}"
            labelled.add(at_end)
            style = {"linewidth": 0.9, "linestyle": (0, (3, 1.5)) if at_end else "-", "alpha": 1.0 if k else 0.8}
            position = 1e6 * (response if step >= 0 else -response)
            axes[0].plot(1e3 * curve.response_time, position, color=color, label=word, **style)
        axes[1].plot(staircase.time, 1e6 * staircase.position, color=color)
    axes[0].set(xlabel="time from the step [ms]", ylabel="step of the position [µm]", xscale="log")  # rise and creep
    axes[1].set(xlabel="time [s]", ylabel="piezo position [µm]")
    letter(axes)
    legend_above(figure, axes, columns=2)
    return axes


def _staircase(data: PiezoStaircase | PiezoCurve) -> PiezoStaircase:
    """Return the staircase of a result; a static curve has plateaus in place of samples."""
    return data if isinstance(data, PiezoStaircase) else PiezoStaircase(data, data.time, data.command, data.position)


def piezo_data(
    curve: PiezoCurve, recording: Recording, command: str, command_channel: str | None = None
) -> PiezoStaircase:
    """Return the staircase of a piezo for the figures A.28 and A.29.

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
    return PiezoStaircase(curve, recording.time, recording.signal(command)[:, source], y)


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
        raise UsageError(
            f"from_s = {from_s:g} to to_s = {to_s}: no samples of recording {recording.name!r} in this range"
        )
    figure, axes = panels(ax, len(names), 1, size=(TWO_COLUMNS, 0.6 + 1.2 * len(names)), sharex=True)
    time = recording.time[shown]
    for panel, name in zip(axes, names, strict=True):
        values = recording.signal(name, gaps=True, irregular=True)[shown]  # a line ends at a missing sample
        channels = recording.channels[name]
        factor, unit = unit_label(recording.units[name], values)
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


_INSIDE, _OUTSIDE, _BAND = "#4d4d4d", "#d55e00", "#dbe9f4"
_ROW_INCHES, _FRAME_INCHES, _NARROWEST = 1.3, 1.25, 4.2


@styled
def plot_residuals(
    test: ResidualTest, ax: Axes | npt.ArrayLike | None = None, *, title: str | None = None
) -> npt.NDArray[np.object_]:
    """Draw the correlations of a residual test with the band of white residuals, lags in samples and milliseconds.

    Parameters
    ----------
    test : ResidualTest
        Result of `gbid.check_residuals`.
    ax : array of matplotlib Axes, optional
        Row of axes for each output: autocorrelation, then cross-correlation with each input. A new figure with a title
        when left out.
    title : str, optional
        Title of the new figure; the name of the recording when left out.

    Returns
    -------
    (n_outputs, 1 + n_inputs) array of matplotlib Axes
        The axes; ``axes[0, 0].figure`` is the figure.

    Raises
    ------
    UsageError
        When there are too few axes.
    """
    n_rows, n_columns = len(test.output_names), 1 + len(test.input_names)
    size = (_NARROWEST, _FRAME_INCHES + _ROW_INCHES * n_rows)
    figure, axes = panels(ax, n_rows, n_columns, size=size, sharex="col")
    axes = axes.reshape(n_rows, n_columns)
    for j, (row, output) in enumerate(zip(axes, test.output_names, strict=True)):
        _plot_correlation(row[0], test.lags[1:], test.autocorrelation[j, 1:], test.band)  # at lag 0 it is one
        _say(row[0], f"{'white' if test.white[j] else 'not white'}, {probability(test.p_white[j])}")
        row[0].set_ylabel(symbol(output))
        for i, (panel, source) in enumerate(zip(row[1:], test.input_names, strict=True)):
            _plot_correlation(panel, test.cross_lags, test.crosscorrelation[j, i], float(test.cross_band[j, i]))
            kind = "follow" if source in test.follows[j] else "independent"
            _say(panel, f"{kind}, {probability(test.p_independent[j, i])}")
    milliseconds = 1e3 * float(test.time[-1]) / max(int(test.lags[-1]), 1)
    scales = partial(np.multiply, milliseconds), partial(np.multiply, 1 / milliseconds)
    titles = ["autocorrelation", *(f"correlation with {symbol(source)}" for source in test.input_names)]
    for top, bottom, heading in zip(axes[0], axes[-1], titles, strict=True):
        above = top.secondary_xaxis("top", functions=scales)
        above.set_xlabel("lag [ms]", fontsize=8)
        above.tick_params(labelsize=7.5)
        top.set_title(heading, pad=8)
        bottom.set_xlabel("lag [samples]")
    if ax is None:
        captions = "shaded: 99 % of the values if the residuals are white,", "or independent of the input"
        figure.supxlabel((" " if n_columns > 2 else "\n").join(captions), fontsize=8)
        figure.suptitle(f"residuals on {plain_label(test.recording)}" if title is None else title, fontsize=10)
    return axes


def _plot_correlation(ax: Axes, lags: IntArray, correlation: FloatArray, band: float) -> None:
    """Draw correlations as bars; bars outside the band have another colour and width."""
    ax.axhspan(-band, band, color=_BAND, linewidth=0)
    ax.axhline(0.0, color=_INSIDE, linewidth=0.6)
    outside = np.abs(correlation) > band
    for chosen, color, linewidth in ((~outside, _INSIDE, 0.9), (outside, _OUTSIDE, 1.5)):
        ax.vlines(lags[chosen], 0.0, correlation[chosen], color=color, linewidth=linewidth)
    edge = max(2.0 * band, 1.15 * float(np.abs(correlation).max()))
    ax.set(xlim=(lags[0] - 1, lags[-1] + 1), ylim=(-edge, 1.3 * edge))  # room for the text above


def _say(ax: Axes, text: str) -> None:
    ax.text(
        0.98, 0.96, text, transform=ax.transAxes, horizontalalignment="right", verticalalignment="top", fontsize=7.5
    )


# A thin dark dashed line on a thick light line: they differ also in grey.
_MEASURED: dict[str, Any] = {"color": "#9e9e9e", "linewidth": 2.6, "linestyle": "-"}
_SIMULATED: dict[str, Any] = {"color": "#0072b2", "linewidth": 1.3, "linestyle": (0, (4, 1.5))}
_PANEL_INCHES, _FRAME_INCHES_RESPONSE = 1.35, 0.95


@styled
def plot_response(
    validation: Validation,
    ax: Axes | npt.ArrayLike | None = None,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
    title: str | None = None,
) -> npt.NDArray[np.object_]:
    """Draw measured and simulated outputs, with the inputs below (Fig. 7).

    Parameters
    ----------
    validation : Validation
        Result of `gbid.cross_validate`.
    ax : array of matplotlib Axes, optional
        Axes for each output. Further axes, if given, show the inputs. A new figure with a title when left out.
    from_s, to_s : float, optional
        Start and end of the part shown [s]; the whole recording when left out.
    title : str, optional
        Title of the new figure; operating point and names of the recordings when left out.

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
    figure, axes = panels(ax, n_panels, 1, size=size, sharex=True)
    for i, (name, unit) in enumerate(zip(validation.output_names, validation.output_units, strict=True)):
        scale, label = unit_label(unit, validation.measured[shown, i])
        axes[i].plot(time, scale * validation.measured[shown, i], label="measured", **_MEASURED)
        axes[i].plot(time, scale * validation.simulated[shown, i], label="simulated", **_SIMULATED)
        axes[i].set_ylabel(f"{symbol(name)} [{label}]")
        axes[i].set_title(f"fit {validation.fit_percent[i]:.1f} %", loc="right", pad=3)
    for places, panel in zip(inputs, axes[n_outputs:], strict=False):
        _plot_inputs(validation, panel, shown, places)
    letter(axes)
    _legend_above(axes[0])
    axes[-1].set(xlabel="time [s]", xlim=(time[0], time[-1]))
    if ax is None:
        figure.suptitle(_title(validation) if title is None else title, fontsize=10)
        figure.align_ylabels(list(axes))
    return axes


def _input_panels(validation: Validation) -> list[list[int]]:
    """Return the inputs of each panel: at most four, with equal units."""
    chosen: list[list[int]] = []
    for i, unit in enumerate(validation.input_units):
        if not chosen or len(chosen[-1]) == 4 or validation.input_units[chosen[-1][0]] != unit:
            chosen.append([])
        chosen[-1].append(i)
    return chosen


def _plot_inputs(validation: Validation, ax: Axes, shown: BoolArray, places: list[int]) -> None:
    scale, label = unit_label(validation.input_units[places[0]], validation.inputs[shown][:, places])
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


@styled
def plot_static_map(result: StaticMap, ax: Sequence[Axes] | None = None) -> npt.NDArray[np.object_]:
    """Draw the positions at rest over the inputs with fitted straight lines; the title is the operating point.

    Parameters
    ----------
    result : StaticMap
        Static map. Its positions are drawn relative to the equilibrium.
    ax : sequence of matplotlib Axes, optional
        Axes with a row for each output and a column for each input that moves; a new figure when left out.

    Returns
    -------
    (n_outputs, n_inputs) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.
    """
    inputs = [int(j) for j in np.flatnonzero(np.isfinite(result.gain).all(axis=0))]
    shape = len(result.output_names), len(inputs)
    width = TWO_COLUMNS if len(inputs) > 1 else ONE_COLUMN
    figure, axes = panels(ax, *shape, size=(width, 0.4 + 2.0 * shape[0]), sharex="col", sharey="row")
    for panel, (i, j) in zip(axes, np.ndindex(shape), strict=True):
        data, output, source = result.panel(i, inputs[j]), result.output_names[i], result.input_names[inputs[j]]
        line = 1e6 * data["line_input"], 1e6 * data["line_output"]
        panel.plot(*line, color=ink(), linewidth=0.9, label="straight line")
        rising = data["direction"] >= 0
        for chosen, marker, color, label in ((rising, "^", BLUE, "rising"), (~rising, "v", RED, "falling")):
            points: dict[str, Any] = {"color": color, "markersize": 4, "markerfacecolor": "none", "label": label}
            panel.plot(1e6 * data["input"][chosen], 1e6 * data["output"][chosen], marker, **points)
        gain, rms = result.gain[i, inputs[j]], 1e6 * result.rms[i, inputs[j]]
        text = f"$g_{{{output[-1]}{source[-1]}}}$ = {gain:z.3f} m/m, rms {rms:.2g} µm"
        panel.set_title(text, loc="right", pad=4, fontsize=8)
        if j == 0:
            panel.set_ylabel(f"{symbol(output)} [µm]")
        if i == shape[0] - 1:
            panel.set_xlabel(f"{symbol(source)} [µm]")
    letter(axes)
    figure.align_ylabels(axes)
    legend_above(figure, axes, title=place_of(result.conditions))
    return axes.reshape(shape)
