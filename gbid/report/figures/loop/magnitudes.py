"""Magnitudes over frequency: sensitivities and Bode magnitudes of the loop (paper, Figs. 20 and 21)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from gbid.arrays import ComplexArray, FloatArray
from gbid.brief import Brief
from gbid.control import sensitivity_data
from gbid.errors import UsageError
from gbid.operating_point import point_label
from gbid.report.figures.canvas import (
    GREY,
    TWO_COLUMNS,
    legend_above,
    letter,
    panels,
    series,
    styled,
)
from gbid.report.figures.named import NamedFigure
from gbid.report.figures.save import symbol
from gbid.report.reader import Results
from gbid.report.reader.published import published_controller, published_gains, shown_point

if TYPE_CHECKING:
    from gbid.control import SensitivityData

_RANGE_DB = 90.0


@dataclass(frozen=True, eq=False)
class MagnitudeCurves(Brief):
    """Frequency responses of several transfer functions, with a panel for each pair of channels.

    Attributes
    ----------
    frequency_hz : (n,) array
        Frequencies [Hz].
    responses : dict of str to (n, n_outputs, n_inputs) complex array
        Frequency responses by label of the legend.
    output_names, input_names : tuple of str
        Names of the channels.
    title : str
        Title of the figure, as operating point and controller.
    """

    frequency_hz: FloatArray
    responses: Mapping[str, ComplexArray]
    output_names: tuple[str, ...]
    input_names: tuple[str, ...]
    title: str = ""


def sensitivity_curves(data: SensitivityData, title: str = "") -> MagnitudeCurves:
    """Return the sensitivities ``S_o`` and ``K_pl S_o`` of a loop (Fig. 20).

    Parameters
    ----------
    data : SensitivityData
        Result of `gbid.control.sensitivity_data`.
    title : str
        Title of the figure, as operating point and controller.

    Returns
    -------
    MagnitudeCurves
        Frequency responses.
    """
    curves = {"output sensitivity $S_o$": data.output, "controller sensitivity $K_{pl} S_o$": data.control}
    return MagnitudeCurves(data.frequency_hz, curves, data.output_names, data.output_names, title)


def bode_curves(data: SensitivityData, title: str = "") -> MagnitudeCurves:
    """Return the transfer functions ``G`` of the open loop and ``S_o G`` of the closed loop (Fig. 21).

    Parameters
    ----------
    data : SensitivityData
        Result of `gbid.control.sensitivity_data`.
    title : str
        Title of the figure, as operating point and controller.

    Returns
    -------
    MagnitudeCurves
        Frequency responses.
    """
    curves = {"open loop $G$": data.open_loop, "closed loop $S_o G$": data.plant}
    return MagnitudeCurves(data.frequency_hz, curves, data.output_names, data.input_names, title)


@styled
def plot_magnitudes(data: MagnitudeCurves, ax: npt.ArrayLike | None = None) -> npt.NDArray[np.object_]:
    """Draw magnitudes over frequency, in decibels relative to 1 m/m.

    Parameters
    ----------
    data : MagnitudeCurves
        Data of `sensitivity_curves` or `bode_curves`.
    ax : array of matplotlib Axes, optional
        Axes with a row for each output and a column for each input; a new figure when left out.

    Returns
    -------
    (n_outputs, n_inputs) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.

    Raises
    ------
    UsageError
        When the shape of a response does not fit the channels and frequencies.
    """
    shape = (len(data.frequency_hz), len(data.output_names), len(data.input_names))
    for label, response in data.responses.items():
        if response.shape != shape:
            raise UsageError(f"response {label!r} has shape {response.shape}, expected {shape}")
    rows, columns = shape[1:]
    size = (TWO_COLUMNS, 0.7 + 1.9 * rows)
    figure, axes = panels(ax, rows, columns, size=size, sharex=True, sharey=True)  # type: ignore[arg-type]
    for i, output in enumerate(data.output_names):
        for j, source in enumerate(data.input_names):
            panel = axes[columns * i + j]
            panel.axhline(0.0, color=GREY, linewidth=0.7)
            for k, (label, response) in enumerate(data.responses.items()):
                with np.errstate(divide="ignore"):
                    level = 20 * np.log10(np.abs(response[:, i, j]))
                level = np.where(np.isfinite(level), level, np.nan)
                panel.semilogx(data.frequency_hz, level, label=label, **series(k, marker=None))
            panel.set_title(f"{symbol(source)} to {symbol(output)}", loc="right", pad=4)
            panel.set_xlim(data.frequency_hz[0], data.frequency_hz[-1])
            if j == 0:
                panel.set_ylabel("magnitude [dB re 1 m/m]")
            if i == rows - 1:
                panel.set_xlabel("frequency [Hz]")
    with np.errstate(divide="ignore"):
        top = 10 * np.ceil(max(2 * np.log10(np.abs(response).max()) for response in data.responses.values()))
    axes[0].set_ylim(top - _RANGE_DB, top + 3)
    letter(axes)
    legend_above(figure, axes[0], title=data.title)
    return np.array(axes[: rows * columns], dtype=object).reshape(rows, columns)


def _loop(
    curves: Callable[[SensitivityData, str], MagnitudeCurves],
    results: Results,
) -> MagnitudeCurves:
    """Return curves of the identified model in the loop with the published controller."""
    point = shown_point(results.identified)
    plant, d = results.identified.plant_at(*point), published_gains(results.machine)
    gains = f"$\\kappa_x$ = {d.kappa_x:g}, $\\kappa_y$ = {d.kappa_y:g} m/m, low-pass {d.lowpass_hz:g} Hz"
    data = sensitivity_data(plant, published_controller(results.machine))
    return curves(data, f"{point_label(*point)}; {gains}")


FIGURES = (
    NamedFigure("fig20_sensitivities", partial(_loop, sensitivity_curves), plot_magnitudes),
    NamedFigure("fig21_bode", partial(_loop, bode_curves), plot_magnitudes),
)
