"""Exit code of a verb, and its messages about failed items."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import typer

from gbid.cli.telling import tell
from gbid.errors import DataError, GbidError, NotConvergedError, ThresholdError, UsageError
from gbid.experiment.run.outcome import Outcome

_MISSED = 20  # largest number of pairs below the minimum that are listed
_IDLE = 20  # largest number of items without input that are listed


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


def finish(outcomes: Sequence[Outcome], validated: Sequence[Mapping[str, Any]] = ()) -> None:
    """List failed items on standard error and end with the exit code: the lowest that applies, or 0.

    Parameters
    ----------
    outcomes : sequence of Outcome
        Outcomes of the verb.
    validated : sequence of dict
        Rows of cross-validations as documents.
    """
    failed = [o for o in outcomes if o.state == "failed"]
    stuck = [o for o in outcomes if o.state != "failed" and not o.converged]
    missed = [row for row in validated if row["missed"]]
    idle = [o for o in failed if o.cause == "input"]
    if len(idle) > _IDLE:
        for stage, count in Counter(o.stage for o in idle).items():
            tell(f"gbid: error: {stage}: the input of {count} items is missing; see the failures")
    for o in failed if len(idle) <= _IDLE else [o for o in failed if o.cause != "input"]:
        word = "defect" if o.cause == "defect" else "error"
        again = " (failed in an earlier run; use --retry to try again)" if o.before else ""
        tell(f"gbid: {word}: {o.stage} {o.item}: {o.text}{again}")
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
    causes = {o.cause for o in failed}
    for cause, code in (("defect", GbidError.exit_code), ("usage", UsageError.exit_code)):
        if cause in causes:
            raise typer.Exit(code)
    for found, error in ((failed, DataError), (stuck, NotConvergedError), (missed, ThresholdError)):
        if found:
            raise typer.Exit(error.exit_code)
