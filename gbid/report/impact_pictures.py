"""Figures of impact responses: measured and simulated, and of several loops with mean and standard deviation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from gbid.control.impact.study import ImpactStudy, ImpactValidation
from gbid.core.arrays import FloatArray
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.report.canvas import TWO_COLUMNS, legend_above, letter, panels, series, styled
from gbid.report.read import place_of

_MICROMETRES = 1e6


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
    """Draw impact responses of the disc, with the forces below.

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
    size = (TWO_COLUMNS, 1.1 + 1.35 * rows)
    figure, axes = panels(ax, rows, 1, size=size, sharex=True, height_ratios=[2, 1][:rows])
    labels = list(dict.fromkeys([*data.responses, *data.forces]))
    for curves, panel, scale in ((data.responses, axes[0], _MICROMETRES), (data.forces, axes[-1], 1.0)):
        for label, curve in curves.items():
            style = series(labels.index(label), marker=None, linewidth=1.1)
            panel.plot(1e3 * data.time, scale * curve, label=label, **style)
    axes[0].set_ylabel(f"$p_{data.axis}$ [µm]")
    if data.forces:
        axes[1].set_ylabel("force [N]")
        letter(axes)
    axes[-1].set(xlabel="time [ms]", xlim=(1e3 * data.time[0], 1e3 * data.time[-1]))
    figure.align_ylabels(axes)
    legend_above(figure, axes, title=data.title)
    return axes


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
    validations = {"open loop": validation_along(open_loop, axis), "closed loop": validation_along(closed_loop, axis)}
    j = "xy".index(axis)
    starts = {label: v.shown.start for label, v in validations.items()}
    first = validations["open loop"]
    # Up to the second impact, or to the end.
    ends = {k: v.windows[1][0] if len(v.windows) > 1 else len(v.time) for k, v in validations.items()}
    length = min(first.shown.stop - starts["open loop"], *(ends[k] - starts[k] for k in starts))
    parts = {label: slice(start, start + length) for label, start in starts.items()}
    return ImpactCurves(
        first.time[parts["open loop"]] - first.time[first.windows[0][0]],
        {label: v.measured[parts[label], j] for label, v in validations.items()},
        {label: v.force[parts[label], j] for label, v in validations.items()},
        axis,
        place_of(open_loop.conditions),
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
    part = v.shown
    measured = v.measured[part, j] - v.stationary[part, j]
    return ImpactCurves(
        v.time[part] - v.time[v.windows[0][0]],
        {"measured": measured, "simulated": v.simulated[part, j]},
        {},
        axis,
        f"{place_of(study.conditions)}, {study.loop} loop, fit over all impacts {v.along_percent:.1f} %",
    )


def validation_along(study: ImpactStudy, axis: str) -> ImpactValidation:
    """Return the validation of the recording whose impacts are along a given axis.

    Raises
    ------
    UsageError
        When the study has none.
    """
    for validation in study.validations:
        if validation.axis == axis:
            return validation
    axes = ", ".join(v.axis for v in study.validations) or "none"
    raise UsageError(f"no impact along {axis} in {study.loop} loop; choose from {axes}")


_BEFORE_S = 5e-3


@dataclass(frozen=True, eq=False)
class ImpactLoops(Brief):
    """Mean responses of several loops to impacts.

    Attributes
    ----------
    time : (n,) array
        Time from the impact [s].
    mean, spread : dict of str to (n, 2) array
        Mean and standard deviation of the position along the impact [m], by loop. The first column is x after impacts
        along x, the second y after impacts along y; nan for an axis without impacts.
    title : str
        Title of the figure.
    """

    time: FloatArray
    mean: Mapping[str, FloatArray]
    spread: Mapping[str, FloatArray]
    title: str = ""


def impact_loops_data(studies: Mapping[str, ImpactStudy], duration_s: float = 0.05) -> ImpactLoops:
    """Return mean and standard deviation of the impact responses of each loop, for `plot_impact_loops`.

    Parameters
    ----------
    studies : dict of str to ImpactStudy
        Impact studies at one operating point, by the label of the loop.
    duration_s : float
        Time shown after an impact [s]; it is shorter when the next impact comes earlier.

    Returns
    -------
    ImpactLoops
        Responses without unbalance and run-out.

    Raises
    ------
    UsageError
        When there are no studies, or when their operating points or sample times differ.
    """
    compared = list(studies.values())
    steps = [float(v.time[1] - v.time[0]) for study in compared for v in study.validations]
    if not steps or any(s.conditions != compared[0].conditions for s in compared) or np.ptp(steps) > 1e-9:
        raise UsageError("compared loops must have the same operating point and sample time")
    before = round(_BEFORE_S / steps[0])
    after = round(duration_s / steps[0])
    for study in compared:
        for v in study.validations:
            ends = [*(start for start, _ in v.windows[1:]), len(v.time)]
            after = min(after, *(end - start for (start, _), end in zip(v.windows, ends, strict=True)))
            before = min(before, v.windows[0][0])
    parts = {label: _averaged(study, before, after) for label, study in studies.items()}
    return ImpactLoops(
        np.asarray(steps[0] * np.arange(-before, after)),
        {label: mean for label, (mean, _) in parts.items()},
        {label: spread for label, (_, spread) in parts.items()},
        place_of(compared[0].conditions),
    )


def _averaged(study: ImpactStudy, before: int, after: int) -> tuple[FloatArray, FloatArray]:
    mean, spread = np.full((2, before + after, 2), np.nan)
    for j, axis in enumerate("xy"):
        if any(v.axis == axis for v in study.validations):
            v = validation_along(study, axis)
            motion = v.measured[:, j] - v.stationary[:, j]
            impacts = np.array([motion[start - before : start + after] for start, _ in v.windows])
            mean[:, j], spread[:, j] = impacts.mean(axis=0), impacts.std(axis=0, ddof=min(1, len(impacts) - 1))
    return mean, spread


@styled
def plot_impact_loops(data: ImpactLoops, ax: Sequence[Axes] | None = None) -> npt.NDArray[np.object_]:
    """Draw the impact responses of several loops, along x above and along y below.

    Parameters
    ----------
    data : ImpactLoops
        Data of the figure.
    ax : sequence of two matplotlib Axes, optional
        Axes to draw into; a new figure when left out.

    Returns
    -------
    (2,) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.
    """
    figure, axes = panels(ax, 2, 1, size=(TWO_COLUMNS, 4.4), sharex=True)
    for k, (label, mean) in enumerate(data.mean.items()):
        style = series(k, marker=None, linewidth=1.2)
        for j, panel in enumerate(axes):
            middle, half = _MICROMETRES * mean[:, j], _MICROMETRES * data.spread[label][:, j]
            panel.fill_between(1e3 * data.time, middle - half, middle + half, color=style["color"], alpha=0.2, lw=0)
            panel.plot(1e3 * data.time, middle, label=label, **style)
    for axis, panel in zip("xy", axes, strict=True):
        panel.set_ylabel(f"$p_{axis}$, impact along {axis} [µm]")
    letter(axes)
    axes[1].set(xlabel="time [ms]", xlim=(1e3 * data.time[0], 1e3 * data.time[-1]))
    figure.align_ylabels(axes)
    legend_above(figure, axes, title=data.title)
    return axes
