"""Kind of a note: its code, what it means, and what to do."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple


class Explanation(NamedTuple):
    """Explanation of a kind of notes.

    Attributes
    ----------
    code : str
        ``GB`` and three digits. It never changes, and is never given again.
    title : str
        What the note says, in a few words.
    meaning : str
        Where it comes from, and what it means for the result.
    remedy : str
        What one can do.
    """

    code: str
    title: str
    meaning: str
    remedy: str


class NoteKind(Enum):
    """Base of the kinds of notes. A member is called with the text of a note, and returns it with its code."""

    value: Explanation

    def __call__(self, text: str) -> str:
        """Return the text of a note with its code behind it.

        Parameters
        ----------
        text : str
            The note on this result, with its names and numbers.
        """
        return f"{text} [{self.value.code}]"
