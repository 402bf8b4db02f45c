"""Short descriptions of results: text for the Python shell, and HTML for notebooks."""

from __future__ import annotations

import copyreg
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from gbid.core.names import html_text, printable
from gbid.core.tables import Table, html_table

WIDTH = 110
"""Number of characters in a line."""
_PROGRESS = 79  # characters of a line that is written over
_NO_BREAK = "\u00a0"  # stands for a space inside an entry, so that a line break does not split the entry
_LONG = 100  # rows of tables that a notebook does not show
_ROWS = 12  # fields that are shown where a class does not choose
FEW = 6
"""Largest number of entries that are shown in full; of longer values the first entries or the range are shown."""


@dataclass(frozen=True)
class Description:
    """Short description of a result.

    Attributes
    ----------
    kind : str
        Name of its class.
    title : str
        Title; may be empty.
    rows : dict of str to str
        Values in words, by name.
    others : tuple of str
        Names of the fields that are not shown.
    """

    kind: str
    title: str
    rows: Mapping[str, str]
    others: tuple[str, ...]

    @property
    def heading(self) -> str:
        """Heading of the description: class and title."""
        return f"{self.kind}: {self.title}".removesuffix(": ")

    def text(self) -> str:
        """Return the description as lines of text; the last line names the fields that are not shown."""
        width = max((len(name) for name in self.rows), default=0)
        lines = [self.heading]
        for name, value in self.rows.items():
            wrapped = textwrap.wrap(value, WIDTH - width - 4, break_on_hyphens=False)
            lines += [f"  {'' if i else name:{width}}  {part}" for i, part in enumerate(wrapped)]
        if self.others:
            also = f"also: {', '.join(self.others)}"
            lines += textwrap.wrap(also, WIDTH, initial_indent="  ", subsequent_indent=" " * 8, break_long_words=False)
        return "\n".join(map(printable, lines))

    def html(self) -> str:
        """Return a small table without styles, so that it follows the style of the notebook."""
        rows = "".join(
            f'<tr><th scope="row" style="text-align:left">{html_text(name)}</th>'
            f'<td style="text-align:left">{html_text(value)}</td></tr>'
            for name, value in self.rows.items()
        )
        also = f"<p><small>also: {html_text(', '.join(self.others))}</small></p>" if self.others else ""
        table = f"<table><tbody>{rows}</tbody></table>" if rows else ""
        return f"<div><p><strong>{html_text(self.heading)}</strong></p>{table}{also}</div>"


def _read_only(entries: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(entries)


# Results hold read-only views of dicts, which pickle cannot store: they go to other processes as dicts. The rule is for
# the whole process: results of ten modules have such fields, and so may classes of others that contain a result. It
# takes nothing away, because without it pickle and copy refuse a view.
copyreg.pickle(MappingProxyType, lambda view: (_read_only, (dict(view),)))


class Brief:
    """Base of results that describe themselves: a few lines in the shell, tables on pages and in notebooks.

    A result of any size prints at most a screen. Subclasses choose in `_brief` what is shown; by default it is the
    fields. In a notebook, tables follow if they fit on a screen.
    """

    _in_tables: ClassVar[tuple[str, ...]] = ()  # rows of the description that the tables of a value have, too

    def __init_subclass__(cls, **options: Any) -> None:
        """Keep `@dataclass` from giving the subclass a repr that prints all its arrays."""
        super().__init_subclass__(**options)
        if "__repr__" not in cls.__dict__:
            cls.__repr__ = Brief.__repr__  # type: ignore[method-assign]  # dataclass leaves a method that is there

    def __repr__(self) -> str:
        return self._brief().text()

    def tables(self) -> list[Table]:
        """Return the tables of this value; empty for a value without tables."""
        return []

    def _repr_html_(self) -> str:
        about, tables = self._brief(), self.tables()
        if not tables or sum(len(table.rows) for table in tables) > _LONG:
            return about.html()
        rows = {name: text for name, text in about.rows.items() if name not in self._in_tables}
        return replace(about, rows=rows).html() + "".join(map(html_table, tables))

    def _brief(self) -> Description:
        names = [field.name for field in fields(self) if not field.name.startswith("_")]  # type: ignore[arg-type]  # all are
        name = [getattr(self, "name", "")] if isinstance(getattr(self, "name", None), str) else [""]
        shown = [key for key in names if key != "name"][:_ROWS]
        return brief(self, *name, **{key: getattr(self, key) for key in shown})


@contextmanager
def progress_line() -> Iterator[Callable[[Any], None]]:
    """Return a context whose function shows the text of each call on one line of standard error.

    The line is written anew each time, in a terminal as in a notebook, and is empty at the end.
    """

    def show(step: Any) -> None:
        words = ", ".join(f"{name} {in_words(value)}" for name, value in vars(step).items())
        sys.stderr.write(f"\r{words[:_PROGRESS]:{_PROGRESS}}")
        sys.stderr.flush()

    try:
        yield show
    finally:
        sys.stderr.write(f"\r{'':{_PROGRESS}}\r")


def brief(owner: Any, about: str, /, **shown: Any) -> Description:
    """Return a short description of a result.

    Parameters
    ----------
    owner : dataclass
        The result.
    about : str
        Title, written after the name of the class.
    **shown
        Values to show, by name. Each takes one line or more; empty values are left out.

    Returns
    -------
    Description
    """
    rows = {name: value if isinstance(value, str) else in_words(value) for name, value in shown.items()}
    others = [field.name for field in fields(owner) if field.name not in shown and not field.name.startswith("_")]
    return Description(type(owner).__name__, about, {name: text for name, text in rows.items() if text}, tuple(others))


def in_words(value: Any) -> str:
    """Return a value as one line of text.

    Numbers have six digits. Of a long list the first entries are shown, of a large array the range.
    """
    if isinstance(value, str):
        return value
    if isinstance(value, np.ndarray):
        return _array(value)
    if isinstance(value, float | np.floating):
        return f"{float(value):.6g}"
    if isinstance(value, Mapping):
        return _listed([f"{name} = {in_words(entry)}" for name, entry in value.items()])
    if isinstance(value, Sequence):
        return _listed([in_words(entry) for entry in value])
    if isinstance(value, Brief):
        return value._brief().heading
    if is_dataclass(value):
        return str(getattr(value, "name", type(value).__name__))
    return getattr(value, "__name__", str(value)) if callable(value) else str(value)


def estimates(values: Mapping[str, float], std: Mapping[str, float], names: Iterable[str]) -> str:
    """Return estimates with their standard deviations as one line of text."""
    return _listed([f"{name} = {values[name]:.5g} +- {std[name]:.2g}" for name in names], many=4 * FEW)


def counted(names: Iterable[str]) -> str:
    """Return how often each word occurs, as text, in the order of first occurrence."""
    counts: dict[str, int] = {}
    for word in names:
        counts[word] = counts.get(word, 0) + 1
    return _listed([f"{count} {word}" for word, count in counts.items()])


def _array(values: np.ndarray[Any, Any]) -> str:
    if values.size <= FEW:
        return " ".join(np.array2string(values, precision=5).split())
    shape = " x ".join(map(str, values.shape))
    if values.dtype.kind not in "fiu":
        return f"{shape} entries"
    known = values[np.isfinite(values)]
    missing = f", {values.size - known.size} without a value" if known.size < values.size else ""
    return f"{shape} numbers" + (f", {known.min():.5g} to {known.max():.5g}" if known.size else "") + missing


def _listed(entries: Sequence[str], many: int = FEW) -> str:
    left = len(entries) - many
    shown = [*entries[:many], *([f"... {left} more"] if left > 0 else [])]
    return ", ".join(text.replace(" ", _NO_BREAK) if len(text) <= WIDTH // 2 else text for text in shown)
