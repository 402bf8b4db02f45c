"""File format: what a reader of recordings consists of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from gbid.recording.importers.columns import FileColumn

Reader = Callable[[Path, Sequence[str]], dict[str, FileColumn]]
"""From a file and references to columns, to these columns."""


@dataclass(frozen=True)
class FileFormat:
    """A format of files that recordings are imported from.

    Attributes
    ----------
    endings : tuple of str
        File endings, lower case, with the dot.
    read : callable
        From the path and the references of an `ImportMapping` to the columns by reference. Raises DataError.
    peek : callable, optional
        From the same to the number of samples and columns that hold no more than their first and last sample, where
        this is faster than reading the file.
    """

    endings: tuple[str, ...]
    read: Reader
    peek: Callable[[Path, Sequence[str]], tuple[int, dict[str, FileColumn]]] | None = None
