"""One thing that is wrong with a recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

ProblemKind = Literal[
    "constant", "saturated", "too_few_samples", "swapped", "dead", "rub", "sample_time", "encoder", "duplicate"
]


@dataclass(frozen=True)
class SignalProblem:
    """One thing that is wrong with a recording.

    Attributes
    ----------
    signal, channel : str
        Where; both empty when it concerns the whole recording, the channel when it concerns all of them.
    kind : str
        ``"constant"``, ``"saturated"``, ``"too_few_samples"``, ``"swapped"`` (channels x and y), ``"dead"`` (a sensor
        that does not answer), ``"rub"`` (the rotor touched the bearing), ``"sample_time"``, ``"encoder"`` or
        ``"duplicate"``.
    text : str
        One sentence with the numbers and what to do.
    """

    signal: str
    channel: str
    kind: ProblemKind
    text: str
