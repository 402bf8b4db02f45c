"""Names and texts that go into C source: checked identifiers, and comments that end where they should."""

from __future__ import annotations

import re

from gbid.errors import UsageError

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,49}")
_WORDS = """
auto break case char const continue default do double else enum extern float for goto if inline int long main register
restrict return short signed sizeof static struct switch typedef union unsigned void volatile while
"""
_RESERVED = frozenset(_WORDS.split())


def c_name(text: str) -> str:
    """Return a text after a check that it may be the prefix of names in C.

    Parameters
    ----------
    text : str
        The name.

    Raises
    ------
    UsageError
        When it is no identifier, longer than 50 characters, or a word of the language.
    """
    if not _NAME.fullmatch(text) or text in _RESERVED:
        raise UsageError(
            f"name {text!r} is no C identifier; use letters, digits and '_', a letter first, at most 50 characters, "
            "and no word of the language"
        )
    return text


def c_comment(text: str) -> str:
    """Return a free text for a comment in C: one line of ASCII without marks of comments, trigraphs and backslashes.

    Parameters
    ----------
    text : str
        Any text.
    """
    line = " ".join(str(text).split())
    line = re.sub(r"\*+/|/[*/]+", "|", line).replace("\\", "|").replace("??", "?")
    return "".join(c if " " <= c <= "~" else "?" for c in line).replace("/*", "|").replace("*/", "|")


def c_number(value: float, number: str) -> str:
    """Return a number as a literal of type double or float that reads as the same bits.

    Parameters
    ----------
    value : float
        A finite number.
    number : {"double", "float"}
        Type of the literal.
    """
    text = repr(float(value))
    text = text if any(c in text for c in ".e") else f"{text}.0"
    text = f"{text}f" if number == "float" else text
    return f"({text})" if text.startswith("-") else text
