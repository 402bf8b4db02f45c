"""Notes on results: a code for each kind, with its meaning and remedy (notes.toml), as `gbid explain` prints them."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from gbid.core.errors import UsageError


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
    warns : bool
        Whether the note questions the result. Other notes tell how it was obtained.
    """

    code: str
    title: str
    meaning: str
    remedy: str
    warns: bool = True


class NoteKind(Enum):
    """Base of the kinds of notes, each with a code. Calling a member with a text returns a note with its code."""

    value: str

    def __call__(self, text: str) -> str:
        """Return the text of a note followed by its code.

        Parameters
        ----------
        text : str
            The note on this result, with its names and numbers.
        """
        return f"{text} [{self.value}]"


class FitNote(NoteKind):
    """Kinds of notes on a fit."""

    ON_BOUND = "GB101"
    NOT_DETERMINED = "GB102"
    SIGN_OPEN = "GB103"
    FAR_BELOW_WHITE = "GB104"
    MAY_COVER_LESS = "GB105"
    NOT_WHITE = "GB106"
    NO_MINIMUM = "GB107"
    NOT_USED = "GB108"
    OVERFLOWS = "GB109"
    PREDICTOR_AT_EDGE = "GB110"
    OTHER_MINIMUM = "GB111"
    BEGUN_ELSEWHERE = "GB112"
    WINDOWS_CHANGED = "GB113"
    STARTS_FROM_DATA = "GB114"
    STEADY_INPUT = "GB115"
    SLOW_ENGINE = "GB116"
    BEST_DID_NOT_CONVERGE = "GB117"
    JUMPS = "GB118"
    GAIN_HELD = "GB119"
    INTEGRATION = "GB120"
    FEEDBACK = "GB121"
    AT_REST = "GB122"
    LEFT_OUT = "GB123"
    HOLD = "GB124"
    EQUAL_POLES = "GB129"
    MEANS = "GB130"
    PIECES = "GB131"
    SHAFT = "GB132"
    UNITS = "GB133"
    TWINS = "GB134"
    SPIKE = "GB135"
    SAME_INPUTS = "GB136"
    LIKELY_ELSEWHERE = "GB138"
    REDUCED = "GB141"
    DEPENDENT = "GB142"
    BEFORE_CAUSE = "GB143"
    MISSING = "GB144"
    STATES_HELD = "GB145"


class DataNote(NoteKind):
    """Kinds of notes on recordings, prefilter, characterisation and files."""

    SHAFT_STOOD_STILL = "GB201"
    REST_NOT_CHECKED = "GB202"
    SPIKES_LEFT = "GB203"
    OTHER_CONDITION = "GB204"
    SATURATED = "GB205"
    ONE_DIRECTION = "GB206"
    NOT_MOVED = "GB207"
    CHANGED_BY_HAND = "GB208"
    CLIPPED = "GB209"
    ANGLE_JUMPS = "GB210"


class SurfaceNote(NoteKind):
    """Kinds of notes on surfaces over pressure and speed."""

    LEFT_OUT = "GB301"
    LACK_OF_FIT = "GB302"
    NEGATIVE_DELAY = "GB303"
    NOT_SETTLED = "GB304"
    HELD_AT_MEAN = "GB306"
    SCATTER_UNSEEN = "GB307"


class ControlNote(NoteKind):
    """Kinds of notes on designs of controllers, impacts and the chain on a target."""

    UNSTABLE_OPEN_LOOP = "GB401"
    PEAK_NOT_LIMITED = "GB402"
    SAMPLED_LOOP = "GB403"
    NO_STABILISING_GAINS = "GB404"
    LIMITS_EXCEEDED = "GB405"
    NO_CERTIFICATE = "GB406"
    SOLVER_STOPPED = "GB407"
    DOUBLE_HIT = "GB408"
    MODES_ALIKE = "GB409"
    INTERPOLATED = "GB410"
    FURTHER_MODES = "GB411"
    FIT_NOT_CONVERGED = "GB412"
    WORST_POINTS_NOT_SEARCHED = "GB413"
    CLIPPED = "GB414"
    UNMOVED_MODES = "GB415"
    IDLE_GAINS = "GB416"
    NO_OSCILLATION = "GB417"
    BALANCE_UNPROVED = "GB418"


FAMILIES: Mapping[str, type[NoteKind]] = MappingProxyType(
    {"fits": FitNote, "data and files": DataNote, "surfaces": SurfaceNote, "control and impacts": ControlNote}
)
"""The kinds of notes by what they are about."""


@cache
def explanations() -> Mapping[str, Explanation]:
    """Return the explanations of all kinds of notes, by code."""
    import tomllib

    texts = tomllib.loads(Path(__file__).with_name("notes.toml").read_text(encoding="utf-8"))
    return MappingProxyType({code: Explanation(code, **entries) for code, entries in texts.items()})


def families() -> dict[str, tuple[Explanation, ...]]:
    """Return the explanations grouped by subject."""
    return {about: tuple(explanations()[kind.value] for kind in family) for about, family in FAMILIES.items()}


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
    explanation = known.get(code.strip("[] ").upper())
    if explanation is None:
        raise UsageError(f"{code!r} is no code of a note; `gbid explain` lists all, from {min(known)} to {max(known)}")
    return explanation
