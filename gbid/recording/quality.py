"""Quality checks of a recording: constant, saturated, dead and swapped channels, rub, encoder and clock."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from gbid.arrays import BoolArray, FloatArray
from gbid.recording.quality_problem import ProblemKind, SignalProblem
from gbid.recording.quality_response import find_response_problems
from gbid.recording.quality_rub import find_rub
from gbid.recording.quality_speed import find_speed_changes
from gbid.recording.quality_time import find_clock_problems, find_encoder_faults
from gbid.recording.recording import Recording

MIN_SAMPLES = 100
"""Smallest number of samples that can be used for identification."""
MIN_RUN = 5
"""Number of consecutive samples at the extreme value that make a run."""
MAX_STAY = 0.01
"""A channel is called saturated when a larger share of its samples lies in such runs."""
FEW_LEVELS = 16
"""A channel with at most this number of distinct values is a test signal with levels (PRBS), not a clipped signal."""
PILE = 5.0
"""A clipped level occurs at least this many times as often as the level next to it. The crest of a sine that is read
by a coarse converter occurs at most 1 / (sqrt(2) - 1) = 2.4 times as often, at any amplitude."""


def find_problems(
    rec: Recording, signals: Iterable[str] | None = None, kinds: Sequence[ProblemKind] | None = None
) -> list[SignalProblem]:
    """Return the quality problems of a recording.

    A channel is constant when all its samples are equal. It is saturated when three conditions hold: more than 1 % of
    the samples are exactly at its largest or smallest value in runs of at least five; this value is much more
    frequent than the next one; and the channel takes more than 16 distinct values.

    Recordings of r, u and p with moving piezos get further checks. u and p must respond to the reference, and each
    axis more to its own reference than to the other (`gbid.recording.quality_response`). p must not show impacts on the
    bearing (`gbid.recording.quality_rub`). phi must turn without jumps and at the stated speed
    (`gbid.recording.quality_time`), which must not change (`gbid.recording.quality_speed`). No check needs a model.

    Parameters
    ----------
    rec : Recording
        The recording.
    signals : iterable of str, optional
        Names of the signals to check; all by default. A shaft angle may be constant at standstill.
    kinds : collection of str, optional
        Kinds of problems to look for; all by default.

    Returns
    -------
    list of SignalProblem
        Empty when there are no problems.

    Raises
    ------
    DataError
        When the recording has no signal of a given name.
    """
    problems: list[SignalProblem] = []
    looked_at = list(rec.signals if signals is None else signals)
    if rec.n_samples < MIN_SAMPLES:
        text = (
            f"recording {rec.name!r} has {rec.n_samples} samples, at least {MIN_SAMPLES} are needed; "
            "record longer or cut less away."
        )
        problems.append(SignalProblem("", "", "too_few_samples", text))
    for signal in looked_at:
        values, unit = rec.signal(signal), rec.units[signal]
        for channel, column in zip(rec.channels[signal], values.T, strict=True):
            where = f"recording {rec.name!r}: signal {signal!r} channel {channel!r}"
            if column.min() == column.max():
                text = (
                    f"{where} is constant: all {rec.n_samples} samples are {_with_unit(column[0], unit)}; a dead "
                    "sensor, a loose cable or the wrong column of the mapping: correct it, or leave the signal out."
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
    for about, own, find in _FINDERS:
        if (kinds is None or set(own) & set(kinds)) and (not about or set(about) & set(looked_at)):
            problems += [problem for problem in find(rec) if not problem.signal or problem.signal in looked_at]
    return [problem for problem in problems if kinds is None or problem.kind in kinds]


def _find_rub(rec: Recording) -> Iterator[SignalProblem]:
    """Find a rub, without the shaft angle when the encoder has faults."""
    if "phi" in rec.signals and any(find_encoder_faults(rec)):
        rec = replace(rec, signals={name: values for name, values in rec.signals.items() if name != "phi"})
    return find_rub(rec)


_Finder = tuple[tuple[str, ...], tuple[ProblemKind, ...], Callable[[Recording], Iterator[SignalProblem]]]
# For each check: the signals it concerns (none: the whole recording), the kinds of problems, and the function.
_FINDERS: tuple[_Finder, ...] = (
    (("r", "u", "p"), ("dead", "swapped"), find_response_problems),
    (("p",), ("rub",), _find_rub),
    (("phi",), ("encoder",), find_encoder_faults),
    ((), ("sample_time",), find_clock_problems),
    ((), ("speed",), find_speed_changes),
)


def _with_unit(value: float, unit: str) -> str:
    return f"{value:g} {unit}".rstrip()


def _stays(column: FloatArray) -> dict[float, int]:
    """Return the number of samples in long runs at each extreme value; empty when the channel is not saturated."""
    levels, counts = np.unique(column, return_counts=True)
    if len(levels) <= FEW_LEVELS:
        return {}
    stays = {}
    for extreme, neighbour in ((0, 1), (-1, -2)):
        stay = _in_long_runs(column == levels[extreme])
        if stay and counts[extreme] > PILE * counts[neighbour]:
            stays[float(levels[extreme])] = stay
    return stays if sum(stays.values()) > MAX_STAY * len(column) else {}


def _in_long_runs(at: BoolArray) -> int:
    """Return the number of true entries in runs of at least MIN_RUN."""
    edges = np.flatnonzero(np.diff(at, prepend=False, append=False))
    lengths = edges[1::2] - edges[::2]
    return int(lengths[lengths >= MIN_RUN].sum())
