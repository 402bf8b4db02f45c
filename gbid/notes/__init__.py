"""Kinds of notes on results: each has a code, with an explanation that `gbid explain` and the docs show."""

from gbid.notes.note_kind import Explanation, NoteKind

__all__ = ["Explanation", "NoteKind"]
