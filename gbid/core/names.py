"""Text and names: text made safe for display, paths given by callers, file names.

Text is kept as it is inside of gbid, and escaped where it is shown. What renderers have rules of their own for (HTML,
CSV, C, XML) is escaped by them.
"""

from __future__ import annotations

import hashlib
import os
from html import escape
from pathlib import Path

from gbid.core.errors import UsageError


def one_line(text: str) -> str:
    r"""Return a text on one line, without control characters and without changes of the writing direction.

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
    r"""Return a text with each blank as a space and each unprintable character as its code.

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
    """Return a text escaped for HTML, as content or as the value of an attribute.

    Parameters
    ----------
    text : str
        Any text.
    """
    return escape(printable(text))


# ---- Paths given by callers, and file names made from free text.

LONGEST = 120
"""Largest number of bytes of a part of a file name that is made of a name; file systems take 255 with all additions."""
_DIGITS = 8
_MOST_OF_PART, _MOST = 255, 4095  # bytes of a part of a path and of a whole one, on Linux; about the same elsewhere


def given_path(path: object) -> Path:
    """Return a path given by a caller, checked: a text or path-like that can name a file.

    Parameters
    ----------
    path : str or path-like
        The path.

    Raises
    ------
    UsageError
        When it is no path, when it contains a NUL character, or when it is longer than file systems allow.
    """
    if not isinstance(path, str | os.PathLike):
        raise UsageError(f"{path!r} is no path; give the name of a file as a text or a pathlib.Path")
    checked = Path(path)
    if "\0" in str(checked):
        raise UsageError(f"{str(checked)!r}: a path cannot contain a NUL character; correct the name of the file")
    encoded = os.fsencode(checked)
    longest = max(map(len, encoded.split(os.fsencode(os.sep))))
    if longest > _MOST_OF_PART or len(encoded) > _MOST:
        beginning = printable(str(checked)[:40])
        raise UsageError(
            f"{beginning}...: the path has {len(encoded)} bytes, its longest part {longest}; at most "
            f"{_MOST} and {_MOST_OF_PART} are allowed: correct the name of the file"
        )
    return checked


def file_stem(name: str, longest: int = LONGEST, join: str = "-") -> str:
    """Return a text as a part of a file name; a long text is cut and ends with a digest, to stay unique.

    Parameters
    ----------
    name : str
        A name without path separators.
    longest : int
        Largest number of bytes.
    join : str
        What stands before the digest.

    Examples
    --------
    >>> file_stem("p5_n6000_prbs1"), len(file_stem(300 * "x"))
    ('p5_n6000_prbs1', 120)
    """
    encoded = name.encode()
    if len(encoded) <= longest:
        return name
    digest = hashlib.sha256(encoded).hexdigest()[:_DIGITS]
    return f"{encoded[: longest - _DIGITS - len(join)].decode(errors='ignore')}{join}{digest}"
