"""Arguments that were given in the order of another program."""

from __future__ import annotations

from collections.abc import Sequence

from gbid.errors import UsageError
from gbid.recording.recording import Recording


def check_order(first: object, call: str) -> None:
    """Refuse recordings where a structure or a result is expected: other programs take the data first.

    Parameters
    ----------
    first : object
        First argument of a call.
    call : str
        The call as it should be, for the message.

    Raises
    ------
    UsageError
        When it is a recording or a sequence of them.
    """
    several = first if isinstance(first, Sequence) and first and not isinstance(first, str) else [first]
    if isinstance(several[0], Recording):
        name = several[0].name
        raise UsageError(f"the first argument is the recording {name!r}; the order is the other way round: {call}")
