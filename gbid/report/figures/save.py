"""Style of the figures, and how they are written. Nothing here touches pyplot, so nothing is left behind."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl
from matplotlib.figure import Figure

if TYPE_CHECKING:
    pass

STYLE = Path(__file__).with_name("gbid.mplstyle")
"""Style of all figures."""


def save_figure(figure: Figure, path: Path, *, kind: str | None = None, note: str = "") -> None:
    """Write a figure as png, pdf or svg, the same bytes each time.

    Parameters
    ----------
    figure : matplotlib Figure
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
    with mpl.rc_context(rc={"svg.hashsalt": "gbid"}, fname=STYLE):
        figure.savefig(path, format=kind, metadata=dict(metadata))


def symbol(name: str) -> str:
    """Write the name of a channel as the paper does: ``p_x`` with an index."""
    letter, _, index = name.partition("_")
    if len(letter) == 1 and "_" not in index:
        return f"${letter}_{{{index}}}$" if index else f"${letter}$"
    return name
