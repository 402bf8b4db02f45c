"""Notes on recordings, prefilter, characterisation and files, GB201 to GB299."""

from __future__ import annotations

from gbid.notes.note_kind import Explanation, NoteKind


class DataNote(NoteKind):
    """Kinds of notes on data and files."""

    SHAFT_STOOD_STILL = Explanation(
        "GB201",
        "the shaft stood still",
        "Without rotation the run-out map is the mean position alone.",
        "Nothing at 0 rpm; else check the angle signal.",
    )
    REST_NOT_CHECKED = Explanation(
        "GB202",
        "it was not checked that the piezos were at rest",
        "Neither references nor piezo positions are in the recording from which the run-out map is made.",
        "Record r or u as well, or make sure that the piezos did not move.",
    )
    SPIKES_LEFT = Explanation(
        "GB203",
        "spikes were found and left",
        "Single samples lie far from their neighbours.",
        "`spikes: true` in the prefilter replaces them.",
    )
    OTHER_CONDITION = Explanation(
        "GB204",
        "the run-out map was made at another operating point",
        "The conditions of map and recording differ, and any_condition was asked for.",
        "Record the rotor at rest at this operating point and make its own map.",
    )
    SATURATED = Explanation(
        "GB205",
        "a step of the staircase is saturated",
        "The position rests at the smallest or largest value there.",
        "Use a smaller range of commands; the step is left out.",
    )
    ONE_DIRECTION = Explanation(
        "GB206",
        "the staircase goes in one direction only",
        "The hysteresis shows only where the position is reached from both sides.",
        "Record a staircase up and down.",
    )
    NOT_MOVED = Explanation(
        "GB207",
        "no recording moves an input",
        "Its static gains are not known.",
        "Record a staircase of this input.",
    )
    CHANGED_BY_HAND = Explanation(
        "GB208",
        "a file was changed after gbid wrote it",
        "The checksum in the file is not that of its lines. The contents are used as they are now.",
        "Nothing, if it was you. Else write the file anew.",
    )
