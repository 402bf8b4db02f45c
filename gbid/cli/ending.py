"""Exit code of a verb, and its messages about failed items."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import typer

from gbid.cli.causes import causes_in_words
from gbid.cli.telling import tell
from gbid.errors import DataError, GbidError, NotConvergedError, ThresholdError, UsageError
from gbid.experiment.run.outcome import Outcome

_MISSED = 20  # largest number of pairs below the minimum that are listed
_CODES = {"defect": GbidError.exit_code, "usage": UsageError.exit_code}


def outcome_rows(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Return outcomes as plain rows."""
    return [
        {
            "stage": o.stage,
            "item": o.item,
            "state": o.state,
            "path": str(o.path),
            "converged": o.converged,
            "text": o.text,
            "cause": o.cause,
            "failed_before": o.before,
        }
        for o in outcomes
    ]


def finish(outcomes: Sequence[Outcome], validated: Sequence[Mapping[str, Any]] = (), advice: str = "") -> None:
    """Say on standard error what failed, and end with the exit code: the lowest that applies, or 0.

    The last line is the first cause. Results whose inputs failed in this run have no lines of their own.

    Parameters
    ----------
    outcomes : sequence of Outcome
        Outcomes of the verb.
    validated : sequence of dict
        Rows of cross-validations as documents.
    advice : str
        Command to give next when all went well; empty for none.
    """
    failed = [o for o in outcomes if o.state == "failed"]
    stuck = [o for o in outcomes if o.state != "failed" and not o.converged]
    missed = [row for row in validated if row["missed"]]
    code = _exit_code(failed, stuck, missed)
    for o in stuck:
        tell(f"gbid: error: {o.stage} {o.item}: {o.text} (written to {o.path})")
    for row in sorted(missed, key=lambda row: row["fit_percent"])[:_MISSED]:
        tell(
            f"gbid: error: crossval {row['fit']}: model of {row['model']} on {row['recording']}: "
            f"{row['output']} {row['fit_percent']:.2f} %, below the minimum of {row['minimum_percent']:g} %; "
            "look at its figures (`residuals: true`), or lower minimum_percent"
        )
    if len(missed) > _MISSED:
        tell(f"gbid: error: crossval: {len(missed)} pairs below the minimum; the worst are listed")
    for line in causes_in_words(failed, code, _CODES):
        tell(f"gbid: {line}")
    if code:
        raise typer.Exit(code)
    if advice:
        tell(f"next: {advice}")


def _exit_code(failed: Sequence[Outcome], stuck: Sequence[Outcome], missed: Sequence[Mapping[str, Any]]) -> int:
    found = [_CODES.get(o.cause, DataError.exit_code) for o in failed]
    found += [NotConvergedError.exit_code] * bool(stuck) + [ThresholdError.exit_code] * bool(missed)
    return min(found, default=0)
