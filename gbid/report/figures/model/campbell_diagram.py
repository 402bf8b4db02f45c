"""Campbell diagram: natural frequencies over speed with their uncertainty, and the orders of the rotation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gbid.arrays import FloatArray
from gbid.brief import Brief
from gbid.errors import UsageError
from gbid.identify.curves.bode import LEVEL, quantile
from gbid.identify.curves.pole_zero import pole_zero
from gbid.identify.curves.uncertain_model import ModelLike
from gbid.poles import one_of_each_pair
from gbid.report.figures.canvas import GREY, panels, series, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False)
class Campbell(Brief):
    """Natural frequencies of models over speed.

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
    rows = []
    for speed in speeds:
        found = pole_zero(models[speed])
        keep = np.flatnonzero(one_of_each_pair(found.poles))
        poles = found.poles[keep]
        towards = np.column_stack([poles.real, poles.imag]) / np.abs(poles)[:, None]
        variance = np.einsum("ia,iab,ib->i", towards, found.pole_covariance[keep], towards)
        rows.append((np.abs(poles) / (2 * np.pi), np.sqrt(variance) / (2 * np.pi), -poles.real / np.abs(poles)))
    most = max(len(row[0]) for row in rows)
    columns = np.full((3, len(rows), most), np.nan)
    for i, row in enumerate(rows):
        columns[:, i, : len(row[0])] = row
    return Campbell(np.array(speeds, float), *columns)


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
    _, (axes, *_) = panels(ax, size=(4.6, 3.4))
    for k, column in enumerate(data.frequency_hz.T):
        style = series(k)
        half = quantile(level) * data.std_hz[:, k]
        axes.errorbar(
            data.speed_rpm,
            column,
            yerr=np.where(np.isfinite(half), half, 0.0),
            capsize=2,
            markersize=4,
            clip_on=False,
            **style,
        )
    top = 1.15 * float(np.nanmax(data.frequency_hz)) if np.isfinite(data.frequency_hz).any() else 1.0
    last = float(data.speed_rpm[-1])
    for order in orders:
        axes.plot([0, last], [0, order * last / 60], color=GREY, linewidth=0.9, zorder=0)
        at = min(last, 60 * top / order) if order else last
        axes.annotate(f"{order:g}X", (0.97 * at, 0.97 * order * at / 60), alpha=0.7, ha="right", va="bottom")
    axes.set_ylim(0.0, top)
    axes.set_xlim(min(0.0, float(data.speed_rpm[0])), 1.02 * last if last > 0 else 1.0)
    axes.set_xlabel("speed [rpm]")
    axes.set_ylabel("natural frequency [Hz]")
    return axes
