"""Responses of the disc to an impact, with the force (paper, Figs. 22 to 27)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.brief import Brief
from gbid.control.impact.study import ImpactStudy
from gbid.control.impact.validation import ImpactValidation
from gbid.errors import UsageError
from gbid.operating_point import point_label
from gbid.report.figures.canvas import (
    TWO_COLUMNS,
    legend_above,
    letter,
    panels,
    series,
    styled,
)
from gbid.report.figures.named import NamedFigure
from gbid.report.reader import Results

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MICROMETRES = 1e6
_BEFORE = 25  # number of samples shown before an impact


@dataclass(frozen=True, eq=False)
class ImpactCurves(Brief):
    """Responses of the disc to impacts.

    Attributes
    ----------
    time : (n,) array
        Time from the impact [s].
    responses : dict of str to (n,) array
        Positions [m] by label, as ``{"open loop": ..., "closed loop": ...}``.
    forces : dict of str to (n,) array
        Impact forces [N] by label; empty without forces.
    axis : {"x", "y"}
        Axis of the impact.
    title : str
        Title of the figure, as the operating point.
    """

    time: FloatArray
    responses: Mapping[str, FloatArray]
    forces: Mapping[str, FloatArray] = field(default_factory=dict)
    axis: str = "x"
    title: str = ""


@styled
def plot_impact(data: ImpactCurves, ax: Sequence[Axes] | None = None) -> npt.NDArray[np.object_]:
    """Draw impact responses, with the forces below.

    Parameters
    ----------
    data : ImpactCurves
        Data of the figure.
    ax : sequence of matplotlib Axes, optional
        Axes of the responses, and axes of the forces if there are any; a new figure when left out.

    Returns
    -------
    (n_panels,) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.

    Raises
    ------
    UsageError
        When the lengths of a curve and of the time differ.
    """
    for label, curve in (*data.responses.items(), *data.forces.items()):
        if np.shape(curve) != np.shape(data.time):
            raise UsageError(f"curve {label!r} has shape {np.shape(curve)}, the time {np.shape(data.time)}")
    rows = 2 if data.forces else 1
    ratios = {"height_ratios": [2, 1][:rows]}
    size = (TWO_COLUMNS, 1.1 + 1.35 * rows)
    figure, axes = panels(ax, rows, 1, size=size, sharex=True, **ratios)
    labels = list(dict.fromkeys([*data.responses, *data.forces]))
    for curves, panel, scale in ((data.responses, axes[0], _MICROMETRES), (data.forces, axes[rows - 1], 1.0)):
        for label, curve in curves.items():
            style = series(labels.index(label), marker=None, linewidth=1.1)
            panel.plot(1e3 * data.time, scale * curve, label=label, **style)
    axes[0].set_ylabel(f"$p_{data.axis}$ [µm]")
    if data.forces:
        axes[1].set_ylabel("force [N]")
        letter(axes)
    axes[rows - 1].set_xlabel("time [ms]")
    axes[rows - 1].set_xlim(1e3 * data.time[0], 1e3 * data.time[-1])
    figure.align_ylabels(axes)
    legend_above(figure, axes[0], title=data.title)
    return np.array(axes[:rows], dtype=object)


def impact_data(open_loop: ImpactStudy, closed_loop: ImpactStudy, axis: Literal["x", "y"]) -> ImpactCurves:
    """Return the responses to the first impact in open and closed loop, for `plot_impact` (Figs. 22, 23, 26, 27).

    Parameters
    ----------
    open_loop, closed_loop : ImpactStudy
        Impact studies at one operating point.
    axis : {"x", "y"}
        Axis of the impacts.

    Returns
    -------
    ImpactCurves
        Measured positions without their offset, but with unbalance and run-out.

    Raises
    ------
    UsageError
        When a loop has no impact along this axis.
    """
    found = {"open loop": validation_along(open_loop, axis), "closed loop": validation_along(closed_loop, axis)}
    j = "xy".index(axis)
    starts = {label: max(0, v.windows[0][0] - _BEFORE) for label, v in found.items()}
    first = found["open loop"]
    length = min(first.windows[0][1] - starts["open loop"], *(_until_next(v) - starts[k] for k, v in found.items()))
    parts = {label: slice(start, start + length) for label, start in starts.items()}
    return ImpactCurves(
        first.time[parts["open loop"]] - first.time[first.windows[0][0]],
        {label: v.measured[parts[label], j] for label, v in found.items()},
        {label: v.force[parts[label], j] for label, v in found.items()},
        axis,
        point_label(open_loop.conditions["pressure_bar"], open_loop.conditions["speed_rpm"]),
    )


def impact_validation_data(study: ImpactStudy, axis: Literal["x", "y"]) -> ImpactCurves:
    """Return measured and simulated response to the first impact, for `plot_impact` (Figs. 24, 25).

    Parameters
    ----------
    study : ImpactStudy
        Impact study.
    axis : {"x", "y"}
        Axis of the impacts.

    Returns
    -------
    ImpactCurves
        Responses without unbalance and run-out.

    Raises
    ------
    UsageError
        When the study has no impact along this axis.
    """
    v, j = validation_along(study, axis), "xy".index(axis)
    part = slice(max(0, v.windows[0][0] - _BEFORE), v.windows[0][1])
    place = point_label(study.conditions["pressure_bar"], study.conditions["speed_rpm"])
    measured = v.measured[part, j] - v.stationary[part, j]
    return ImpactCurves(
        v.time[part] - v.time[v.windows[0][0]],
        {"measured": measured, "simulated": v.simulated[part, j]},
        {},
        axis,
        f"{place}, {study.loop} loop, fit over all impacts {v.along_percent:.1f} %",
    )


def validation_along(study: ImpactStudy, axis: str) -> ImpactValidation:
    """Return the validation of the recording with impacts along an axis.

    Raises
    ------
    UsageError
        When the study has none.
    """
    for validation in study.validations:
        if validation.axis == axis:
            return validation
    there = ", ".join(v.axis for v in study.validations) or "none"
    raise UsageError(f"no impact along {axis} in {study.loop} loop; there is {there}")


def _until_next(validation: ImpactValidation) -> int:
    """Return the sample at which the second impact begins, or the end."""
    return validation.windows[1][0] if len(validation.windows) > 1 else len(validation.time)


def _both_loops(axis: Literal["x", "y"], rotating: bool, results: Results) -> ImpactCurves:
    loops = results.impacts_at(rotating)
    return impact_data(loops["open"], loops["closed"], axis)


def _validated(axis: Literal["x", "y"], results: Results) -> ImpactCurves:
    return impact_validation_data(results.impacts_at(False)["closed"], axis)


FIGURES = (
    NamedFigure("fig22_impact_x", partial(_both_loops, "x", False), plot_impact),
    NamedFigure("fig23_impact_y", partial(_both_loops, "y", False), plot_impact),
    NamedFigure("fig24_impact_model_x", partial(_validated, "x"), plot_impact),
    NamedFigure("fig25_impact_model_y", partial(_validated, "y"), plot_impact),
    NamedFigure("fig26_impact_turning_x", partial(_both_loops, "x", True), plot_impact),
    NamedFigure("fig27_impact_turning_y", partial(_both_loops, "y", True), plot_impact),
)
