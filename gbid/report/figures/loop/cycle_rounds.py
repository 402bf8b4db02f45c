"""Identification-for-control cycle: damping and certainty over the rounds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from gbid.errors import DataError
from gbid.experiment.stages.cycle.rows import CycleRow
from gbid.operating_point import point_label
from gbid.report.figures.canvas import GREY, TWO_COLUMNS, letter, panels, series, styled
from gbid.report.figures.named import NamedFigure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_INTERVAL = 1.96  # standard deviations of an interval of 95 %
_APART = 0.06  # of the points of one round, so that their intervals do not cover each other


@styled
def plot_cycle(rows: Sequence[CycleRow], ax: Sequence[Axes] | None = None) -> Axes:
    """Draw what each round of a cycle gains: damping of the loop measured by impacts, and certainty of the model.

    Parameters
    ----------
    rows : sequence of CycleRow
        Rounds and operating points.
    ax : sequence of matplotlib Axes, optional
        Two axes to draw into; a new figure when left out.

    Returns
    -------
    matplotlib Axes
        The first axes; ``axes.figure`` is the figure.

    Raises
    ------
    DataError
        When there are no rows.
    """
    if not rows:
        raise DataError("no rounds of a cycle; run `gbid cycle` or `gbid run`")
    _, (damping, certainty, *_) = panels(ax, 1, 2, size=(TWO_COLUMNS, 2.9))
    points = list(dict.fromkeys((row.pressure_bar, row.speed_rpm) for row in rows))
    for i, point in enumerate(points):
        own = [row for row in rows if (row.pressure_bar, row.speed_rpm) == point]
        at = np.array([row.round for row in own])
        look = series(i)
        away = _APART * (i - (len(points) - 1) / 2)
        reached, std = np.array([row.reached for row in own]).T
        bars = {**look, "linestyle": "none", "capsize": 2.5, "elinewidth": 0.9}
        damping.errorbar(at + away, reached, _INTERVAL * std, label=point_label(*point), **bars)
        expected = [row.expected_damping for row in own]
        line = {**look, "marker": None, "linewidth": 0.8}
        damping.plot(at + away, expected, **line)
        first = own[0]
        for name, mark in (("damping", "full"), ("frequency", "none")):
            stds = [_relative(row, name) / _relative(first, name) for row in own]
            certainty.plot(at + away, stds, **{**look, "fillstyle": mark}, label=f"{name}, {point_label(*point)}")
    promised = {row.round: row.promised_damping for row in rows}
    damping.plot(list(promised), list(promised.values()), color=GREY, linewidth=0.8, label="promised by the design")
    damping.set_ylabel("smallest damping factor [-]")
    certainty.set_ylabel("std of the model, round 0 = 1 [-]")
    certainty.set_ylim(bottom=0)
    for panel in (damping, certainty):
        panel.set_xlabel("round")
        panel.set_xticks(sorted(promised))
        panel.legend(loc="best", fontsize="small")
    letter((damping, certainty))
    return damping


def _relative(row: CycleRow, name: str) -> float:
    """Return the root mean square of the standard deviations of both modes of the bearing."""
    if name == "damping":
        return float(np.hypot(row.model_damping_1_std, row.model_damping_2_std))
    return float(np.hypot(row.model_frequency_1_hz_std, row.model_frequency_2_hz_std))


FIGURES = (
    NamedFigure(
        "cycle",
        lambda results: results.cycle,
        plot_cycle,
        words="Rounds of the cycle: smallest damping of the loop on the rig with 95 % intervals, lines as expected "
        "from the surfaces of the round; standard deviations of the modes of the bearing, relative to round 0",
        section="cycle",
    ),
)
