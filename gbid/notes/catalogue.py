"""All kinds of notes by their codes."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from gbid.errors import UsageError
from gbid.notes.control_notes import ControlNote
from gbid.notes.data_notes import DataNote
from gbid.notes.fit_notes import FitNote
from gbid.notes.model_notes import SurfaceNote
from gbid.notes.note_kind import Explanation, NoteKind

_FAMILIES: Mapping[str, type[NoteKind]] = {
    "fits": FitNote,
    "data and files": DataNote,
    "surfaces": SurfaceNote,
    "control and impacts": ControlNote,
}


def families() -> dict[str, tuple[Explanation, ...]]:
    """Return the explanations by what the notes are about."""
    return {about: tuple(kind.value for kind in family) for about, family in _FAMILIES.items()}


def explanations() -> Mapping[str, Explanation]:
    """Return the explanations by code."""
    return MappingProxyType({found.code: found for group in families().values() for found in group})


def explain(code: str) -> Explanation:
    """Return the explanation of a code.

    Parameters
    ----------
    code : str
        As ``GB102``; small letters and brackets are accepted.

    Raises
    ------
    UsageError
        When there is no such code.
    """
    known = explanations()
    found = known.get(code.strip("[] ").upper())
    if found is None:
        raise UsageError(f"{code!r} is no code of a note; `gbid explain` lists all, from {min(known)} to {max(known)}")
    return found
