"""Picture of a value: which picture function belongs to which type."""

from __future__ import annotations

from contextlib import nullcontext
from functools import singledispatch
from typing import Any

from gbid.control import Sensitivities
from gbid.errors import UsageError
from gbid.identify import FitResult
from gbid.identify.curves.measured_response import MeasuredResponse
from gbid.recording import Recording
from gbid.report.figures.canvas import shown_by_pyplot
from gbid.report.figures.measured.recording_panels import plot_recording
from gbid.report.figures.measured.residual_panels import plot_residuals
from gbid.report.figures.measured.response import plot_response
from gbid.report.figures.model.bode_diagram import plot_bode
from gbid.report.figures.model.iso_diagram import plot_iso_zones
from gbid.structure import LinearModel
from gbid.validate import ResidualTest, Validation


@singledispatch
def plot(value: Any, ax: Any = None, **options: Any) -> Any:  # noqa: ARG001
    """Draw the picture that belongs to a value.

    The method ``plot`` of these values does the same. Its figure belongs to ``matplotlib.pyplot``, so that notebooks
    and ``plt.show()`` show it. Pictures of this function leave nothing behind.

    ======================================  ==================
    value                                   drawn by
    ======================================  ==================
    Recording                               `plot_recording`
    LinearModel, FitResult                  `plot_bode`
    MeasuredResponse                        `plot_bode`
    Validation                              `plot_response`
    ResidualTest                            `plot_residuals`
    Sensitivities                           `plot_iso_zones`
    ======================================  ==================

    Parameters
    ----------
    value : one of the types above
        What to draw.
    ax : matplotlib Axes or array of them, optional
        Axes to draw into; a new figure when left out.
    **options
        Options of the function that draws.

    Returns
    -------
    matplotlib Axes or array of them
        The axes; their ``figure`` is the figure.

    Raises
    ------
    UsageError
        When no picture belongs to the type.
    """
    known = ", ".join(sorted(kind.__name__ for kind in plot.registry if kind is not object))
    raise UsageError(f"no picture belongs to {type(value).__name__}; there is one for {known}")


def shown(value: Any, ax: Any = None, **options: Any) -> Any:
    """Draw the picture that belongs to a value; a new figure belongs to pyplot, so that a notebook shows it."""
    with shown_by_pyplot() if ax is None else nullcontext():
        return plot(value, ax, **options)


plot.register(Recording, plot_recording)
plot.register(LinearModel, plot_bode)
plot.register(FitResult, plot_bode)
plot.register(MeasuredResponse, plot_bode)
plot.register(Validation, plot_response)
plot.register(ResidualTest, plot_residuals)
plot.register(Sensitivities, plot_iso_zones)
