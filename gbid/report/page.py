"""Elements of a page: texts, tables, pictures and sections, rendered by templates as one HTML file."""

from __future__ import annotations

import io
import json
import re
from base64 import b64encode
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from itertools import count
from typing import Any, ClassVar

import matplotlib as mpl
import numpy as np
from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup

from gbid._version import __version__
from gbid.core.arrays import FloatArray
from gbid.core.names import printable
from gbid.core.tables import Table, html_table
from gbid.report.canvas import STYLE, Drawn, figure_of, missing_letters_as_boxes, print_figure

# ---- Figures of matplotlib as SVG in a page.

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
    """Maker of the pictures of a page; the ids of each maker begin with its name."""

    def __init__(self, name: str = "g") -> None:
        self._name, self._numbers = name, count(1)

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
            print_figure(figure_of(figure), buffer, "svg", nothing)
        return Picture(_embedded(buffer.getvalue(), f"{self._name}{next(self._numbers)}-", alt), caption or alt)


def _embedded(text: str, prefix: str, alt: str) -> str:
    """Return the SVG element for a page: without file headers, ids with a prefix, paths with two decimals."""
    body = text[text.index("<svg") :]
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    size = _SIZE.search(body)
    assert size is not None
    body = body[size.end() :]
    body = _IDS.sub(rf"\g<1>{prefix}", body.replace("xlink:href", "href"))
    body = _PATH.sub(lambda path: _LONG.sub(r"\1", path[0]), body)
    body = re.sub(r"\n\s*", "\n", body)
    width, height = size["box"].split()[2:]
    # matplotlib measures in points of 1/72 inch, a page in pixels of 1/96
    look = f'style="max-width:{float(width) * 4 / 3:.0f}px" class="picture"'
    return f'<svg {look} viewBox="0 0 {width} {height}" role="img" aria-label="{escape(alt, quote=True)}">{body}'


@dataclass(frozen=True)
class Link:
    """Table cell or list item with a link within the page."""

    text: str
    href: str


def fit_href(fit: str, model: str) -> str:
    """Return the address of a fit within the page."""
    return f"#fit&{fit}%2F{model}"


@dataclass(frozen=True)
class Words:
    """Paragraph of the page; its tone is "", "good", "warn" or "bad"."""

    text: str
    tone: str = ""
    kind: ClassVar[str] = "words"


@dataclass(frozen=True)
class Listed:
    """List of items in the page."""

    items: Sequence[str | Link]
    kind: ClassVar[str] = "list"


@dataclass(frozen=True)
class Shown:
    """Picture in the page."""

    picture: Picture
    kind: ClassVar[str] = "picture"


@dataclass(frozen=True)
class Gallery:
    """Blocks side by side if the page is wide enough."""

    blocks: Sequence[Any]
    kind: ClassVar[str] = "gallery"


@dataclass(frozen=True)
class Fold:
    """Blocks that open on a click; open in print."""

    title: str
    blocks: Sequence[Any]
    kind: ClassVar[str] = "fold"


@dataclass(frozen=True)
class Templated:
    """Block rendered by a template from given data."""

    template: str
    values: dict[str, Any] = field(default_factory=dict)
    kind: ClassVar[str] = "part"


Block = Words | Listed | Table | Shown | Gallery | Fold | Templated


@dataclass(frozen=True)
class PageSection:
    """Section of the page."""

    id: str
    title: str
    blocks: Sequence[Block]


# ---- Rendering of a page: sections, styles and scripts in one HTML text without other files.

SCRIPTS = ("charts.js", "explorer.js", "fits.js", "page.js")


def render(title: str, name: str, sections: Sequence[PageSection], left_out: Sequence[str], key: str) -> str:
    """Return the HTML of a page.

    Parameters
    ----------
    title, name : str
        Title and name of the experiment.
    sections : sequence of PageSection
        Sections of the page.
    left_out : sequence of str
        Parts of the method that the experiment does not use.
    key : str
        Content key, stored as a comment.

    Returns
    -------
    str
        HTML text.
    """
    return (
        environment(page_part)
        .get_template("report.html.j2")
        .render(
            title=title or name,
            name=name,
            sections=sections,
            left_out=left_out,
            key=key,
            version=__version__,
            style=Markup(page_part("style.css")),
            script=script_of_page(),
        )
    )


def environment(read: Callable[[str], str]) -> Environment:
    """Return the environment of the page templates.

    Parameters
    ----------
    read : callable
        Function that returns the text of a template by its name.
    """
    made = Environment(
        loader=FunctionLoader(read),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: printable(value) if type(value) is str else value,
    )
    made.filters["embedded"] = packed_json
    made.filters["html_table"] = lambda table: Markup(html_table(table))
    return made


def page_part(name: str) -> str:
    """Return the text of a template, script or style sheet of the page."""
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def script_of_page() -> Markup:
    """Return the script of the page."""
    return script(*map(page_part, SCRIPTS))


def script(*texts: str) -> Markup:
    """Return several scripts as one, in strict mode."""
    strict = '"use strict";\n'
    return Markup(strict + "".join(text.replace(strict, "") for text in texts))


def packed_json(value: Any) -> Markup:
    """Return data as JSON for a script; no text in it can close the script element."""
    text = json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return Markup(text.replace("<", "\\u003c"))


_LARGEST = 32767


def packed(values: FloatArray) -> dict[str, Any]:
    """Return a curve as base64 of little-endian 16-bit integers (-32768 for NaN), and the factor to its values."""
    missing = np.isnan(values)
    largest = float(np.abs(values[~missing]).max(initial=0.0))
    scale = largest / _LARGEST if largest > 0 else 1.0
    integers = np.where(missing, -_LARGEST - 1, np.round(values / scale)).astype("<i2")
    return {"scale": scale, "values": b64encode(integers.tobytes()).decode("ascii")}
