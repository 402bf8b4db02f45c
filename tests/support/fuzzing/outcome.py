"""What came of one input: a mutated file that was read."""

from __future__ import annotations

import os
import resource
import traceback
from contextlib import ExitStack, suppress
from enum import StrEnum
from pathlib import Path
from random import Random
from typing import Any, NamedTuple
from unittest import mock

from fuzzing.targets import FileOrigin, FuzzTarget, flat
from gbid.core.errors import GbidError

HANG = 20.0
"""Longest processor time [s] for one input, with the reader process."""
_GROWTH, _GROWTH_PER_BYTE = 1 << 30, 10


class InputOutcome(StrEnum):
    """Category of an input; the last five are faults of gbid."""

    EQUAL = "accepted, equal"
    SAID = "accepted, change said"
    OTHER = "accepted, other values"  # of a file without checksum
    REFUSED = "refused with a clear error"
    TRACEBACK = "traceback"
    UNCLEAR = "error without the name of the file"
    HANG = "more than 20 s"
    GROWTH = "more than 1 GB and ten times the file"
    SILENT = "silent change"


FAULTS = (InputOutcome.TRACEBACK, InputOutcome.UNCLEAR, InputOutcome.HANG, InputOutcome.GROWTH, InputOutcome.SILENT)


class TriedInput(NamedTuple):
    """Outcome of an input with its time [s], the growth of memory [bytes], and what was said or raised."""

    outcome: InputOutcome
    seconds: float
    growth: int
    text: str


def choose(targets: list[FuzzTarget], random: Random) -> FuzzTarget:
    """Return a target, drawn by weight."""
    place = random.randrange(sum(target.weight for target in targets))
    for target in targets:
        place -= target.weight
        if place < 0:
            return target
    raise AssertionError


def try_input(target: FuzzTarget, content: bytes, folder: Path) -> TriedInput:
    """Read a file with the given bytes, and return what came of it."""
    path = folder / f"a{target.ending}"
    path.write_bytes(content)
    for ending, other in target.beside.items():
        path.with_suffix(ending).write_bytes(other)
    memory = MemoryOfProcess()
    began, text = _processor_time(), ""
    try:
        with ExitStack() as stack:
            if target.origin is FileOrigin.FOREIGN and target.ending != ".yaml":
                for parser in _PARSERS:  # the reader process is a new one, and has its own
                    stack.enter_context(mock.patch(parser, side_effect=AssertionError("parsed in the parent process")))
            value, notes = target.read(path)
    except GbidError as error:
        text = str(error)
        outcome = InputOutcome.REFUSED if path.name in text else InputOutcome.UNCLEAR
    except Exception:
        outcome, text = InputOutcome.TRACEBACK, traceback.format_exc()
    else:
        text = "; ".join(notes)
        outcome = _accepted(target, content, flat(value), bool(notes), folder)
    seconds, growth = _processor_time() - began, memory.growth()
    if seconds > HANG:
        outcome = InputOutcome.HANG
    elif growth > _GROWTH + _GROWTH_PER_BYTE * len(content):
        outcome = InputOutcome.GROWTH
    return TriedInput(outcome, seconds, growth, text)


_GOOD: dict[str, Any] = {}


def _accepted(target: FuzzTarget, content: bytes, value: Any, said: bool, folder: Path) -> InputOutcome:
    if target.name not in _GOOD:
        path = folder / f"a{target.ending}"
        path.write_bytes(target.content)
        _GOOD[target.name] = flat(target.read(path)[0])
    if value == _GOOD[target.name]:
        return InputOutcome.EQUAL
    if said:
        return InputOutcome.SAID
    without = target.ending != ".h5" and b"gbid sha256" not in content  # such a text is one that a person wrote
    sealed = target.origin is FileOrigin.SEALED or (target.origin is FileOrigin.OWN and not without)
    return InputOutcome.SILENT if sealed else InputOutcome.OTHER


_PARSERS = ("gbid.recording.readers._opened", "gbid.recording.text_files.read_text", "h5py.h5f.open")


def _processor_time() -> float:
    """Return the processor time of this process and its children, also of those that ended [s]."""
    ended, total = resource.getrusage(resource.RUSAGE_CHILDREN), 0
    for process in _family():
        try:
            fields = Path(f"/proc/{process}/stat").read_text(errors="replace").rpartition(")")[2].split()
        except OSError:
            continue
        total += int(fields[11]) + int(fields[12])
    return ended.ru_utime + ended.ru_stime + total / os.sysconf("SC_CLK_TCK")


class MemoryOfProcess:
    """Memory of this process and of its children from now on, where the system tells it."""

    def __init__(self) -> None:
        self._before: dict[int, int] = {}
        for process in _family():
            try:
                Path(f"/proc/{process}/clear_refs").write_text("5")
                self._before[process] = _status(process, b"VmRSS:")
            except OSError:
                continue

    def growth(self) -> int:
        """Return the largest memory since the start beyond that at the start [bytes], of all processes together."""
        total = 0
        for process in _family():
            try:
                total += max(0, _status(process, b"VmHWM:") - self._before.get(process, _status(process, b"VmRSS:")))
            except OSError:
                continue
        return total


def _family() -> list[int]:
    process, children = os.getpid(), list[str]()
    for task in Path(f"/proc/{process}/task").glob("*/children"):  # a thread of its own starts the reader process
        with suppress(OSError):
            children += task.read_text().split()
    return [process, *map(int, children)]


def _status(process: int, what: bytes) -> int:
    for line in Path(f"/proc/{process}/status").read_bytes().splitlines():
        if line.startswith(what):
            return int(line.split()[1]) << 10
    return 0
