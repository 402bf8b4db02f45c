"""Quality checks across recordings: equal content under two names, and a sample time unlike the others."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable

import numpy as np

from gbid.recording.quality_problem import SignalProblem
from gbid.recording.recording import Recording

MAX_LEVELS = 4
"""A command with at most this number of distinct values is a test signal with held levels (PRBS)."""


def content_digest(rec: Recording) -> str:
    """Return the sha256 of all signals, bit for bit; it does not depend on the name of the recording."""
    digest = hashlib.sha256()
    for name in sorted(rec.signals):
        digest.update(f"{name}{rec.signal(name).shape}".encode())
        digest.update(np.ascontiguousarray(rec.signal(name)).tobytes())
    return digest.hexdigest()


def find_group_problems(recordings: Iterable[Recording]) -> dict[str, list[SignalProblem]]:
    """Return the problems that show only when the recordings of one experiment are compared.

    Two recordings with equal samples are duplicates; the second one is reported. When most recordings hold their
    command r for the same time, a recording that holds it for the same number of samples but another time has a wrong
    sample time.

    Parameters
    ----------
    recordings : iterable of Recording
        They are read one after the other, so a generator saves memory.

    Returns
    -------
    dict of str to list of SignalProblem
        By name of the recording; only recordings with problems are listed.
    """
    first: dict[str, str] = {}
    holds: dict[str, tuple[int, float]] = {}
    found: dict[str, list[SignalProblem]] = {}
    for rec in recordings:
        digest = content_digest(rec)
        if digest in first:
            text = (
                f"recording {rec.name!r} holds the same samples as {first[digest]!r}; leave one of them out, or "
                "correct its file."
            )
            found.setdefault(rec.name, []).append(SignalProblem("", "", "duplicate", text))
        first.setdefault(digest, rec.name)
        hold = _hold(rec)
        if hold:
            holds[rec.name] = hold, rec.sample_time
    for name, text in _odd_clocks(holds):
        found.setdefault(name, []).append(SignalProblem("", "", "sample_time", text))
    return found


def _hold(rec: Recording) -> int:
    """Return the smallest number of samples for which a command with few levels is held; 0 without such a command."""
    if "r" not in rec.signals:
        return 0
    shortest = []
    for column in rec.signal("r").T:
        changes = np.flatnonzero(np.diff(column))
        if len(changes) >= 10 and len(np.unique(column)) <= MAX_LEVELS:
            shortest.append(int(np.gcd.reduce(np.diff(changes))))
    return min(shortest, default=0)


def _odd_clocks(holds: dict[str, tuple[int, float]]) -> list[tuple[str, str]]:
    """Return recordings whose command is held for the usual number of samples but for another time, with a text."""
    times = Counter(f"{samples * step:.6g}" for samples, step in holds.values())
    if not times:
        return []
    usual, count = times.most_common(1)[0]
    samples_of_usual = {samples for samples, step in holds.values() if f"{samples * step:.6g}" == usual}
    odd = []
    for name, (samples, step) in holds.items():
        if count >= 2 and f"{samples * step:.6g}" != usual and samples in samples_of_usual:
            text = (
                f"recording {name!r}: sample_time_s = {step:g} s is unlike the others': r is held for {samples} "
                f"samples as theirs, which is {samples * step:g} s and not {usual} s; a sample time of "
                f"{float(usual) / samples:.4g} s would fit."
            )
            odd.append((name, text))
    return odd
