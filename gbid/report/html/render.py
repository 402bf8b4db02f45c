"""Rendering of a page: sections, styles and scripts in one HTML text without other files."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from importlib.resources import files
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup

from gbid._version import __version__
from gbid.naming.escape import printable
from gbid.report.html.page import PageSection
from gbid.tables.html import html_table

SCRIPTS = ("charts.js", "explorer_math.js", "explorer.js", "fits.js", "page.js")


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
    page = environment(page_part).get_template("report.html.j2")
    return page.render(
        title=title or name,
        name=name,
        sections=sections,
        left_out=left_out,
        key=key,
        version=__version__,
        style=Markup(page_part("style.css")),
        scripts=[script(page_part(name)) for name in SCRIPTS],
    )


def environment(read: Callable[[str], str]) -> Environment:
    """Return the template environment of pages.

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
    made.filters["embedded"] = _embedded
    made.filters["html_table"] = lambda table: Markup(html_table(table))
    return made


def page_part(name: str) -> str:
    """Return the text of a template, script or style of the page."""
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def script(text: str) -> Markup:
    """Return a script for a page, without the lines for programs outside of it."""
    lines = text.splitlines()
    return Markup(
        "\n".join(line for line in lines if line != '"use strict";' and not line.startswith("if (typeof module"))
    )


def _embedded(value: Any) -> Markup:
    """Return data for a script element; no text in it can end the element."""
    text = json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return Markup(text.replace("<", "\\u003c"))
