"""Figures of models: Bode, Campbell, sensitivity zones, order choice, orbit, poles, profiles, time responses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from scipy.optimize import linear_sum_assignment

from gbid.control import ISO_LIMITS, Sensitivities
from gbid.control.loop.sensitivity import SensitivityZones, sensitivity_zones
from gbid.core.arrays import ComplexArray, FloatArray, IntArray, one_of_each_pair, poles_of_samples
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.option_types import Positive
from gbid.identify import Profile
from gbid.identify.data import select
from gbid.identify.frequency_data import FrequencyData, MeasuredResponse
from gbid.identify.start.black_box import SubspaceOrders
from gbid.identify.uncertainty.curves import (
    LEVEL,
    Bode,
    Excited,
    PoleZero,
    TimeResponse,
    bode,
    default_grid,
    ellipse,
    pole_zero,
    quantile,
    time_response,
)
from gbid.identify.uncertainty.uncertain_model import ModelLike, UncertainModel, as_uncertain
from gbid.online import RecursiveResult
from gbid.recording import Recording
from gbid.report.canvas import (
    GREY,
    RED,
    TWO_COLUMNS,
    channel_pairs,
    ink,
    legend_above,
    one_panel,
    panels,
    plain_label,
    series,
    styled,
    symbol,
    unit_label,
)
from gbid.structure import LinearModel


def frequency_axis(ax: Axes, low: float, high: float) -> None:
    """Set the limits of a logarithmic frequency axis [Hz], with readable ticks for short and long ranges."""
    ax.set_xlim(low, high)
    subs = (1.0, 2.0, 5.0) if high < 300 * low else (1.0,)
    ax.xaxis.set_major_locator(LogLocator(subs=subs))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())


Sources = ModelLike | Sequence[ModelLike] | Mapping[str, ModelLike]
"""A `LinearModel` or `FitResult`, several of them, or several by label."""


def labelled(sources: Sources) -> dict[str, UncertainModel]:
    """Return the models of a figure by label; without labels by name, and equal names with numbers.

    Parameters
    ----------
    sources : LinearModel or FitResult, sequence of them, or dict of str to them
        The models.

    Returns
    -------
    dict of str to UncertainModel

    Raises
    ------
    UsageError
        When there is no model, when one of them is something else, or when their channels differ in number.
    """
    if isinstance(sources, Mapping):
        labelled_models = {label: as_uncertain(source) for label, source in sources.items()}
    else:
        models = [as_uncertain(s) for s in (sources if isinstance(sources, Sequence) else [sources])]
        names = [m.model.name for m in models]
        numbered = [f"{name} ({i})" if names.count(name) > 1 else name for i, name in enumerate(names, 1)]
        labelled_models = dict(zip(numbered, models, strict=True))
    if not labelled_models:
        raise UsageError("no model to draw; give at least one")
    shapes = {label: m.model.D.shape for label, m in labelled_models.items()}
    if len(set(shapes.values())) > 1:
        listed = ", ".join(f"{label} {n_y} x {n_u}" for label, (n_y, n_u) in shapes.items())
        raise UsageError(f"models with different numbers of outputs and inputs in one figure: {listed}")
    return labelled_models


_MEASURED: dict[str, Any] = {"linestyle": "none", "marker": ".", "markersize": 3.0, "color": GREY, "zorder": 1}
_HEIGHTS = {"magnitude": 1.5, "phase": 1.0, "coherence": 0.7}  # inch


def bode_data(sources: Sources, frequency_hz: npt.ArrayLike | None = None) -> dict[str, Bode]:
    """Return the frequency responses of models on a common grid, for `plot_bode`.

    Parameters
    ----------
    sources : LinearModel or FitResult, sequence of them, or dict of str to them
        The models, all with the same number of inputs and outputs.
    frequency_hz : (n,) array, optional
        Frequencies above zero [Hz]; by default those that show the poles of all models.

    Returns
    -------
    dict of str to Bode
        Responses with standard deviations, by label.

    Raises
    ------
    UsageError
        When the models differ in the number of channels, or a frequency is not above zero.
    """
    models = labelled(sources)
    if frequency_hz is None:
        frequency_hz = _common_grid(models)
    return {label: bode(model, frequency_hz) for label, model in models.items()}


def _common_grid(models: Mapping[str, UncertainModel]) -> FloatArray:
    """Return frequencies [Hz] around the poles of all models, up to the lowest Nyquist frequency."""
    grid = np.unique(np.concatenate([default_grid(m) for m in models.values()]))
    steps = [step for m in models.values() for step in (m.model.dt, m.sample_time) if step]
    return grid[grid <= min((0.5 / step for step in steps), default=np.inf)]


Units = Mapping[str, str] | None
"""Unit of each channel by its name; where none is given, fits of the structures of gbid are in metres."""


def _units(sources: Sources | FrequencyData, given: Units) -> dict[str, str]:
    """Return the units of the channels by name, from fits and from given units."""
    units: dict[str, str] = {}
    if not isinstance(sources, FrequencyData):
        for model in labelled(sources).values():
            units |= model.units
    return units | dict(given or {})


def _gain_unit(units: Mapping[str, str], output: str, inputs: Sequence[str], *, in_a_second: bool = False) -> str:
    """Return the unit of the responses of an output as a label; ``output/input`` if the units are unknown."""
    known = {units.get(name) for name in inputs}
    is_known = output in units and len(known) == 1 and None not in known
    above, below = (units[output] or "1", known.pop() or "1") if is_known else ("output", "input")
    return plain_label(f"[{above}/({below} s)]" if in_a_second else f"[{above}/{below}]")


@styled
def plot_bode(
    sources: Sources | FrequencyData,
    ax: Axes | npt.ArrayLike | None = None,
    *,
    frequency_hz: npt.ArrayLike | None = None,
    measured: FrequencyData | None = None,
    level: float = LEVEL,
    units: Units = None,
) -> npt.NDArray[np.object_]:
    """Draw magnitude and phase of models with confidence bands, and a measured response with its coherence over them.

    Parameters
    ----------
    sources : LinearModel or FitResult, sequence of them, or dict of str to them; or FrequencyData
        The models. Those of a fit have confidence bands. A measured response may stand alone.
    ax : array of matplotlib Axes, optional
        Axes with a column for each input, and for each output a row of magnitudes and one of phases; for a
        `MeasuredResponse` also one of coherences. A new figure when left out.
    frequency_hz : (n,) array, optional
        Frequencies above zero [Hz]; by default those that show the poles, within the band of the measurement.
    measured : FrequencyData, optional
        Data, or the result of `gbid.measured_response`, which has the coherence. Values with a standard deviation above
        half their magnitude are left out.
    level : float
        Probability of the confidence bands.
    units : dict of str to str, optional
        Unit of each channel by its name; fits of the structures of gbid are in metres.

    Returns
    -------
    (n_rows, n_inputs) array of matplotlib Axes
        The axes; ``axes[0, 0].figure`` is the figure.

    Raises
    ------
    UsageError
        When there are too few axes, or when the measurement has other channels than the models.
    """
    shape: Bode | FrequencyData
    if isinstance(sources, FrequencyData):
        measured, curves, shape = sources, {}, sources
    else:
        curves = bode_data(sources, _within(measured, sources) if frequency_hz is None else frequency_hz)
        shape = next(iter(curves.values()))
    n_y, n_u = shape.response.shape[1:]
    if measured is not None and measured.response.shape[1:] != (n_y, n_u):
        raise UsageError(
            f"the measured response has {' x '.join(map(str, measured.response.shape[1:]))} outputs and inputs, the "
            f"models have {n_y} x {n_u}"
        )
    coherent = isinstance(measured, MeasuredResponse)
    kinds = ("magnitude", "phase", "coherence") if coherent else ("magnitude", "phase")
    heights = [_HEIGHTS[kind] for kind in kinds] * n_y
    size = (TWO_COLUMNS if n_u > 1 else 4.6, 0.8 + sum(heights))
    figure, flat = panels(ax, len(heights), n_u, size=size, sharex=True, height_ratios=heights)
    axes = flat.reshape(len(heights), n_u)
    known = _units(sources, units)
    for i, j, _ in channel_pairs(axes[:: len(kinds)], shape.output_names, shape.input_names):
        column = axes[len(kinds) * i : len(kinds) * (i + 1), j]
        for k, (label, curve) in enumerate(curves.items()):
            _draw(column[0], column[1], curve, i, j, level, label, series(k, marker=None))
        if curves and not any(curve.magnitude[:, i, j].any() for curve in curves.values()):
            column[0].set_ylim(0.1, 10.0)
            column[0].text(0.5, 0.5, "no effect", ha="center", color=GREY, transform=column[0].transAxes)
        column[0].set_ylabel("" if j else f"magnitude {_gain_unit(known, shape.output_names[i], shape.input_names)}")
        if measured is not None:
            _draw_measured(column, measured, next(iter(curves.values()), None), i, j)
    for panel, kind in zip(axes[:, 0], kinds * n_y, strict=True):
        if kind != "magnitude":
            panel.set_ylabel("phase [°]" if kind == "phase" else "coherence [-]")
    for panel in axes[-1]:
        panel.set_xlabel("frequency [Hz]")
    for panel in flat:
        frequency_axis(panel, shape.frequency_hz[0], shape.frequency_hz[-1])
    if len(curves) + (measured is not None) > 1 or any(curve.has_band for curve in curves.values()):
        longest = max(map(len, curves), default=0)
        legend_above(figure, axes, columns=4 if longest <= 16 else 2 if longest <= 24 else 1)  # letters
    return axes


def _draw(
    magnitude: Axes, phase: Axes, curve: Bode, i: int, j: int, level: float, label: str, style: dict[str, Any]
) -> None:
    f, size = curve.frequency_hz, curve.magnitude[:, i, j]
    magnitude.loglog(f, np.where(size > 0, size, np.nan), label=label, **style)  # a zero has no logarithm
    phase.semilogx(f, curve.phase_deg[:, i, j], **style)
    _degrees(phase)
    if not (curve.has_band and size.any()):  # an input that no output follows has none
        return
    band: dict[str, Any] = {"color": style["color"], "alpha": 0.25, "linewidth": 0}
    low, high = (side[:, i, j] for side in curve.magnitude_band(level))
    shown = _within_decades(size)
    _label_last_band(magnitude, magnitude.fill_between(f, np.clip(low, *shown), np.clip(high, *shown), **band), level)
    low, high = (side[:, i, j] for side in curve.phase_band(level))
    middle = curve.phase_deg[:, i, j]
    phase.fill_between(f, np.maximum(low, middle - 180), np.minimum(high, middle + 180), **band)


def _label_last_band(panel: Axes, band: Artist, level: float) -> None:
    """Give the confidence bands of a panel one common legend entry."""
    for earlier in panel.collections:
        earlier.set_label("_")
    band.set_label(f"{100 * level:g} %")


def _within(measured: FrequencyData | None, sources: Sources) -> FloatArray | None:
    """Return frequencies [Hz] around the poles of all models, within the band of a measurement."""
    if measured is None:
        return None
    grid = _common_grid(labelled(sources))
    low, high = measured.frequency_hz[[0, -1]]
    return np.unique(np.concatenate([grid[(grid > low) & (grid < high)], [low, high]]))


def _draw_measured(
    column: npt.NDArray[np.object_], measured: FrequencyData, model: Bode | None, i: int, j: int
) -> None:
    f, value = measured.frequency_hz, measured.response[:, i, j]
    clear = measured.std[:, i, j] < 0.5 * np.abs(value)
    limits = column[0].get_ylim()  # those of the model: where there is only noise, the points lie anywhere
    look = _MEASURED if model is not None else {**_MEASURED, "color": ink()}
    column[0].loglog(f[clear], np.abs(value[clear]), label="measured", **look)
    phase = np.degrees(np.unwrap(np.angle(value)))
    if model is not None:
        column[0].set_ylim(0.5 * limits[0], 2 * limits[1])
        near = np.interp(f, model.frequency_hz, model.phase_deg[:, i, j])
        phase = phase + 360 * np.round((near - phase) / 360)  # on the turn of the model
    column[1].semilogx(f[clear], phase[clear], **look)
    _degrees(column[1])
    if isinstance(measured, MeasuredResponse):
        column[2].semilogx(f, measured.coherence[:, i], color=GREY, linewidth=0.9)
        column[2].set_ylim(0.0, 1.05)


def _degrees(ax: Axes) -> None:
    """Set the ticks of a phase axis to fractions of a turn."""
    ax.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 1.8, 4.5, 9, 10]))


def _within_decades(magnitude: FloatArray) -> tuple[float, float]:
    """Return limits for a confidence band, so that a very wide part does not flatten the curve."""
    positive = magnitude[magnitude > 0]
    return (0.01 * float(positive.min()), 100 * float(positive.max())) if len(positive) else (1e-300, 1e300)


@dataclass(frozen=True, eq=False)
class Campbell(Brief):
    """Natural frequencies of models over speed, for a Campbell diagram.

    Attributes
    ----------
    speed_rpm : (n,) array
        Speeds [rpm], ascending.
    frequency_hz, std_hz : (n, n_modes) array
        Natural frequencies and their standard deviations [Hz]; nan where a model has fewer modes or no uncertainty.
    damping : (n, n_modes) array
        Damping factors.
    """

    speed_rpm: FloatArray
    frequency_hz: FloatArray
    std_hz: FloatArray
    damping: FloatArray


def campbell_data(models: Mapping[float, ModelLike]) -> Campbell:
    """Return the natural frequencies of models over speed, for `plot_campbell`.

    A mode keeps its column from speed to speed by its shape (from each input to each output) and its frequency, also
    where it crosses another. The first columns rise in frequency at the lowest speed.

    Parameters
    ----------
    models : dict of float to LinearModel or FitResult
        Models by speed [rpm].

    Returns
    -------
    Campbell

    Raises
    ------
    UsageError
        When there is no model.
    """
    if not models:
        raise UsageError("no model to draw; give at least one by its speed in rpm")
    speeds = sorted(models)
    rows, paths, last, n = [], [], np.zeros((0, 2), complex), 0
    shapes = np.zeros((0, 0), complex)
    for speed in speeds:
        poles_of_model = pole_zero(models[speed])
        keep = np.flatnonzero(one_of_each_pair(poles_of_model.poles))
        poles = poles_of_model.poles[keep]
        order = np.argsort(np.abs(poles))
        keep, poles = keep[order], poles[order]
        mode_shapes = _mode_shapes(as_uncertain(models[speed]).model, poles)
        before = shapes if shapes.shape[1:] == mode_shapes.shape[1:] else np.zeros((n, *mode_shapes.shape[1:]), complex)
        path = _followed(poles, mode_shapes, last, before)
        fresh = path < 0
        path[fresh] = np.arange(n, n + fresh.sum())
        n = max(n, int(path.max(initial=-1)) + 1)
        known, (last, shapes) = len(last), (np.resize(last, (n, 2)), np.resize(before, (n, mode_shapes.shape[1])))
        last[path] = np.column_stack([poles, np.where(path < known, 2 * poles - last[path, 0], poles)])
        shapes[path] = mode_shapes
        paths.append(path)
        towards = np.column_stack([poles.real, poles.imag]) / np.abs(poles)[:, None]
        variance = np.einsum("ia,iab,ib->i", towards, poles_of_model.pole_covariance[keep], towards)
        rows.append((np.abs(poles) / (2 * np.pi), np.sqrt(variance) / (2 * np.pi), -poles.real / np.abs(poles)))
    columns = np.full((3, len(rows), n), np.nan)
    for i, (row, path) in enumerate(zip(rows, paths, strict=True)):
        columns[:, i, path] = row
    return Campbell(np.array(speeds, float), *columns)


def _mode_shapes(model: LinearModel, poles: ComplexArray) -> ComplexArray:
    """Return the residues of each pole from all inputs to all outputs, as unit vectors (n_modes, n)."""
    values, right = np.linalg.eig(model.A)
    values = values if model.dt is None else poles_of_samples(values, model.dt)
    nearest = np.abs(values - poles[:, None]).argmin(axis=1)
    left = np.linalg.pinv(right)
    inputs = model.B if model.B_delayed is None else np.hstack([model.B, model.B_delayed])
    shapes = np.einsum("yk,ku->kyu", model.C @ right, left @ inputs)[nearest].reshape(len(poles), -1)
    size = np.linalg.norm(shapes, axis=1, keepdims=True)
    return np.asarray(shapes / np.where(size > 0, size, 1.0))


def _followed(poles: ComplexArray, shapes: ComplexArray, last: ComplexArray, before: ComplexArray) -> IntArray:
    """Return the column of the previous speed that each mode continues; -1 for a new mode.

    Parameters
    ----------
    poles, shapes : (k,), (k, p) array
        Modes and their shapes.
    last, before : (n, 2), (n, p) array
        Of each column the last pole and the one expected next, and the last shape.
    """
    path = np.full(len(poles), -1)
    likeness = np.abs(shapes.conj() @ before.T)
    distance = np.abs(np.abs(poles)[:, None] / np.maximum(np.abs(last[:, 1]), 1e-300) - 1)
    rows, columns = linear_sum_assignment(1 - likeness + np.minimum(distance, 1.0))
    path[rows] = columns
    return path


@styled
def plot_campbell(
    models: Mapping[float, ModelLike] | Campbell,
    ax: Axes | None = None,
    *,
    orders: Sequence[float] = (1.0, 2.0),
    level: float = LEVEL,
) -> Axes:
    """Draw a Campbell diagram: natural frequencies over speed, and lines of the orders of the rotation.

    Parameters
    ----------
    models : dict of float to LinearModel or FitResult, or Campbell
        Models by speed [rpm]. Those of fits have error bars.
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.
    orders : sequence of float
        Multiples of the rotation that are drawn.
    level : float
        Probability of the error bars.

    Returns
    -------
    matplotlib Axes
        The axes; ``axes.figure`` is the figure.

    Raises
    ------
    UsageError
        When there is no model.
    """
    data = models if isinstance(models, Campbell) else campbell_data(models)
    _, axes = one_panel(ax, (4.6, 3.4))
    for k, column in enumerate(data.frequency_hz.T):
        half = quantile(level) * data.std_hz[:, k]
        look = series(k, capsize=2, markersize=4, clip_on=False)
        axes.errorbar(data.speed_rpm, column, yerr=np.where(np.isfinite(half), half, 0.0), **look)
    top = 1.15 * float(np.nanmax(data.frequency_hz)) if np.isfinite(data.frequency_hz).any() else 1.0
    last = float(data.speed_rpm[-1])
    for order in orders:
        axes.plot([0, last], [0, order * last / 60], color=GREY, linewidth=0.9, zorder=0)
        at = min(last, 60 * top / order) if order else last
        axes.annotate(f"{order:g}X", (0.97 * at, 0.97 * order * at / 60), alpha=0.7, ha="right", va="bottom")
    axes.set(xlabel="speed [rpm]", xlim=(min(0.0, float(data.speed_rpm[0])), 1.02 * last if last > 0 else 1.0))
    axes.set(ylabel="natural frequency [Hz]", ylim=(0.0, top))
    return axes


_SHADES = {"A": 0.0, "B": 0.13, "C": 0.27, "D": 0.45}  # opacity of a grey, on any background


@styled
def plot_iso_zones(loop: Sensitivities | SensitivityZones, ax: Axes | None = None) -> Axes:
    """Draw the sensitivity of each axis of a loop over the zones A to D of ISO 14839-3.

    Parameters
    ----------
    loop : Sensitivities or SensitivityZones
        Result of `gbid.sensitivities` or `gbid.control.sensitivity_zones`.
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.

    Returns
    -------
    matplotlib Axes
        The axes; ``axes.figure`` is the figure.
    """
    data = loop if isinstance(loop, SensitivityZones) else sensitivity_zones(loop)
    figure, axes = one_panel(ax, (4.6, 3.2))
    low, high = float(data.frequency_hz[0]), float(data.frequency_hz[-1])
    top = max(6.0, 1.1 * float(np.max(data.magnitude)))
    floor = 0.0
    for zone, limit in ISO_LIMITS.items():
        ceiling = min(limit, top)
        axes.axhspan(floor, ceiling, color="0.5", alpha=_SHADES[zone], linewidth=0, zorder=0)
        axes.text(0.985, 0.5 * (floor + ceiling), zone, transform=axes.get_yaxis_transform(), ha="right", va="center")
        floor = ceiling
    for k, axis in enumerate(data.axes):
        label = f"{symbol(axis)}: peak {data.peak[k]:.2f}, zone {data.zone[k]}"
        axes.semilogx(data.frequency_hz, data.magnitude[:, k], label=label, **series(k, marker=None))
    frequency_axis(axes, low, high)
    axes.set(xlabel="frequency [Hz]", ylabel="sensitivity [-]", ylim=(0.0, top))
    axes.grid(False)
    legend_above(figure, axes, columns=2)
    return axes


@styled
def plot_orders(orders: SubspaceOrders, ax: npt.ArrayLike | Axes | None = None) -> npt.NDArray[np.object_]:
    """Draw the singular values of a subspace method, and the errors of its models on validation samples.

    Parameters
    ----------
    orders : SubspaceOrders
        Result of `gbid.identify.subspace_orders`.
    ax : array of matplotlib Axes, optional
        Two axes; a new figure when left out.

    Returns
    -------
    (2,) array of matplotlib Axes
        The axes; ``axes[0].figure`` is the figure.
    """
    _, axes = panels(ax, 1, 2, size=(TWO_COLUMNS, 2.6))
    numbers = np.arange(1, len(orders.errors) + 1)
    values = orders.singular_values[: len(numbers)]
    axes[0].semilogy(np.arange(1, len(values) + 1), values, **series(0, linestyle="none", marker="o"))
    axes[0].set(ylabel="singular value, relative")
    stable = np.isfinite(orders.errors)
    spread = np.minimum(orders.std[stable], 0.9 * orders.errors[stable])  # a bar on a logarithmic axis ends above zero
    axes[1].errorbar(
        numbers[stable], orders.errors[stable], spread, **series(0, linestyle="none", marker="o"), capsize=2
    )
    axes[1].set(ylabel="error on other samples", yscale="log")
    for panel in axes:
        panel.axvline(orders.order, color=GREY, linewidth=0.9, linestyle="--", zorder=0)
        panel.set(xlabel="order")
        panel.xaxis.get_major_locator().set_params(integer=True)
    axes[1].set_title(f"chosen: {orders.order}", loc="right")
    return axes


_SECTORS = 90  # of a revolution, for its mean


@dataclass(frozen=True, eq=False)
class Orbit(Brief):
    """Orbit of a shaft about its mean position.

    Attributes
    ----------
    xy : (n, 2) array
        Displacements less their means.
    mean : (n_sectors, 2) array
        Mean over the revolutions, from shaft angle 0 on; empty without an angle that turns.
    names : (str, str)
        Names of the two channels.
    unit : str
        Their unit.
    """

    xy: FloatArray
    mean: FloatArray
    names: tuple[str, str]
    unit: str


def orbit_data(
    recording: Recording, signal: str = "p", *, angle: str = "phi", from_s: float = 0.0, to_s: float | None = None
) -> Orbit:
    """Return the orbit of a shaft, for `plot_orbit`.

    Parameters
    ----------
    recording : Recording
        Recording with two displacements.
    signal : str
        Signal with two channels.
    angle : str
        Signal of the shaft angle [rad]. Without it, or when the shaft does not turn, there is no mean.
    from_s, to_s : float
        Time range [s]; to the end when left out.

    Returns
    -------
    Orbit

    Raises
    ------
    UsageError
        When the signal has not two channels, or the range holds no samples.
    """
    values, names, units = select(recording, (signal,))
    if len(names) != 2:
        raise UsageError(f"an orbit needs two channels; {signal!r} of recording {recording.name!r} has {len(names)}")
    first = round(from_s / recording.sample_time)
    last = recording.n_samples if to_s is None else round(to_s / recording.sample_time)
    xy = values[first:last]
    if not 0 <= first < last or len(xy) < 2:
        raise UsageError(
            f"from_s = {from_s:g} to to_s = {to_s}: no samples of recording {recording.name!r} in this range"
        )
    xy = xy - xy.mean(0)
    mean = np.zeros((0, 2))
    if angle in recording.signals:
        turned = recording.signal(angle)[first:last, 0]
        if np.ptp(np.unwrap(turned)) > 4 * np.pi:
            sector = (np.mod(turned, 2 * np.pi) / (2 * np.pi) * _SECTORS).astype(int) % _SECTORS
            counts = np.bincount(sector, minlength=_SECTORS)
            seen = counts > 0  # a clock in step with the shaft leaves sectors without a sample
            mean = np.column_stack([np.bincount(sector, column, _SECTORS)[seen] / counts[seen] for column in xy.T])
    return Orbit(xy, mean, (names[0], names[1]), units[0])


@styled
def plot_orbit(recording: Recording | Orbit, ax: Axes | None = None, *, signal: str = "p") -> Axes:
    """Draw the orbit of a shaft, with the mean over its revolutions and a dot at shaft angle zero.

    Parameters
    ----------
    recording : Recording or Orbit
        Recording with two displacements, or the result of `orbit_data`.
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.
    signal : str
        Signal with two channels.

    Returns
    -------
    matplotlib Axes
        The axes; ``axes.figure`` is the figure.

    Raises
    ------
    UsageError
        When the signal has not two channels.
    """
    data = recording if isinstance(recording, Orbit) else orbit_data(recording, signal)
    factor, unit = unit_label(data.unit)
    _, axes = one_panel(ax, (3.6, 3.6))
    axes.plot(*(factor * data.xy.T), color=GREY, linewidth=0.5)
    if len(data.mean):
        closed = factor * np.vstack([data.mean, data.mean[:1]])
        axes.plot(*closed.T, **series(0, marker=None))
        axes.plot(*closed[0], "o", color=RED, markersize=5)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"{symbol(data.names[0])} [{unit}]", ylabel=f"{symbol(data.names[1])} [{unit}]")
    return axes


_MARKS = (("x", "o"), ("+", "s"), ("1", "^"), ("2", "D"), ("3", "v"))  # poles and zeros of each model


def pole_data(sources: Sources) -> dict[str, PoleZero]:
    """Return poles and zeros of models, for `plot_poles`.

    Parameters
    ----------
    sources : LinearModel or FitResult, sequence of them, or dict of str to them
        The models.

    Returns
    -------
    dict of str to PoleZero
        Poles and zeros with covariances, by label.

    Raises
    ------
    UsageError
        When the models differ in the number of channels.
    """
    return {label: pole_zero(model) for label, model in labelled(sources).items()}


@styled
def plot_poles(sources: Sources, ax: Axes | None = None, *, level: float = LEVEL, zeros: bool = True) -> Axes:
    """Draw poles (crosses) and zeros (open marks) of models, for fits with confidence ellipses.

    Parameters
    ----------
    sources : LinearModel or FitResult, sequence of them, or dict of str to them
        The models.
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.
    level : float
        Probability of the confidence regions.
    zeros : bool
        Whether zeros are drawn.

    Returns
    -------
    matplotlib Axes
        The axes; ``axes.figure`` is the figure.

    Raises
    ------
    UsageError
        When the models differ in the number of channels.
    """
    data = pole_data(sources)
    figure, axes = one_panel(ax, (4.6, 3.6))
    axes.axvline(0.0, color=GREY, linewidth=0.8)
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    for k, (label, roots) in enumerate(data.items()):
        color, (cross, ring) = series(k)["color"], _MARKS[k % len(_MARKS)]
        axes.plot(roots.poles.real, roots.poles.imag, cross, color=color, label=label, markersize=7)
        _ellipses(axes, roots.poles, roots.pole_covariance, level, color)
        if zeros and len(roots.zeros):
            axes.plot(roots.zeros.real, roots.zeros.imag, ring, color=color, markersize=6, fillstyle="none")
            _ellipses(axes, roots.zeros, roots.zero_covariance, level, color)
    axes.set(xlabel="real part [1/s]", ylabel="imaginary part [rad/s]")
    if len(data) > 1:
        legend_above(figure, axes)
    return axes


def _ellipses(axes: Axes, places: ComplexArray, covariance: FloatArray, level: float, color: str) -> None:
    for place, cov in zip(places, covariance, strict=True):
        if np.isfinite(cov).all():
            edge = ellipse(cov, level)
            axes.plot(place.real + edge[:, 0], place.imag + edge[:, 1], color=color, linewidth=0.8)


_HIGHEST = 1.6  # of the threshold, at the top of a panel


@styled
def plot_profile(
    profiles: Profile | Mapping[str, Profile], ax: Axes | Sequence[Axes] | None = None
) -> npt.NDArray[np.object_]:
    """Draw profile likelihoods: likelihood ratio, confidence interval, and parabola of the standard deviation.

    Parameters
    ----------
    profiles : Profile or dict of str to Profile
        Result of `FitResult.profile` or `gbid.profile`.
    ax : matplotlib Axes or sequence of them, optional
        Axes to draw into, one for each profile; a new figure when left out.

    Returns
    -------
    array of matplotlib Axes
        The axes; ``axes[0].figure`` is the figure.
    """
    each = [profiles] if isinstance(profiles, Profile) else list(profiles.values())
    columns = max(1, min(4, len(each)))
    rows = -(-len(each) // columns)
    figure, axes = panels(ax, rows, columns, size=(0.8 + 2.1 * columns, 0.7 + 1.9 * rows))
    for panel in axes[len(each) :]:
        panel.set_visible(False)
    for panel, profile in zip(axes, each, strict=False):
        factor, unit = unit_label(profile.unit)
        shown = profile.ratios <= 2 * _HIGHEST * profile.threshold
        values = factor * profile.values[shown]
        panel.axhline(profile.threshold, color=GREY, linewidth=0.8)
        low, high = (factor * end for end in profile.interval)
        panel.axvspan(max(low, values[0]), min(high, values[-1]), color="0.5", alpha=0.15, linewidth=0)
        if np.isfinite(profile.std):
            grid = np.linspace(values[0], values[-1], 100)
            parabola = ((grid / factor - profile.estimate) / profile.std) ** 2
            panel.plot(grid, parabola, label="standard deviation", **series(1, marker=None))
        panel.plot(values, profile.ratios[shown], label="profile", **series(0, marker="."))
        panel.set(xlabel=f"{symbol(profile.name)} [{unit}]", ylim=(0.0, _HIGHEST * profile.threshold))
        panel.set_title(profile.verdict, loc="right", pad=4)
        panel.xaxis.set_major_locator(MaxNLocator(3))
    axes[0].set_ylabel("likelihood ratio")
    legend_above(figure, axes)
    return axes[: len(each)]


def plot_recursive_fit(result: RecursiveResult, ax: Axes | Sequence[Axes] | None = None) -> npt.NDArray[np.object_]:
    """Draw recursive estimates over time with their 95 % intervals; grey where the dither does not excite.

    Parameters
    ----------
    result : RecursiveResult
        Result of `gbid.RecursiveFit.run`.
    ax : matplotlib Axes or sequence of them, optional
        Axes to draw into, one for each parameter; a new figure when left out.

    Returns
    -------
    array of matplotlib Axes
        The axes; ``axes[0].figure`` is the figure.
    """
    n = len(result.names)
    _, axes = panels(ax, n, 1, size=(TWO_COLUMNS, 0.6 + 1.1 * n))
    for i, (panel, name) in enumerate(zip(axes, result.names, strict=False)):
        factor, unit = unit_label(result.units[i])
        value, width = factor * result.estimates[:, i], quantile(LEVEL) * factor * result.std[:, i]
        color = series(0)["color"]
        for mask, shade in ((result.excited[:, i], color), (~result.excited[:, i], GREY)):
            panel.fill_between(
                result.time_s, value - width, value + width, where=mask, color=shade, alpha=0.25, linewidth=0
            )
        panel.plot(result.time_s, value, color=color)
        panel.set_ylabel(f"{symbol(name)} [{unit}]")
    axes[n - 1].set_xlabel("time [s]")
    return axes[:n]


def response_data(
    sources: Sources, kind: Excited = "step", duration_s: Positive | None = None
) -> dict[str, TimeResponse]:
    """Return step or impulse responses of models on a common time grid, for `plot_step` and `plot_impulse`.

    Parameters
    ----------
    sources : LinearModel or FitResult, sequence of them, or dict of str to them
        The models, all with the same number of inputs and outputs.
    kind : {"step", "impulse"}
        What each input does at time zero.
    duration_s : float, optional
        Time until which responses are computed [s]; by default until the slowest has settled.

    Returns
    -------
    dict of str to TimeResponse
        Responses with standard deviations, by label.

    Raises
    ------
    UsageError
        When the models differ in the number of channels, a model is discrete, or the duration is not positive.
    """
    models = labelled(sources)
    if duration_s is None:
        duration_s = max(float(time_response(m.model, kind).time_s[-1]) for m in models.values())
    return {label: time_response(model, kind, duration_s) for label, model in models.items()}


@styled
def plot_step(
    sources: Sources,
    ax: Axes | npt.ArrayLike | None = None,
    *,
    duration_s: Positive | None = None,
    level: float = LEVEL,
    units: Units = None,
) -> npt.NDArray[np.object_]:
    """Draw the responses of models to a unit step of each input, with confidence bands.

    Parameters
    ----------
    sources : LinearModel or FitResult, sequence of them, or dict of str to them
        The models. Those of a fit have confidence bands.
    ax : array of matplotlib Axes, optional
        Axes with a row for each output and a column for each input; a new figure when left out.
    duration_s : float, optional
        Time until which responses are drawn [s]; by default until the slowest has settled.
    level : float
        Probability of the confidence bands.
    units : dict of str to str, optional
        Unit of each channel by its name; fits of the structures of gbid are in metres.

    Returns
    -------
    (n_outputs, n_inputs) array of matplotlib Axes
        The axes; ``axes[0, 0].figure`` is the figure.

    Raises
    ------
    UsageError
        When there are too few axes, and as for `response_data`.
    """
    return _plot(response_data(sources, "step", duration_s), ax, level, _units(sources, units))


@styled
def plot_impulse(
    sources: Sources,
    ax: Axes | npt.ArrayLike | None = None,
    *,
    duration_s: Positive | None = None,
    level: float = LEVEL,
    units: Units = None,
) -> npt.NDArray[np.object_]:
    """Draw the responses of models to a unit impulse of each input, with confidence bands.

    Parameters
    ----------
    sources : LinearModel or FitResult, sequence of them, or dict of str to them
        The models. Those of a fit have confidence bands.
    ax : array of matplotlib Axes, optional
        Axes with a row for each output and a column for each input; a new figure when left out.
    duration_s : float, optional
        Time until which responses are drawn [s]; by default until the slowest has settled.
    level : float
        Probability of the confidence bands.
    units : dict of str to str, optional
        Unit of each channel by its name; fits of the structures of gbid are in metres.

    Returns
    -------
    (n_outputs, n_inputs) array of matplotlib Axes
        The axes; ``axes[0, 0].figure`` is the figure.

    Raises
    ------
    UsageError
        When there are too few axes, and as for `response_data`.
    """
    return _plot(response_data(sources, "impulse", duration_s), ax, level, _units(sources, units))


def _plot(
    curves: dict[str, TimeResponse], ax: Axes | npt.ArrayLike | None, level: float, units: Mapping[str, str]
) -> npt.NDArray[np.object_]:
    first = next(iter(curves.values()))
    n_y, n_u = first.value.shape[1:]
    size = (TWO_COLUMNS if n_u > 1 else 4.6, 0.8 + 1.8 * n_y)
    figure, flat = panels(ax, n_y, n_u, size=size, sharex=True)
    axes = flat.reshape(n_y, n_u)
    for i, j, panel in channel_pairs(axes, first.output_names, first.input_names):
        panel.axhline(0.0, color=GREY, linewidth=0.7)
        for k, (label, curve) in enumerate(curves.items()):
            style = series(k, marker=None)
            panel.plot(curve.time_s, curve.value[:, i, j], label=label, **style)
            if curve.has_band:
                low, high = (side[:, i, j] for side in curve.band(level))
                band = {"color": style["color"], "alpha": 0.25, "linewidth": 0}
                _label_last_band(panel, panel.fill_between(curve.time_s, low, high, **band), level)
        panel.set_xlim(0.0, first.time_s[-1])
    for panel, output in zip(axes[:, 0], first.output_names, strict=True):
        unit = _gain_unit(units, output, first.input_names, in_a_second=first.kind == "impulse")
        panel.set_ylabel(f"{first.kind} response\n{unit}")
    for panel in axes[-1]:
        panel.set_xlabel("time [s]")
    if len(curves) > 1 or first.has_band:
        legend_above(figure, axes, columns=4)
    return axes
