"""One quality problem of a recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

ProblemKind = Literal[
    "constant", "saturated", "too_few_samples", "swapped", "dead", "rub", "sample_time", "encoder", "duplicate", "speed"
]


@dataclass(frozen=True)
class SignalProblem:
    """One quality problem of a recording.

    Attributes
    ----------
    signal, channel : str
        Place of the problem. Both are empty when it concerns the whole recording; `channel` is empty when it concerns
        all channels.
    kind : str
        ``"constant"``, ``"saturated"``, ``"too_few_samples"``, ``"swapped"`` (channels x and y), ``"dead"`` (a sensor
        that does not respond), ``"rub"`` (the rotor touched the bearing), ``"sample_time"``, ``"encoder"``,
        ``"duplicate"`` or ``"speed"`` (a run-up).
    text : str
        One sentence with the numbers and what to do.
    """

    signal: str
    channel: str
    kind: ProblemKind
    text: str
