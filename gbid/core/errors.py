"""Errors and warnings for users; each error has the exit code of the command line.

Exit codes: 0 fine, 1 a defect of ours, 2 wrong usage or YAML, 3 bad data, 4 not converged,
5 a validation threshold missed, 130 interrupted.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator


class GbidError(Exception):
    """Base of all errors that gbid raises on purpose. The text names file, field, value and what to do."""

    exit_code = 1
    key = ""
    """What in the input is wrong; empty where the error is about no single argument or key."""


class UsageError(GbidError, ValueError):
    """A wrong argument, option or experiment file; `key` is the argument, or the key of a section."""

    exit_code = 2

    def __init__(self, text: str = "", key: str = "") -> None:
        super().__init__(text)
        self.key = key


class NoValueAtStartError(UsageError):
    """Start values at which the equations have no finite value, or are too stiff for the integrator."""


class DataError(GbidError, ValueError):
    """Recordings or result files that cannot be used."""

    exit_code = 3


class NoSpaceError(DataError):
    """The disk or the quota is full, or the drive fails. Files that were already complete are kept."""


class NotConvergedError(GbidError):
    """A fit that a command needs did not converge."""

    exit_code = 4


class ThresholdError(GbidError):
    """A validation threshold of the experiment was missed."""

    exit_code = 5


class ChangedFileWarning(UserWarning):
    """A file was changed after gbid wrote it, and the loaded value has no field for notes."""


class ExtrapolationWarning(UserWarning):
    """A model is evaluated outside the domain it was identified on."""


def from_interrupt(error: BaseException) -> bool:
    """Return whether the cause of an error is a Ctrl-C.

    CasADi makes a RuntimeError of a Ctrl-C within one of its callbacks. A library that ends its work on the way out may
    fail in turn, and Python then keeps the KeyboardInterrupt as the context of that failure.
    """
    return any(isinstance(origin, KeyboardInterrupt) or "KeyboardInterrupt" in str(origin) for origin in origins(error))


def origins(error: BaseException) -> Iterator[BaseException]:
    """Return an error and its chain of causes and contexts, latest first."""
    current: BaseException | None = error
    while current is not None:
        yield current
        current = current.__cause__ or current.__context__


_LISTED, _FIRST = 30, 8  # longest list of names that is shown in full; number of names shown of a longer one


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a hint for an unknown name: the most similar known name, and the known names (the first of many)."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1)
    meant = f"did you mean {close[0]!r}? " if close else ""
    listed, more = (known, 0) if len(known) <= _LISTED else (known[:_FIRST], len(known) - _FIRST)
    return f"{meant}choose from {', '.join(listed)}{f' and {more} more' if more else ''}" if known else "there are none"
