"""Step and impulse responses of models with confidence bands."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from gbid.identify.curves.bode import LEVEL
from gbid.identify.curves.time_response import Excited, TimeResponse, time_response
from gbid.report.figures.canvas import GREY, TWO_COLUMNS, legend_above, panels, series, styled
from gbid.report.figures.model.sources import Sources, labelled
from gbid.report.figures.save import symbol

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def response_data(sources: Sources, kind: Excited = "step", duration_s: float | None = None) -> dict[str, TimeResponse]:
    """Return step or impulse responses of models over the same time, for `plot_step` and `plot_impulse`.

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
    duration_s: float | None = None,
    level: float = LEVEL,
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

    Returns
    -------
    (n_outputs, n_inputs) array of matplotlib Axes
        The axes; ``axes[0, 0].figure`` is the figure.

    Raises
    ------
    UsageError
        When there are too few axes, and as for `response_data`.
    """
    return _plot(response_data(sources, "step", duration_s), ax, level)


@styled
def plot_impulse(
    sources: Sources,
    ax: Axes | npt.ArrayLike | None = None,
    *,
    duration_s: float | None = None,
    level: float = LEVEL,
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

    Returns
    -------
    (n_outputs, n_inputs) array of matplotlib Axes
        The axes; ``axes[0, 0].figure`` is the figure.

    Raises
    ------
    UsageError
        When there are too few axes, and as for `response_data`.
    """
    return _plot(response_data(sources, "impulse", duration_s), ax, level)


def _plot(curves: dict[str, TimeResponse], ax: Axes | npt.ArrayLike | None, level: float) -> npt.NDArray[np.object_]:
    first = next(iter(curves.values()))
    n_y, n_u = first.value.shape[1:]
    size = (TWO_COLUMNS if n_u > 1 else 4.6, 0.8 + 1.8 * n_y)
    figure, given = panels(ax, n_y, n_u, size=size, sharex=True)  # type: ignore[arg-type]
    axes = np.array(given[: n_y * n_u], dtype=object).reshape(n_y, n_u)
    for i in range(n_y):
        for j in range(n_u):
            panel = axes[i, j]
            panel.axhline(0.0, color=GREY, linewidth=0.7)
            for k, (label, curve) in enumerate(curves.items()):
                style = series(k, marker=None)
                panel.plot(curve.time_s, curve.value[:, i, j], label=label, **style)
                if curve.has_band:
                    low, high = (side[:, i, j] for side in curve.band(level))
                    band = {"color": style["color"], "alpha": 0.25, "linewidth": 0}
                    panel.fill_between(curve.time_s, low, high, label=f"{100 * level:g} %", **band)
            panel.set_title(f"{symbol(first.input_names[j])} to {symbol(first.output_names[i])}", loc="right", pad=4)
            panel.set_xlim(0.0, first.time_s[-1])
            if j == 0:
                panel.set_ylabel(f"{first.kind} response")
    for panel in axes[-1]:
        panel.set_xlabel("time [s]")
    if len(curves) > 1 or first.has_band:
        legend_above(figure, axes[0, 0], columns=4)
    return axes
