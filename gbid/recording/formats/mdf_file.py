"""Reader of MDF files of vehicle and test-bench loggers, versions 3 and 4, by asammdf."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from gbid.core.errors import DataError
from gbid.core.extras import extra_package
from gbid.recording.clock import even_step
from gbid.recording.mapping import nearest
from gbid.recording.readers import FileChannel, FileFormat, array_channels
from gbid.recording.text_files import FileColumn, pick_column, split_reference


def read_mdf(path: Path, references: Sequence[str]) -> dict[str, FileColumn]:
    """Return the named channels of an MDF file in their physical values, with units and sample times.

    A channel is named ``group/channel``, where the group is its number from 0 or its acquisition name, or by its own
    name where only one group has it.

    Raises
    ------
    DataError
        When the file is damaged or not MDF, when a channel is missing or holds no numbers, or when samples are marked
        as invalid.
    UsageError
        When asammdf is not installed.
    """
    columns = {}
    with _opened(path) as file:
        known = _places(file)
        for reference in references:
            signal = _signal(file, _find(path, known, split_reference(reference)[0]))
            bad = _invalid(signal)
            if bad.size:
                raise DataError(
                    f"{path}: column {reference!r}: {bad.size} samples are marked as invalid, the first at sample "
                    f"{bad[0]}; leave those samples out"
                )
            columns[reference] = FileColumn(
                pick_column(path, reference, signal.samples), signal.unit or None, even_step(signal.timestamps)
            )
    return columns


def mdf_channels(path: Path) -> list[FileChannel]:
    """Return the channels of an MDF file.

    Raises
    ------
    DataError
        When the file is damaged or not MDF.
    UsageError
        When asammdf is not installed.
    """
    channels = []
    with _opened(path) as file:
        names: dict[tuple[int, int], str] = {}
        for name, places in _places(file).items():
            for place in places if len(places) == 1 else ():
                names.setdefault(place, name)  # the shortest name that stands for one channel
        for place, name in sorted(names.items()):
            signal = _signal(file, place)
            step = even_step(signal.timestamps)
            channels += array_channels(name, signal.samples, unit=signal.unit or None, sample_time=step)
    return channels


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Return the open file; what its damage raises becomes a DataError."""
    asammdf = extra_package("asammdf", "mdf", f"{path}: an MDF file")
    with path.open("rb") as handle:
        if handle.read(3) not in (b"MDF", b"UnF"):
            raise DataError(f"{path}: not an MDF file (empty or of another format)")
        handle.seek(0)
        try:
            with asammdf.MDF(handle) as file:
                yield file
        except DataError:
            raise
        except Exception as error:  # a damaged file can raise any kind of error in the reader
            _close_half_opened(error)
            raise DataError(f"{path}: not a readable MDF file (truncated or damaged): {error}") from None


def _close_half_opened(error: Exception) -> None:
    """Close readers that failed on opening: their finalizer fails otherwise, and prints that on standard error.

    They are in the frames of the error only.
    """
    trace = error.__traceback__
    while trace is not None:
        reader: Any = trace.tb_frame.f_locals.get("self")
        if hasattr(reader, "_closed"):
            reader._closed = True
            if getattr(reader, "_tempfile", None) is not None:
                reader._tempfile.close()
        trace = trace.tb_next


def _places(file: Any) -> dict[str, list[tuple[int, int]]]:
    """Return the places (group, channel) of each name: own names, then with the group's name, then with its number."""
    own: dict[str, list[tuple[int, int]]] = {}
    by_group: dict[str, list[tuple[int, int]]] = {}
    for g, group in enumerate(file.groups):
        named = getattr(group.channel_group, "acq_name", "") or ""
        for c, channel in enumerate(group.channels):
            own.setdefault(channel.name, []).append((g, c))
            for prefix in (named, str(g)):
                if prefix:
                    by_group.setdefault(f"{prefix}/{channel.name}", []).append((g, c))
    return {**own, **by_group}


def _find(path: Path, known: dict[str, list[tuple[int, int]]], name: str) -> tuple[int, int]:
    places = known.get(name)
    if places is None:
        raise DataError(f"{path}: no channel {name!r}; {nearest(name, known)}")
    if len(places) > 1:
        last = name.rpartition("/")[2]
        listed = ", ".join(f"{group}/{last}" for group, _ in places)
        raise DataError(f"{path}: channel {name!r} may be any of {listed}; give group and channel")
    return places[0]


def _signal(file: Any, place: tuple[int, int]) -> Any:
    return file.get(group=place[0], index=place[1], ignore_invalidation_bits=True)


def _invalid(signal: Any) -> np.ndarray[Any, Any]:
    bits = signal.invalidation_bits
    return np.zeros(0, int) if bits is None else np.flatnonzero(bits)


FORMAT = FileFormat((".mf4", ".mdf"), read_mdf, mdf_channels, states_sample_time=True, may_crash=True)
