"""File format: what a reader of recordings consists of, and what it lists of a file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from gbid.recording.importers.columns import FileColumn


@dataclass(frozen=True)
class FileChannel:
    """Channel of a file, as its listing shows it.

    Attributes
    ----------
    name : str
        Name as a mapping gives it, with index and group.
    n_samples : int
        Number of samples.
    unit : str or None
        Unit given by the file.
    sample_time : float or None
        Time between samples that the file states [s].
    step : float or None
        Step of a column that rises evenly, in its own unit. Such a column may be the time column.
    remark : str
        Reason why it is no signal, or the value of a single number.
    """

    name: str
    n_samples: int
    unit: str | None = None
    sample_time: float | None = None
    step: float | None = None
    remark: str = ""


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
    channels : callable
        From the path to the channels of the file, for the listing. Raises DataError.
    peek : callable, optional
        From the same to the number of samples and columns that hold no more than their first and last sample, where
        this is faster than reading the file.
    states_sample_time : bool
        Whether such files may state the sample time of their channels, so that a mapping need not give it.
    may_crash : bool
        Whether the library that reads such files may crash, hang or fill the memory when a file is damaged. Its
        functions then run in a process of their own.
    """

    endings: tuple[str, ...]
    read: Reader
    channels: Callable[[Path], list[FileChannel]]
    peek: Callable[[Path, Sequence[str]], tuple[int, dict[str, FileColumn]]] | None = None
    states_sample_time: bool = False
    may_crash: bool = False
