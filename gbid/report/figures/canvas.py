"""What all figures share: style, sizes for a two-column report, lines that are told apart in grey, units in labels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from gbid.errors import UsageError
from gbid.report.figures.save import STYLE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

P = ParamSpec("P")
R = TypeVar("R")

ONE_COLUMN, TWO_COLUMNS = 3.35, 6.9
"""Widths of a figure in a report of two columns [inch]."""

BLACK, BLUE, RED, GREEN, PINK, GREY = "#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#9e9e9e"
"""Colours that are safe for colour-blind readers (Okabe and Ito), and a grey."""

SERIES: tuple[dict[str, Any], ...] = (
    {"color": BLACK, "linestyle": "-", "marker": "o"},
    {"color": RED, "linestyle": (0, (5, 1.5)), "marker": "s"},
    {"color": BLUE, "linestyle": (0, (1, 1)), "marker": "^"},
    {"color": GREEN, "linestyle": "-.", "marker": "D"},
    {"color": PINK, "linestyle": (0, (7, 1.5, 1, 1.5, 1, 1.5)), "marker": "v"},
)
"""Styles of curves that belong together: each has its own colour, dashes and marker."""


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Let a function draw in the style of gbid, without a trace in matplotlib's settings."""

    @wraps(draw)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        with mpl.rc_context(fname=STYLE):
            return draw(*args, **kwargs)

    return wrapper


def panels(
    ax: Axes | Sequence[Axes] | None,
    rows: int = 1,
    columns: int = 1,
    *,
    size: tuple[float, float],
    **options: Any,
) -> tuple[Figure, list[Axes]]:
    """Take the axes that were given, or make a figure with panels.

    Parameters
    ----------
    ax : matplotlib Axes, sequence of them, or None
        To draw into; None makes a figure.
    rows, columns : int
    size : (width, height)
        Of a new figure [inch].
    **options
        For ``Figure.subplots``.

    Returns
    -------
    figure : matplotlib.figure.Figure
    axes : list of matplotlib Axes
        By rows.

    Raises
    ------
    UsageError
        When the axes that were given are too few.
    """
    if ax is None:
        figure = Figure(figsize=size, layout="constrained")
        return figure, list(figure.subplots(rows, columns, squeeze=False, **options).ravel())
    given = list(np.ravel(np.array(ax, dtype=object)))
    if len(given) < rows * columns:
        raise UsageError(f"{len(given)} axes for {rows * columns} panels; give one for each, or none")
    figure = given[0].figure
    while not isinstance(figure, Figure):  # axes in a subfigure
        figure = figure.figure
    return figure, given


def series(i: int, **changes: Any) -> dict[str, Any]:
    """Style of the i-th of several curves; one that is changed to None is left out."""
    style = {**SERIES[i % len(SERIES)], **changes}
    return {key: value for key, value in style.items() if value is not None}


def letter(axes: Sequence[Axes]) -> None:
    """Name the panels a), b), ... above their left ends."""
    for ax, name in zip(axes, "abcdefghijkl", strict=False):
        ax.set_title(f"{name})", loc="left", pad=4)


def legend_above(figure: Figure, ax: Axes, columns: int = 6, title: str = "") -> None:
    """Put one legend for all panels above them, where it covers no curve, under a title if there is one."""
    handles, labels = ax.get_legend_handles_labels()
    place: dict[str, Any] = {"loc": "outside upper center", "ncols": min(columns, len(labels)), "handlelength": 2.8}
    figure.legend(handles, labels, title=title or None, title_fontsize=9, **place)
