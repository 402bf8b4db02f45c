"""Poles and zeros of models with confidence ellipses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gbid.arrays import ComplexArray, FloatArray
from gbid.identify.curves.bode import LEVEL
from gbid.identify.curves.pole_zero import PoleZero, ellipse, pole_zero
from gbid.report.figures.canvas import GREY, legend_above, panels, series, styled
from gbid.report.figures.model.sources import Sources, labelled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
    """Draw poles (crosses) and zeros (open marks) of models, with the confidence ellipses of those of a fit.

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
    figure, (axes, *_) = panels(ax, size=(4.6, 3.6))
    axes.axvline(0.0, color=GREY, linewidth=0.8)
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    for k, (label, found) in enumerate(data.items()):
        color, (cross, ring) = series(k)["color"], _MARKS[k % len(_MARKS)]
        axes.plot(found.poles.real, found.poles.imag, cross, color=color, label=label, markersize=7)
        _ellipses(axes, found.poles, found.pole_covariance, level, color)
        if zeros and len(found.zeros):
            axes.plot(found.zeros.real, found.zeros.imag, ring, color=color, markersize=6, fillstyle="none")
            _ellipses(axes, found.zeros, found.zero_covariance, level, color)
    axes.set_xlabel("real part [1/s]")
    axes.set_ylabel("imaginary part [rad/s]")
    if len(data) > 1:
        legend_above(figure, axes)
    return axes


def _ellipses(axes: Axes, places: ComplexArray, covariance: FloatArray, level: float, color: str) -> None:
    for place, cov in zip(places, covariance, strict=True):
        if np.isfinite(cov).all():
            edge = ellipse(cov, level)
            axes.plot(place.real + edge[:, 0], place.imag + edge[:, 1], color=color, linewidth=0.8)
