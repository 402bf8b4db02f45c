"""Inputs of tasks: they must exist and be made from the present settings."""

from __future__ import annotations

from pathlib import Path

from gbid.errors import DataError, GbidError, UsageError
from gbid.experiment.keys import stored_key
from gbid.experiment.run.outcome import Cause
from gbid.recording import (
    Recording,
    load_recording,
)


class InputError(DataError):
    """Error for an input of a task that is missing or outdated; the task itself is not at fault."""


def load_checked(path: Path, key: str, command: str) -> Recording:
    """Return a recording after a check of its content key.

    Raises
    ------
    DataError
        When the file is missing or was made from other settings.
    """
    check_made(path, key, command)
    return load_recording(path)


def check_made(path: Path, key: str, command: str) -> None:
    """Refuse a file that is missing or was made from other settings.

    Raises
    ------
    InputError
        Its text names the command that makes the file.
    """
    if not path.is_file():
        raise InputError(f"{path}: file is missing; `{command}` makes it")
    found = stored_key(path)
    if not found:
        raise InputError(f"{path}: truncated or not made by an experiment; make it again with `{command} --overwrite`")
    if found != key:
        raise InputError(f"{path}: made from other settings or data; make it again with `{command} --overwrite`")


def cause_of(error: GbidError) -> Cause:
    """Return the kind of cause of an error: a missing input, wrong options, or bad data."""
    if isinstance(error, InputError):
        return "input"
    return "usage" if isinstance(error, UsageError) else "data"
