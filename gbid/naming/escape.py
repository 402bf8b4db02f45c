"""Free text made safe to show: names, units and contents of files may contain anything.

Text is kept as it is inside of gbid, and escaped where it is shown. What renderers have rules of their own for (HTML,
CSV, C, XML) is escaped by them.
"""

from __future__ import annotations

from html import escape


def one_line(text: str) -> str:
    r"""Return a text on one line, without characters that act on a terminal or on the order of letters.

    Blanks and line breaks become single blanks. Other characters that cannot be printed become their codes.

    Parameters
    ----------
    text : str
        Any text.

    Examples
    --------
    >>> print(one_line("two\nlines, \x1b[31mred"))
    two lines, \x1b[31mred
    """
    return printable(" ".join(text.split()))


def printable(text: str) -> str:
    r"""Return a text in which blanks of any kind are a space, and what cannot be printed is its code.

    Parameters
    ----------
    text : str
        Any text.

    Examples
    --------
    >>> print(printable("a  b\tc\x07"))
    a  b c\x07
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else " " if c.isspace() else ascii(c)[1:-1] for c in text)


def html_text(text: str) -> str:
    """Return a text for HTML, as a text or as the value of an attribute; nothing in it acts on the page.

    Parameters
    ----------
    text : str
        Any text.
    """
    return escape(printable(text))
