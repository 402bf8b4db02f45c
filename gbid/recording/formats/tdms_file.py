"""Reader of TDMS files of LabVIEW and FlexLogger, by nptdms."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gbid.core.errors import DataError
from gbid.core.extras import extra_package
from gbid.recording.mapping import nearest
from gbid.recording.readers import FileChannel, FileFormat, array_channels
from gbid.recording.text_files import FileColumn, pick_column, seconds, split_reference

_UNITS = ("unit_string", "NI_UnitDescription", "Unit", "unit")


def read_tdms(path: Path, references: Sequence[str]) -> dict[str, FileColumn]:
    """Return the named channels of a TDMS file, scaled, with their units and sample times.

    A channel is named ``group/channel``, or by its own name where only one group has it.

    Raises
    ------
    DataError
        When the file is damaged, truncated or not TDMS, or when a channel is missing or holds no numbers.
    UsageError
        When nptdms is not installed.
    """
    columns = {}
    with _opened(path) as file:
        known = _channels(file)
        for reference in references:
            channel = _find(path, known, split_reference(reference)[0])
            columns[reference] = FileColumn(
                pick_column(path, reference, _values(channel)), _unit(channel), _sample_time(channel)
            )
    return columns


def tdms_channels(path: Path) -> list[FileChannel]:
    """Return the channels of a TDMS file.

    Raises
    ------
    DataError
        When the file is damaged, truncated or not TDMS.
    UsageError
        When nptdms is not installed.
    """
    with _opened(path) as file:
        return [
            listed
            for name, channel in _channels(file).items()
            for listed in array_channels(name, _values(channel), unit=_unit(channel), sample_time=_sample_time(channel))
        ]


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Return the open file; what its damage raises becomes a DataError."""
    nptdms = extra_package("nptdms", "tdms", f"{path}: a TDMS file")
    with path.open("rb") as handle:
        if handle.read(4) != b"TDSm":
            raise DataError(f"{path}: not a TDMS file (empty or of another format)")
        handle.seek(0)
        try:
            with nptdms.TdmsFile.open(handle) as file:
                if file.file_status.incomplete_final_segment:
                    raise DataError(f"{path}: truncated: its last segment is not complete; copy or record it again")
                if not _channels(file):
                    raise DataError(f"{path}: holds no channels; is it truncated?")
                yield file
        except DataError:
            raise
        except Exception as error:  # a damaged file can raise any kind of error in the reader
            raise DataError(f"{path}: not a readable TDMS file (truncated or damaged): {error}") from None


def _channels(file: Any) -> dict[str, Any]:
    return {f"{group.name}/{channel.name}": channel for group in file.groups() for channel in group.channels()}


def _find(path: Path, known: dict[str, Any], name: str) -> Any:
    if name in known:
        return known[name]
    found = [full for full, channel in known.items() if channel.name == name]
    if len(found) > 1:
        raise DataError(f"{path}: channel {name!r} may be any of {', '.join(found)}; give group and channel")
    if not found:
        raise DataError(f"{path}: no channel {name!r}; {nearest(name, known)}")
    return known[found[0]]


def _values(channel: Any) -> Any:
    values = channel[:]
    return seconds(values) if getattr(values, "dtype", None) is not None and values.dtype.kind in "mM" else values


def _unit(channel: Any) -> str | None:
    return next((str(channel.properties[key]) for key in _UNITS if key in channel.properties), None)


def _sample_time(channel: Any) -> float | None:
    """Return the increment of a waveform [s]; channels without time have the increment 0 or none."""
    step = channel.properties.get("wf_increment")
    return float(step) if isinstance(step, float | int) and step > 0 else None


FORMAT = FileFormat((".tdms",), read_tdms, tdms_channels, states_sample_time=True, may_crash=True)
