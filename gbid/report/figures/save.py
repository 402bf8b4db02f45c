"""Style of the figures, and how they are written. Nothing here touches pyplot, so nothing is left behind."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from gbid.naming.escape import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Drawn: TypeAlias = "Figure | Axes | npt.NDArray[np.object_]"
"""What a picture function returns."""

STYLE = Path(__file__).with_name("gbid.mplstyle")
"""Style of all figures."""
_SYMBOL = re.compile(r"([A-Za-z])(?:_([A-Za-z0-9]{1,12}))?")
_LONGEST = 48


def figure_of(drawn: Drawn) -> Figure:
    """Return the figure of what a picture function returned.

    Parameters
    ----------
    drawn : matplotlib Figure, Axes, or array of Axes
        A figure, or axes of one.
    """
    found: Any = drawn.flat[0] if isinstance(drawn, np.ndarray) else drawn
    while not isinstance(found, Figure):  # axes, or axes in a subfigure
        found = found.figure
    return found


def save_figure(figure: Drawn, path: Path, *, kind: str | None = None, note: str = "") -> None:
    """Write a figure as png, pdf or svg, the same bytes each time.

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
        figure_of(figure).savefig(path, format=kind, metadata=dict(metadata))


@contextmanager
def missing_letters_as_boxes() -> Iterator[None]:
    """Return a context in which letters that the font lacks are drawn as boxes without a warning for each."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"Glyph \d+ .*missing from font", UserWarning)
        yield


def plain_label(text: str) -> str:
    """Return free text for a figure: it is drawn as it is, also where it looks like mathematics, and cut when long."""
    text = printable(text)
    text = text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"
    return text.replace("$", r"\$")


def symbol(name: str) -> str:
    """Return the name of a channel as the paper writes it: ``p_x`` with an index. Other names stay as they are."""
    found = _SYMBOL.fullmatch(name)
    if found is None:
        return plain_label(name)
    return f"${found[1]}_{{{found[2]}}}$" if found[2] else f"${found[1]}$"
