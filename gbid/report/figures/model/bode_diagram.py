"""Bode diagram of models with confidence bands, and of a measured frequency response over it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from matplotlib.ticker import MaxNLocator

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.identify.curves.bode import LEVEL, Bode, bode, default_grid
from gbid.identify.curves.measured_response import MeasuredResponse
from gbid.identify.curves.uncertain_model import UncertainModel
from gbid.report.figures.canvas import GREY, TWO_COLUMNS, ink, legend_above, panels, series, styled
from gbid.report.figures.model.frequency_axis import frequency_axis
from gbid.report.figures.model.sources import Sources, labelled
from gbid.report.figures.save import symbol

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MEASURED: dict[str, Any] = {"linestyle": "none", "marker": ".", "markersize": 3.0, "color": GREY, "zorder": 1}
_HEIGHTS = {"magnitude": 1.5, "phase": 1.0, "coherence": 0.7}  # inch


def bode_data(sources: Sources, frequency_hz: npt.ArrayLike | None = None) -> dict[str, Bode]:
    """Return the frequency responses of models at the same frequencies, for `plot_bode`.

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
    """Return frequencies that show the poles of all models [Hz]."""
    return np.unique(np.concatenate([default_grid(m.model) for m in models.values()]))


@styled
def plot_bode(
    sources: Sources | MeasuredResponse,
    ax: Axes | npt.ArrayLike | None = None,
    *,
    frequency_hz: npt.ArrayLike | None = None,
    measured: MeasuredResponse | None = None,
    level: float = LEVEL,
) -> npt.NDArray[np.object_]:
    """Draw magnitude and phase of models with confidence bands, and a measured response with its coherence over them.

    Parameters
    ----------
    sources : LinearModel or FitResult, sequence of them, or dict of str to them; or MeasuredResponse
        The models. Those of a fit have confidence bands. A measured response may stand alone.
    ax : array of matplotlib Axes, optional
        Axes with a column for each input, and for each output a row of magnitudes and one of phases; with `measured`
        also one of coherences. A new figure when left out.
    frequency_hz : (n,) array, optional
        Frequencies above zero [Hz]; by default those that show the poles, within the band of the measurement.
    measured : MeasuredResponse, optional
        Result of `gbid.measured_response`. Values with a standard deviation above half their magnitude are left out.
    level : float
        Probability of the confidence bands.

    Returns
    -------
    (n_rows, n_inputs) array of matplotlib Axes
        The axes; ``axes[0, 0].figure`` is the figure.

    Raises
    ------
    UsageError
        When there are too few axes, or when the measurement has other channels than the models.
    """
    shape: Bode | MeasuredResponse
    if isinstance(sources, MeasuredResponse):
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
    kinds = ("magnitude", "phase", "coherence") if measured is not None else ("magnitude", "phase")
    heights = [_HEIGHTS[kind] for kind in kinds] * n_y
    size = (max(TWO_COLUMNS, 2.6 * n_u) if n_u > 1 else 4.6, 0.8 + sum(heights))
    figure, given = panels(
        ax,  # type: ignore[arg-type]
        len(heights),
        n_u,
        size=size,
        sharex=True,
        gridspec_kw={"height_ratios": heights},
    )
    axes = np.array(given[: len(heights) * n_u], dtype=object).reshape(len(heights), n_u)
    for i in range(n_y):
        for j in range(n_u):
            column = axes[len(kinds) * i : len(kinds) * (i + 1), j]
            for k, (label, curve) in enumerate(curves.items()):
                _draw(column[0], column[1], curve, i, j, level, label, series(k, marker=None))
            if measured is not None:
                _draw_measured(column, measured, next(iter(curves.values()), None), i, j)
            column[0].set_title(
                f"{symbol(shape.input_names[j])} to {symbol(shape.output_names[i])}", loc="right", pad=4
            )
            for panel, kind in zip(column, kinds, strict=True):
                if j == 0:
                    panel.set_ylabel("phase [°]" if kind == "phase" else kind)
    for j, panel in enumerate(axes[-1]):
        panel.set_xlabel("frequency [Hz]")
        for each in axes[:, j]:
            frequency_axis(each, shape.frequency_hz[0], shape.frequency_hz[-1])
    if len(curves) + (measured is not None) > 1 or any(curve.has_band for curve in curves.values()):
        legend_above(figure, axes[0, 0], columns=4)
    return axes


def _draw(
    magnitude: Axes, phase: Axes, curve: Bode, i: int, j: int, level: float, label: str, style: dict[str, Any]
) -> None:
    f = curve.frequency_hz
    magnitude.loglog(f, curve.magnitude[:, i, j], label=label, **style)
    phase.semilogx(f, curve.phase_deg[:, i, j], **style)
    _degrees(phase)
    if not curve.has_band:
        return
    band: dict[str, Any] = {"color": style["color"], "alpha": 0.25, "linewidth": 0}
    low, high = (side[:, i, j] for side in curve.magnitude_band(level))
    shown = _within_decades(curve.magnitude[:, i, j])
    magnitude.fill_between(f, np.clip(low, *shown), np.clip(high, *shown), label=f"{100 * level:g} %", **band)
    low, high = (side[:, i, j] for side in curve.phase_band(level))
    middle = curve.phase_deg[:, i, j]
    phase.fill_between(f, np.maximum(low, middle - 180), np.minimum(high, middle + 180), **band)


def _within(measured: MeasuredResponse | None, sources: Sources) -> FloatArray | None:
    """Return frequencies that show the poles of all models within the band of a measurement [Hz]."""
    if measured is None:
        return None
    grid = _common_grid(labelled(sources))
    low, high = measured.frequency_hz[[0, -1]]
    return np.unique(np.concatenate([grid[(grid > low) & (grid < high)], [low, high]]))


def _draw_measured(
    column: npt.NDArray[np.object_], measured: MeasuredResponse, model: Bode | None, i: int, j: int
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
    column[2].semilogx(f, measured.coherence[:, i], color=GREY, linewidth=0.9)
    column[2].set_ylim(0.0, 1.05)


def _degrees(ax: Axes) -> None:
    """Put the ticks of a phase at parts of a turn."""
    ax.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 1.8, 4.5, 9, 10]))


def _within_decades(magnitude: FloatArray) -> tuple[float, float]:
    """Return limits for a band, so that one that is very wide somewhere does not flatten the curve."""
    positive = magnitude[magnitude > 0]
    return (0.01 * float(positive.min()), 100 * float(positive.max())) if len(positive) else (1e-300, 1e300)
