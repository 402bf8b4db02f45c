"""Stage of the cross-validation (paper, Sec. 3.8): models on recordings to which they were not fitted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gbid.errors import DataError
from gbid.experiment.keys import content_key, stored_key
from gbid.experiment.run.failures import Failure, remember_failure, remembered_failure
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Cause, Outcome
from gbid.experiment.run.stage import Stage, Work
from gbid.experiment.stages.crossval.checks import crossval_has_partners
from gbid.experiment.stages.crossval.pairs import FitPairs, Pair
from gbid.experiment.stages.crossval.rows import CrossvalRow, read_rows, rows_table, scores_of_rows
from gbid.tables.csv import write_csv
from gbid.validate import ValidationSummary, load_validation_summary, save_validation_summary, summarise
from gbid.validate.validation_store import summary_csv_table

FOLDER = "crossval"
SUMMARY = "_summary"


def crossval_tasks(job: Job) -> Work:
    """Return one task for each fit, and failed outcomes for pairs whose model or recording is missing."""
    work: list[Task | Outcome] = []
    for name in job.experiment.spec.crossval:
        pairs, path = FitPairs(job, name), _path(job, name)
        work += [_failed(job, name, pair, text, "input") for pair, text in pairs.missing.items()]
        if pairs.there:
            work.append(Task("crossval", name, path, pairs.key, _write_table))
    return work


def crossval_rows(job: Job) -> list[CrossvalRow]:
    """Return the existing rows of all cross-validated fits."""
    return [row for name in job.experiment.spec.crossval for row in read_crossval(job, name)]


def read_crossval(job: Job, name: str) -> list[CrossvalRow]:
    """Return the rows of the cross-validation of a fit; empty unless they are made from the present results."""
    pairs, path = FitPairs(job, name), _path(job, name)
    if not pairs.there or not path.is_file() or stored_key(path) != pairs.key:
        return []
    return read_rows(job, name, path)


def read_summary(job: Job, name: str) -> ValidationSummary | None:
    """Return the summary of the cross-validation of a fit; None unless it is made from the existing rows."""
    path = job.path(FOLDER, f"{name}{SUMMARY}")
    if not path.is_file():
        return None
    summary = load_validation_summary(path)
    return summary if stored_key(path) == _summary_key(summary.failed, stored_key(_path(job, name))) else None


def _path(job: Job, name: str) -> Path:
    return job.path(FOLDER, name, ".csv")


def _item(job: Job, name: str, pair: Pair, key: str = "") -> Task:
    """Return the task under which the failure of a pair is recorded."""
    model, recording = pair
    return Task("crossval", f"{name}/{model} on {recording}", _path(job, name), key, _write_table)


def _failed(job: Job, name: str, pair: Pair, text: str, cause: Cause) -> Outcome:
    item = _item(job, name, pair)
    return Outcome(item.stage, item.item, item.path, "failed", text, cause=cause)


def _write_table(job: Job, name: str, part: Path) -> None:
    """Write the rows of all pairs; pairs without rows are recorded as failed."""
    pairs = FitPairs(job, name)
    rows, failed = pairs.rows()
    for pair, text in failed.items():
        key = pairs.key_of(pair)
        remember_failure(job, _item(job, name, pair, key), Failure(key, "data", text))
    if not rows:
        first = next(iter(failed.values()))
        raise DataError(f"no model can be validated; the first of {len(failed)} pairs: {first}")
    write_csv(rows_table(rows), part, [f"content_key: {pairs.key}"])


def _failed_pairs(job: Job, name: str, pairs: FitPairs, rows: Sequence[CrossvalRow]) -> dict[Pair, str]:
    """Return the possible pairs without rows, with the reason."""
    done = {(row.model, row.recording) for row in rows}
    found = {}
    for pair in pairs.there:
        if pair not in done:
            failure = remembered_failure(job, _item(job, name, pair, pairs.key_of(pair)))
            found[pair] = failure.text if failure else "failed in an earlier run; run again with --overwrite"
    return found


def _summary_work(job: Job, made: Sequence[Outcome]) -> Work:
    """Return failed outcomes of pairs without rows, and the tasks of the summaries."""
    work: list[Task | Outcome] = []
    for outcome in made:
        name = outcome.item
        if outcome.state == "failed" or name not in job.experiment.spec.crossval:
            continue
        pairs = FitPairs(job, name)
        failed = _failed_pairs(job, name, pairs, read_rows(job, name, outcome.path))
        work += [_failed(job, name, pair, text, "data") for pair, text in failed.items()]
        key = _summary_key(_texts({**pairs.missing, **failed}), pairs.key)
        for ending, write in ((".h5", _write_summary), (".csv", _write_summary_csv)):
            path = job.path(FOLDER, f"{name}{SUMMARY}", ending)
            work.append(Task("crossval", f"{name}{SUMMARY}{ending}", path, key, write))
    return work


def _summary_key(failed: Sequence[str], rows_key: str) -> str:
    return content_key("summary", {"failed": list(failed)}, [rows_key])


def _texts(failed: dict[Pair, str]) -> list[str]:
    return [f"{model} on {recording}: {text}" for (model, recording), text in failed.items()]


def _summary(job: Job, item: str) -> tuple[ValidationSummary, str]:
    """Return the summary of a fit's table and its content key."""
    name = Path(item).stem.removesuffix(SUMMARY)
    pairs, rows = FitPairs(job, name), read_rows(job, name, _path(job, name))
    failed = _texts({**pairs.missing, **_failed_pairs(job, name, pairs, rows)})
    return summarise(scores_of_rows(job, rows), failed=failed), _summary_key(failed, pairs.key)


def _write_summary(job: Job, item: str, part: Path) -> None:
    save_validation_summary(_summary(job, item)[0], part, overwrite=True)


def _write_summary_csv(job: Job, item: str, part: Path) -> None:
    summary, key = _summary(job, item)
    write_csv(summary_csv_table(summary), part, [f"content_key: {key}"])


CROSSVAL = Stage("crossval", "crossval", (crossval_has_partners,), crossval_tasks, (_summary_work,))
"""``crossval/<fit>.csv`` and its summary, ``<fit>_summary.h5`` and ``.csv``, for each fit that is cross-validated."""
