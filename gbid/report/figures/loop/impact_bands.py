"""Impact responses of several loops: mean and standard deviation over the impacts, along x and along y."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

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
from gbid.report.figures.loop.impact_curves import validation_along
from gbid.report.figures.named import NamedFigure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MICROMETRES = 1e6
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
    found = list(studies.values())
    steps = [float(v.time[1] - v.time[0]) for study in found for v in study.validations]
    if not steps or any(s.conditions != found[0].conditions for s in found) or np.ptp(steps) > 1e-9:
        raise UsageError("loops to be compared need impacts at one operating point, sampled alike")
    before = round(_BEFORE_S / steps[0])
    after = round(duration_s / steps[0])
    for study in found:
        for v in study.validations:
            ends = [*(start for start, _ in v.windows[1:]), len(v.time)]
            after = min(after, *(end - start for (start, _), end in zip(v.windows, ends, strict=True)))
            before = min(before, v.windows[0][0])
    parts = {label: _averaged(study, before, after) for label, study in studies.items()}
    point = found[0].conditions
    return ImpactLoops(
        np.asarray(steps[0] * np.arange(-before, after)),
        {label: mean for label, (mean, _) in parts.items()},
        {label: spread for label, (_, spread) in parts.items()},
        point_label(point["pressure_bar"], point["speed_rpm"]),
    )


def _averaged(study: ImpactStudy, before: int, after: int) -> tuple[FloatArray, FloatArray]:
    mean, spread = np.full((2, before + after, 2), np.nan)
    for j, axis in enumerate("xy"):
        if any(v.axis == axis for v in study.validations):
            impacts = _cut(validation_along(study, axis), j, before, after)
            mean[:, j], spread[:, j] = impacts.mean(axis=0), impacts.std(axis=0, ddof=min(1, len(impacts) - 1))
    return mean, spread


def _cut(v: ImpactValidation, j: int, before: int, after: int) -> FloatArray:
    moved = v.measured[:, j] - v.stationary[:, j]
    return np.array([moved[start - before : start + after] for start, _ in v.windows])


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
        for j, panel in enumerate(axes[:2]):
            middle, half = _MICROMETRES * mean[:, j], _MICROMETRES * data.spread[label][:, j]
            panel.fill_between(1e3 * data.time, middle - half, middle + half, color=style["color"], alpha=0.2, lw=0)
            panel.plot(1e3 * data.time, middle, label=label, **style)
    for j, axis in enumerate("xy"):
        axes[j].set_ylabel(f"$p_{axis}$, impact along {axis} [µm]")
    letter(axes[:2])
    axes[1].set_xlabel("time [ms]")
    axes[1].set_xlim(1e3 * data.time[0], 1e3 * data.time[-1])
    figure.align_ylabels(axes[:2])
    legend_above(figure, axes[0], title=data.title)
    return np.array(axes[:2], dtype=object)


def _drawn(loops: Mapping[str, ImpactStudy]) -> npt.NDArray[np.object_]:
    return plot_impact_loops(impact_loops_data(loops))


FIGURES = (
    NamedFigure("designs_impacts", lambda results: results.beside_at(False), _drawn),
    NamedFigure("designs_impacts_turning", lambda results: results.beside_at(True), _drawn),
)
