"""What a user says about the layout of a text file; the rest is found in the file."""

from __future__ import annotations

import codecs
from dataclasses import dataclass, fields

from gbid.errors import UsageError

DELIMITERS = (",", ";", "\t", " ")
"""Delimiters that are tried, in this order; the blank stands for any number of blanks and tabs."""
DECIMALS = (".", ",")
"""Decimal signs that are tried, in this order."""


@dataclass(frozen=True)
class TextOptions:
    r"""Layout of a text file, as far as a user gives it.

    Parameters
    ----------
    encoding : str, optional
        Encoding as Python names it: ``"utf-8"``, ``"cp1252"``, ``"utf-16"``.
    decimal : str, optional
        Decimal sign, ``"."`` or ``","``.
    delimiter : str, optional
        Character between the cells: ``","``, ``";"``, ``"\t"``, or ``" "`` for any number of blanks.
    header_line : int, optional
        Number of the line with the names of the columns, counted from 1.

    Raises
    ------
    UsageError
        When a value is not possible.
    """

    encoding: str | None = None
    decimal: str | None = None
    delimiter: str | None = None
    header_line: int | None = None

    def __post_init__(self) -> None:
        if self.encoding is not None:
            try:
                codecs.lookup(self.encoding)
            except (LookupError, TypeError):
                raise UsageError(
                    f"encoding: {self.encoding!r} is not known; write utf-8, cp1252 or utf-16, for example"
                ) from None
        if self.decimal is not None and self.decimal not in DECIMALS:
            raise UsageError(f"decimal: expected '.' or ',', found {self.decimal!r}")
        if self.delimiter is not None and not (isinstance(self.delimiter, str) and len(self.delimiter) == 1):
            raise UsageError(f"delimiter: expected one character such as ';', found {self.delimiter!r}")
        line = self.header_line
        if line is not None and (isinstance(line, bool) or not isinstance(line, int) or line < 1):
            raise UsageError(f"header_line: expected the number of a line, counted from 1, found {line!r}")

    def given(self) -> list[str]:
        """Return the names of the options that are given."""
        return [each.name for each in fields(self) if getattr(self, each.name) is not None]
