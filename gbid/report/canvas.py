"""Canvas of all figures: style, sizes for a two-column report, line styles for grey prints, units in labels."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from inspect import signature
from pathlib import Path
from threading import current_thread, main_thread
from typing import Any, Literal, TextIO, TypeAlias

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backend_bases import get_registered_canvas_class
from matplotlib.figure import Figure

from gbid.core.errors import UsageError
from gbid.core.names import printable
from gbid.core.tables import shown_unit

Drawn: TypeAlias = "Figure | Axes | npt.NDArray[np.object_]"
"""What a picture function returns."""

STYLE = Path(__file__).with_name("gbid.mplstyle")
"""Style of all figures."""
_SYMBOL = re.compile(r"([A-Za-z])(?:_([A-Za-z0-9]{1,12}))?")
_LONGEST = 48


def figure_of(drawn: Drawn) -> Figure:
    """Return the matplotlib figure that contains the result of a picture function.

    Parameters
    ----------
    drawn : matplotlib Figure, Axes, or array of Axes
        A figure, or axes of one.
    """
    artist: Any = drawn.flat[0] if isinstance(drawn, np.ndarray) else drawn
    while not isinstance(artist, Figure):  # axes, or axes in a subfigure
        artist = artist.figure
    return artist


def save_figure(figure: Drawn, path: Path, *, kind: str | None = None, note: str = "") -> None:
    """Write a figure as png, pdf or svg; equal figures give equal bytes.

    Parameters
    ----------
    figure : matplotlib Figure, Axes, or array of Axes
        A figure, or what a picture function returned.
    path : path
    kind : {"png", "pdf", "svg"}, optional
        The ending of the path decides when left out.
    note : str
        A remark that travels inside the file.
    """
    kind = kind or path.suffix.lstrip(".")
    notes: dict[str, dict[str, str | None]] = {
        "png": {"Comment": note},
        "pdf": {"Keywords": note, "CreationDate": None},
        "svg": {"Description": note, "Date": None},
    }
    metadata: Mapping[str, str | None] = notes.get(kind, {})
    with mpl.rc_context(rc={"svg.hashsalt": "gbid"}, fname=STYLE), missing_letters_as_boxes():
        print_figure(figure_of(figure), path, kind, metadata)


def print_figure(figure: Figure, target: Path | TextIO, kind: str, metadata: Mapping[str, str | None]) -> None:
    """Write a figure with one drawing; `Figure.savefig` would draw it twice, once only for the layout.

    Parameters
    ----------
    figure : matplotlib Figure
    target : path or text buffer
    kind : {"png", "pdf", "svg"}
    metadata : mapping of str to str or None
        Entries of the file; None leaves out one that matplotlib would write.
    """
    canvas, dpi, paper = figure.canvas, figure.dpi, figure.get_facecolor()
    printing: Any = get_registered_canvas_class(kind)(figure)
    try:
        figure.dpi = mpl.rcParams["savefig.dpi"]
        if mpl.rcParams["savefig.facecolor"] != "auto":
            figure.set_facecolor(mpl.rcParams["savefig.facecolor"])
        getattr(printing, f"print_{kind}")(target, metadata=dict(metadata))
    finally:
        figure.set_facecolor(paper)
        figure.dpi = dpi
        figure.set_canvas(canvas)


@contextmanager
def missing_letters_as_boxes() -> Iterator[None]:
    """Return a context in which letters that the font lacks are drawn as boxes without a warning for each."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"Glyph \d+ .*missing from font", UserWarning)
        yield


def plain_label(text: str) -> str:
    """Return free text for a figure: drawn literally even if it looks like mathematics, shortened if long."""
    text = printable(text)
    text = text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"
    return text.replace("$", r"\$")


def unit_label(unit: str, values: npt.ArrayLike = ()) -> tuple[float, str]:
    """Return factor and label of a unit for plotted values, of which some may be NaN; see `shown_unit`."""
    factor, shown = shown_unit(unit, float(np.nanmax(np.abs(values), initial=0.0)))
    return factor, plain_label(shown or "-")


def symbol(name: str) -> str:
    """Return the symbol of a channel in the paper's notation: ``p_x`` with an index; other names stay unchanged."""
    match = _SYMBOL.fullmatch(name)
    if match is None:
        return plain_label(name)
    return f"${match[1]}_{{{match[2]}}}$" if match[2] else f"${match[1]}$"


LayoutName = Literal["constrained"]

PRESSURE = "injection pressure [bar]"


def scheduling_axis(variable: str) -> tuple[float, str]:
    """Return factor and label of the axis of a scheduling variable."""
    return {"pressure_bar": (1.0, PRESSURE), "speed_rpm": (1e-3, "speed [1000 rpm]")}.get(variable, (1.0, variable))


def scheduling_words(variables: Sequence[str]) -> str:
    """Return scheduling variables as text: ``"pressure and speed"``, ``"pressure and eccentricity"``."""
    return " and ".join({"pressure_bar": "pressure", "speed_rpm": "speed"}.get(name, name) for name in variables)


"""Label of an axis."""
ONE_COLUMN, TWO_COLUMNS = 3.35, 6.9
"""Widths of figures in a report of two columns [inch]."""

BLACK, BLUE, RED, GREEN, PINK, GREY = "#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8c8c8c"
"""Colours that colour-blind readers can distinguish (Okabe and Ito), and a grey."""

SERIES: tuple[dict[str, Any], ...] = (
    {"color": BLACK, "linestyle": "-", "marker": "o"},
    {"color": RED, "linestyle": (0, (5, 1.5)), "marker": "s"},
    {"color": BLUE, "linestyle": (0, (1, 1)), "marker": "^"},
    {"color": GREEN, "linestyle": "-.", "marker": "D"},
    {"color": PINK, "linestyle": (0, (7, 1.5, 1, 1.5, 1, 1.5)), "marker": "v"},
)
"""Styles of the curves of one figure: each has its own colour, dashes and marker."""
_AGAIN: dict[str, Any] = {"linewidth": 2.6, "alpha": 0.45}
"""What tells the next five curves from the first five."""
_NARROWEST = 2.3  # column of panels [inch]


_COLOURS = (
    *("text.color", "figure.facecolor", "axes.facecolor", "axes.edgecolor", "axes.labelcolor", "axes.titlecolor"),
    *("xtick.color", "ytick.color", "xtick.labelcolor", "ytick.labelcolor", "legend.labelcolor"),
)


@contextmanager
def own_style() -> Iterator[None]:
    """Return a context with the figure style of gbid; afterwards the settings of matplotlib are restored.

    The colours of paper and ink are those of the reader who works with pyplot, so that pictures fit a dark style. A
    program that does not use pyplot, as the command line, draws on white.
    """
    now: Any = mpl.rcParams
    colours: Any = {key: now[key] for key in _COLOURS} if "matplotlib.pyplot" in sys.modules else {}
    with mpl.rc_context(rc=colours, fname=STYLE):
        yield


styled = own_style()
"""Decorator of functions that draw in the style of gbid."""

_Given: TypeAlias = "Axes | Sequence[Axes] | npt.ArrayLike | None"
_MAKER: ContextVar[Callable[..., Figure]] = ContextVar("maker", default=Figure)


def new_figure(size: tuple[float, float]) -> Figure:
    """Return a new figure of a size [inch]: independent of pyplot, or within `shown_by_pyplot` managed by pyplot."""
    return _MAKER.get()(figsize=size, layout="constrained")


@contextmanager
def shown_by_pyplot() -> Iterator[None]:
    """Return a context in which pyplot manages the new figure, so that notebooks and ``plt.show()`` show it.

    pyplot makes it before the style of gbid holds: its first figure chooses the backend, and turns interactive mode on
    in a notebook. Within the style this would be taken back at its end.
    """
    from matplotlib import pyplot  # nobody else imports it: it keeps figures, and opens windows

    figure = pyplot.figure()

    def made(figsize: tuple[float, float], layout: LayoutName) -> Figure:
        _MAKER.set(Figure)  # a second figure of the same call is one of its own
        figure.set_size_inches(figsize)
        figure.set_layout_engine(layout)
        return figure

    token = _MAKER.set(made)
    kept = False
    try:
        yield
        kept = _MAKER.get() is not made
    finally:
        _MAKER.reset(token)
        if not kept:
            pyplot.close(figure)


def around_public(function: Callable[..., Any], arguments: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
    """Return the context for a call of a public function by a user.

    A picture function without axes gets a figure of pyplot where that is imported, so that a notebook and `plt.show()`
    show it. A program without pyplot, and a thread beside the main one, where no window can be opened, gets a figure
    that nobody keeps.
    """
    if not (
        "matplotlib.pyplot" in sys.modules
        and function.__name__.startswith("plot_")
        and current_thread() is main_thread()
    ):
        return nullcontext()
    given = signature(function).bind_partial(*arguments, **keywords).arguments
    return nullcontext() if given.get("ax") is not None else shown_by_pyplot()


def panels(
    ax: _Given, rows: int = 1, columns: int = 1, *, size: tuple[float, float], **options: Any
) -> tuple[Figure, npt.NDArray[np.object_]]:
    """Return the given axes, or the axes of a new figure with several panels.

    Parameters
    ----------
    ax : matplotlib Axes, sequence of them, or None
        Axes to draw into; None makes a figure.
    rows, columns : int
        Numbers of rows and columns of panels.
    size : (width, height)
        Size of a new figure [inch]; one of many columns is wider.
    **options
        Options of ``Figure.subplots``.

    Returns
    -------
    figure : matplotlib.figure.Figure
        The figure of the axes.
    axes : (rows * columns,) array of matplotlib Axes
        Axes by rows; those that were given beyond them are left out.

    Raises
    ------
    UsageError
        When there are too few axes, or nothing to draw.
    """
    if rows * columns < 1:
        raise UsageError("nothing to draw: the list is empty; give at least one entry")
    if ax is None:
        figure = new_figure((max(size[0], _NARROWEST * columns), size[1]))
        return figure, figure.subplots(rows, columns, squeeze=False, **options).ravel()
    given = np.ravel(np.array(ax, dtype=object))
    if len(given) < rows * columns:
        raise UsageError(f"{len(given)} axes for {rows * columns} panels; give one for each, or none")
    return figure_of(given[0]), given[: rows * columns]


def one_panel(ax: Axes | None, size: tuple[float, float]) -> tuple[Figure, Axes]:
    """Return the given axes or the axes of a new figure with one panel, and the figure."""
    figure, (panel,) = panels(ax, size=size)
    return figure, panel


def channel_pairs(
    axes: npt.NDArray[np.object_], output_names: Sequence[str], input_names: Sequence[str]
) -> Iterator[tuple[int, int, Any]]:
    """Yield the panel of each pair of channels with the indices of output and input, and write the pair above it."""
    for (i, j), panel in np.ndenumerate(axes):
        panel.set_title(f"{symbol(input_names[j])} to {symbol(output_names[i])}", loc="right", pad=4)
        yield i, j, panel


def ink() -> str:
    """Return the text colour: black, or light if the reader uses a dark style of matplotlib."""
    return str(mpl.rcParams["text.color"])


def series(i: int, **changes: Any) -> dict[str, Any]:
    """Return the style of the i-th curve with changes; a change to None removes the property."""
    style = {**SERIES[i % len(SERIES)], **(_AGAIN if i >= len(SERIES) else {}), **changes}
    if style.get("color") == BLACK:
        style["color"] = ink()
    return {key: value for key, value in style.items() if value is not None}


def letter(axes: Iterable[Axes]) -> None:
    """Write the names a), b), ... above the panels."""
    for ax, name in zip(axes, "abcdefghijkl", strict=False):
        ax.set_title(f"{name})", loc="left", pad=4)


def legend_above(figure: Figure, axes: Axes | npt.ArrayLike, columns: int = 6, title: str = "") -> None:
    """Put one legend for all panels above them, where it covers no curve, under a title if there is one.

    Where the figure has other panels, too, the legend is in the first of these: above, it would be that of all.
    """
    drawn = list(np.ravel(np.array(axes, dtype=object)))
    handles, labels = drawn[0].get_legend_handles_labels()
    place: dict[str, Any] = {"loc": "outside upper center", "ncols": min(columns, len(labels)), "handlelength": 2.8}
    above = set(figure.axes) == set(drawn)
    legend = figure.legend if above else drawn[0].legend
    legend(handles, labels, title=title or None, title_fontsize=9, **(place if above else {"loc": "best"}))
