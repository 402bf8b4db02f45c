"""Short text descriptions of results for the Python shell."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

WIDTH = 110
"""Number of characters in a line."""
_NO_BREAK = "\u00a0"  # stands for a space inside an entry, so that a line break does not split the entry
FEW = 6
"""Largest number of entries that are shown in full; of longer values the first entries or the range are shown."""


def brief(owner: Any, about: str, /, **shown: Any) -> str:
    """Return a description of a result in a few lines.

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
    str
        Several lines. The last line names the fields that are not shown.
    """
    width = max((len(name) for name in shown), default=0)
    lines = [f"{type(owner).__name__}: {about}".removesuffix(": ")]
    for name, value in shown.items():
        text = value if isinstance(value, str) else in_words(value)
        wrapped = textwrap.wrap(text, WIDTH - width - 4, break_on_hyphens=False)
        lines += [f"  {'' if i else name:{width}}  {part}" for i, part in enumerate(wrapped)]
    other = [field.name for field in fields(owner) if field.name not in shown and not field.name.startswith("_")]
    if other:
        lines += textwrap.wrap(
            f"also: {', '.join(other)}", WIDTH, initial_indent="  ", subsequent_indent=" " * 8, break_long_words=False
        )
    return "\n".join(lines).replace(_NO_BREAK, " ")


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
    return str(value)


def estimates(values: Mapping[str, float], std: Mapping[str, float], names: Iterable[str]) -> str:
    """Return estimates with their standard deviations as one line of text."""
    return _listed([f"{name} = {values[name]:.5g} +- {std[name]:.2g}" for name in names], many=4 * FEW)


def counted(words: Iterable[str]) -> str:
    """Return how often each word occurs, in the order of first occurrence."""
    counts: dict[str, int] = {}
    for word in words:
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
