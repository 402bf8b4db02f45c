"""What a result says of itself in a Python shell: a few lines instead of all its numbers."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

WIDTH = 110
"""Characters of a line."""
_NO_BREAK = "\u00a0"  # within an entry of a list, until the lines are made
FEW = 6
"""So many entries of a mapping, a tuple or an array are shown; of more, the first ones or the range."""


def brief(owner: Any, about: str, /, **shown: Any) -> str:
    """Describe a result.

    Parameters
    ----------
    owner : dataclass
        The result.
    about : str
        What it is, after the name of its class.
    **shown
        Entries of interest by name, a line or more for each; empty ones are left out.

    Returns
    -------
    str
        Several lines; the last one names the fields that are not shown.
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
    """Write a value on one line: numbers with six digits, the range of many numbers, the first of many entries."""
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
    """Write estimates with their standard deviations."""
    return _listed([f"{name} = {values[name]:.5g} +- {std[name]:.2g}" for name in names], many=4 * FEW)


def counted(words: Iterable[str]) -> str:
    """Write how often each word occurs, in the order of their first occurrence."""
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
    told = [*entries[:many], *([f"... {left} more"] if left > 0 else [])]
    return ", ".join(text.replace(" ", _NO_BREAK) if len(text) <= WIDTH // 2 else text for text in told)
