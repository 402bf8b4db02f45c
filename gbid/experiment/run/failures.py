"""Record of failures on disk: a resumed run does not repeat failed tasks unless the user asks for it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import get_args

from gbid.atomic import atomic_path
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Cause

FOLDER = "failed"


@dataclass(frozen=True)
class Failure:
    """Cause of the failure of a task.

    Attributes
    ----------
    key : str
        Content key of the missing result. The task is tried again when settings or data change.
    cause : str
        Kind of cause, as in `Outcome`.
    text : str
        Text of the error.
    details : str
        Traceback of a defect, else empty.
    """

    key: str
    cause: Cause
    text: str
    details: str = ""


def failure_path(job: Job, stage: str, item: str) -> Path:
    """Return the path of the record of a failure, ``failed/<stage>/<item>.json``."""
    return job.path(f"{FOLDER}/{stage}", item, ".json")


def remember_failure(job: Job, task: Task, failure: Failure) -> None:
    """Write the record of a failure.

    Raises
    ------
    DataError
        When the record cannot be written.
    """
    when = datetime.now(UTC).isoformat(timespec="seconds")
    document = {"stage": task.stage, "item": task.item, **failure.__dict__, "when": when}
    with atomic_path(failure_path(job, task.stage, task.item), overwrite=True) as part:
        part.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")


def remembered_failure(job: Job, task: Task) -> Failure | None:
    """Return the recorded failure of a task with the same settings and data; None without a readable record."""
    try:
        text = failure_path(job, task.stage, task.item).read_text(encoding="utf-8")
        found = json.loads(text)
        failure = Failure(*(str(found[name]) for name in ("key", "cause", "text", "details")))  # type: ignore[arg-type]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return failure if failure.key == task.key and failure.cause in get_args(Cause) else None


def forget_failure(job: Job, task: Task) -> None:
    """Remove the record of a failure, if there is one."""
    failure_path(job, task.stage, task.item).unlink(missing_ok=True)
