"""File format: what a reader of recordings consists of, and what it lists of a file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

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
    jitter_ppm : float or None
        Jitter of such a column in millionths of its step (rms), where it is more than rounding.
    first : tuple of float
        First numbers.
    """

    name: str
    n_samples: int
    unit: str | None = None
    sample_time: float | None = None
    step: float | None = None
    remark: str = ""
    jitter_ppm: float | None = None
    first: tuple[float, ...] = ()


Reader = Callable[..., dict[str, FileColumn]]
"""From a file (pathlib.Path) and references to columns (sequence of str) to these columns. The reader of a text format
takes `TextOptions` as a third argument."""


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
        From the same to the number of samples and columns that hold no more than some first samples and the last one,
        where this is faster than reading the file.
    states_sample_time : bool
        Whether such files may state the sample time of their channels, so that a mapping need not give it.
    may_crash : bool
        Whether the library that reads such files may crash, hang or fill the memory when a file is damaged. Its
        functions then run in a process of their own.
    layout : callable, optional
        For text formats: from the path to the layout of the table, as plain values for the listing. The functions of
        such a format take `TextOptions` as their last argument.
    """

    endings: tuple[str, ...]
    read: Reader
    channels: Callable[..., list[FileChannel]]
    peek: Callable[..., tuple[int, dict[str, FileColumn]]] | None = None
    states_sample_time: bool = False
    may_crash: bool = False
    layout: Callable[..., dict[str, Any]] | None = None
