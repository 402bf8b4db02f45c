"""Causes of results that were not made: what failed first, and what is missing because of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from gbid.experiment.run.outcome import Outcome

_LISTED = 10  # largest number of failures that are listed one by one; all are in the JSON document
_NOUNS = {"rig": "recording", "import": "recording", "prefilter": "recording", "fit": "model", "figure": "figure"}


def is_first_cause(outcome: Outcome) -> bool:
    """Return whether a result failed by itself, not because its input is missing."""
    return outcome.state == "failed" and outcome.cause != "input"


def in_short(failed: Iterable[Outcome]) -> str:
    """Return which results failed by themselves, such as ``import of 6 recordings failed``; empty without any."""
    counts = Counter(outcome.stage for outcome in failed if is_first_cause(outcome))
    return " and ".join(f"{stage} of {counted(stage, count)} failed" for stage, count in counts.items())


def counted(stage: str, count: int) -> str:
    """Return a number of results of a stage in words."""
    return f"{count} {_NOUNS.get(stage, 'result')}{'s' * (count != 1)}"


def not_made(stage: str, count: int, why: str) -> str:
    """Return the line on the results of a stage whose inputs failed or are missing."""
    return f"{stage}: {counted(stage, count)} not made: {why}"


def causes_in_words(failed: Sequence[Outcome], code_of: int, codes: Mapping[str, int]) -> list[str]:
    """Return the lines on what failed by itself; the last one is the first failure with the exit code.

    Results whose inputs failed in the same run are left out: the progress has told of them. Where nothing failed by
    itself, the inputs were missing before, and each stage has a line with the first of its reasons, or
    with the name of its only result.

    Parameters
    ----------
    failed : sequence of Outcome
        Failed outcomes, in the order of the run.
    code_of : int
        Exit code of the command.
    codes : dict of str to int
        Exit code by cause; others are bad data.
    """
    roots = [outcome for outcome in failed if is_first_cause(outcome)]
    if not roots:
        counts = Counter(outcome.stage for outcome in failed)
        firsts = {outcome.stage: outcome for outcome in reversed(failed)}
        return [
            _line(firsts[stage]) if count == 1 else f"error: {not_made(stage, count, firsts[stage].text)}"
            for stage, count in reversed(counts.items())
        ]
    first = next((o for o in roots if codes.get(o.cause) == code_of), roots[0])
    rest = [outcome for outcome in roots if outcome is not first]
    lines = [_line(outcome) for outcome in rest[:_LISTED]]
    if len(rest) > _LISTED:
        lines.append(f"error: {len(rest) - _LISTED} more failed; `--json` lists all")
    return [*lines, _line(first)]


def _line(outcome: Outcome) -> str:
    word = "defect" if outcome.cause == "defect" else "error"
    again = " (failed in an earlier run; use --retry to try again)" if outcome.before else ""
    return f"{word}: {outcome.stage} {outcome.item}: {outcome.text}{again}"
