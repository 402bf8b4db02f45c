"""Figures of matplotlib as SVG in a page."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from html import escape
from itertools import count

import matplotlib as mpl

from gbid.report.figures.save import STYLE, Drawn, figure_of, missing_letters_as_boxes

_IDS = re.compile(r'(\bid="|href="#|url\(#)')
_SIZE = re.compile(r'<svg\b[^>]*?viewBox="(?P<box>[^"]+)"[^>]*>')
_LONG = re.compile(r"(-?\d+\.\d{2})\d+")
_PATH = re.compile(r'\bd="[^"]*"')


@dataclass(frozen=True)
class Picture:
    """Figure in a page.

    Attributes
    ----------
    svg : str
        The SVG element, with the alternative text in it.
    caption : str
        Text below the picture.
    """

    svg: str
    caption: str


class Pictures:
    """Maker of the pictures of one page; each picture has its own ids."""

    def __init__(self) -> None:
        self._numbers = count(1)

    def picture(self, figure: Drawn, alt: str, caption: str = "") -> Picture:
        """Return a figure as SVG.

        Parameters
        ----------
        figure : matplotlib Figure, Axes, or array of Axes
            The figure, or what a picture function returned.
        alt : str
            Alternative text for readers who cannot see it.
        caption : str
            Text below the picture; by default the alternative text.
        """
        buffer = io.StringIO()
        # Letters as outlines: a device without these fonts shows them correctly.
        outlines = mpl.rc_context({"svg.fonttype": "path", "svg.hashsalt": "gbid"})
        nothing = {"Date": None, "Creator": None, "Format": None, "Type": None}
        with mpl.rc_context(fname=STYLE), outlines, missing_letters_as_boxes():
            figure_of(figure).savefig(buffer, format="svg", metadata=nothing)
        return Picture(_embedded(buffer.getvalue(), f"g{next(self._numbers)}-", alt), caption or alt)


def _embedded(text: str, prefix: str, alt: str) -> str:
    """Return the SVG element without the parts that only a file needs; ids get a prefix, paths two decimals."""
    body = text[text.index("<svg") :]
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    found = _SIZE.search(body)
    assert found is not None
    body = body[found.end() :]
    body = _IDS.sub(rf"\g<1>{prefix}", body.replace("xlink:href", "href"))
    body = _PATH.sub(lambda path: _LONG.sub(r"\1", path[0]), body)
    body = re.sub(r"\n\s*", "\n", body)
    width, height = found["box"].split()[2:]
    # matplotlib measures in points of 1/72 inch, a page in pixels of 1/96
    look = f'style="--natural:{float(width) * 4 / 3:.0f}px;max-width:var(--natural)" class="picture"'
    return f'<svg {look} viewBox="0 0 {width} {height}" role="img" aria-label="{escape(alt, quote=True)}">{body}'
