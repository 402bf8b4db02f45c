"""What is wrong with a recording although it is well formed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from gbid.recording.recording import FloatArray, Recording

MIN_SAMPLES = 100
"""Fewer samples than this identify nothing."""
MIN_RUN = 5
"""Samples in a row at the extreme value that count as a stay there."""
MAX_STAY = 0.01
"""Share of the samples in such stays above which a channel is called saturated."""
FEW_LEVELS = 16
"""A channel with no more distinct values is a test signal with levels (PRBS), not a clipped one."""
PILE = 5.0
"""A clipped level holds this many times the samples of the level next to it. The crest of a sine read by a
coarse converter holds at most 1 / (sqrt(2) - 1) = 2.4 times as many, whatever its amplitude."""


@dataclass(frozen=True)
class SignalProblem:
    """One thing that is wrong with a recording.

    Attributes
    ----------
    signal, channel : str
        Where; both empty when it concerns the whole recording.
    kind : str
        ``"constant"``, ``"saturated"`` or ``"too_few_samples"``.
    text : str
        One sentence with the numbers and what to do.
    """

    signal: str
    channel: str
    kind: Literal["constant", "saturated", "too_few_samples"]
    text: str


def find_problems(rec: Recording, signals: Iterable[str] | None = None) -> list[SignalProblem]:
    """Look for channels that carry no information or a wrong one.

    A channel is constant when all its samples are equal. It is saturated when more than 1 % of the samples
    lie exactly at its largest or smallest value in runs of at least five, that value is piled up against the
    value next to it, and the channel takes more than 16 distinct values.

    Parameters
    ----------
    rec : Recording
        The recording.
    signals : iterable of str, optional
        Names of the signals to look at; all by default. A shaft angle is rightly constant at standstill.

    Returns
    -------
    list of SignalProblem
        Empty when nothing was found.

    Raises
    ------
    DataError
        When the recording has no signal of a name given.
    """
    problems = []
    if rec.n_samples < MIN_SAMPLES:
        text = (
            f"recording {rec.name!r} has {rec.n_samples} samples, at least {MIN_SAMPLES} are needed; "
            "record longer or cut less away."
        )
        problems.append(SignalProblem("", "", "too_few_samples", text))
    for signal in rec.signals if signals is None else signals:
        values, unit = rec.signal(signal), rec.units[signal]
        for channel, column in zip(rec.channels[signal], values.T, strict=True):
            where = f"recording {rec.name!r}: signal {signal!r} channel {channel!r}"
            if column.min() == column.max():
                text = (
                    f"{where} is constant: all {rec.n_samples} samples are {_with_unit(column[0], unit)}; "
                    "check the cable and the column of the mapping, or leave the signal out."
                )
                problems.append(SignalProblem(signal, channel, "constant", text))
            elif stays := _stays(column):
                count = sum(stays.values())
                at = " and ".join(_with_unit(value, unit) for value in stays)
                text = (
                    f"{where} is saturated: {count} of {rec.n_samples} samples ({count / rec.n_samples:.1%}) "
                    f"stay at its limit {at} for {MIN_RUN} samples or more; lower the excitation or widen "
                    "the range and record again, or cut those samples away."
                )
                problems.append(SignalProblem(signal, channel, "saturated", text))
    return problems


def _with_unit(value: float, unit: str) -> str:
    return f"{value:g} {unit}".rstrip()


def _stays(column: FloatArray) -> dict[float, int]:
    """Count the samples in long runs at the extreme values, empty when the channel is not saturated."""
    levels, counts = np.unique(column, return_counts=True)
    if len(levels) <= FEW_LEVELS:
        return {}
    found = {}
    for extreme, neighbour in ((0, 1), (-1, -2)):
        stay = _in_long_runs(column == levels[extreme])
        if stay and counts[extreme] > PILE * counts[neighbour]:
            found[float(levels[extreme])] = stay
    return found if sum(found.values()) > MAX_STAY * len(column) else {}


def _in_long_runs(at: npt.NDArray[np.bool_]) -> int:
    """Count the true entries in runs of at least MIN_RUN."""
    edges = np.flatnonzero(np.diff(at, prepend=False, append=False))
    lengths = edges[1::2] - edges[::2]
    return int(lengths[lengths >= MIN_RUN].sum())
