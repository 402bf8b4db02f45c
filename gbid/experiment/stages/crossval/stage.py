"""Stage that cross-validates (paper, Sec. 3.8): models on recordings that they were not fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from gbid.errors import DataError
from gbid.experiment.keys import content_key, is_current, stored_key
from gbid.experiment.run.job import Job
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.perform import produce
from gbid.experiment.stages.crossval.pairing import (
    check_fit_input,
    check_model,
    data_key,
    left_out_of,
    residuals_on,
    with_local,
)
from gbid.experiment.stages.crossval.plan import validation_pairs
from gbid.experiment.stages.crossval.rows import COLUMNS, CrossvalRow, read_rows, rows_table, scores_of_rows
from gbid.experiment.stages.fit.stage import load_made_fit, model_key
from gbid.experiment.stages.prefilter.stage import load_fit_input
from gbid.identify import FitResult
from gbid.recording import Recording
from gbid.tables.csv import write_csv
from gbid.validate import ValidationSummary, load_validation_summary, save_validation_summary, summarise
from gbid.validate.crossval import score
from gbid.validate.simulator import Simulator, simulator
from gbid.validate.store import summary_csv_table
from gbid.validate.validation_data import validation_data

FOLDER = "crossval"
SUMMARY = "_summary"
_MANY = 200  # pairs up to which the residuals of each are tested
_MODELS_AT_HAND = 256

Pair = tuple[str, str]


def run_crossval(job: Job) -> tuple[list[Outcome], list[CrossvalRow]]:
    """Write ``crossval/<fit>.csv`` and its summary for each fit that is cross-validated.

    Returns
    -------
    list of Outcome
        The tables and, as ``<fit>_summary.h5`` and ``<fit>_summary.csv``, their summaries; pairs that failed.
    list of CrossvalRow
        Of all fits. A threshold that was missed is a matter of the caller: the results are written.
    """
    outcomes: list[Outcome] = []
    rows: list[CrossvalRow] = []
    for name in job.experiment.spec.crossval:
        made, found = _crossval(job, name)
        outcomes += made
        rows += found
    return outcomes, rows


def read_crossval(job: Job, name: str) -> list[CrossvalRow]:
    """Read the rows of a fit's cross-validation; empty unless they are there, made from the present results."""
    run, path = _Run(job, name), job.path(FOLDER, name, ".csv")
    pairs = [pair for pair in validation_pairs(job.experiment, name) if not run.missing(*pair)]
    if not pairs or not path.is_file():
        return []
    rows = read_rows(job, name, path)
    there = {(row.model, row.recording) for row in rows}
    return rows if stored_key(path) == run.key([pair for pair in pairs if pair in there]) else []


def read_summary(job: Job, name: str) -> ValidationSummary | None:
    """Read the summary of a fit's cross-validation; None unless it is there, made from the rows that are there."""
    path = job.path(FOLDER, f"{name}{SUMMARY}")
    if not path.is_file():
        return None
    summary = load_validation_summary(path)
    key = _summary_key(summary.failed, stored_key(job.path(FOLDER, name, ".csv")))
    return summary if stored_key(path) == key else None


def _summary_key(failed: Sequence[str], rows_key: str) -> str:
    return content_key("summary", {"failed": list(failed)}, [rows_key])


def _crossval(job: Job, name: str) -> tuple[list[Outcome], list[CrossvalRow]]:
    """Validate one fit, or read what is there already."""
    run = _Run(job, name)
    failed: dict[Pair, str] = {}
    pairs = []
    for model, recording in validation_pairs(job.experiment, name):
        text = run.missing(model, recording)
        if text:
            failed[model, recording] = text
        else:
            pairs.append((model, recording))
    path = job.path(FOLDER, name, ".csv")
    rows: list[CrossvalRow] = []
    if pairs and is_current(path, run.key(pairs), job.overwrite):
        rows = read_rows(job, name, path)
    elif pairs:
        rows, broken = run.rows(pairs)
        failed |= broken
    outcomes = []
    for (model, recording), text in failed.items():
        outcomes.append(Outcome("crossval", f"{name}/{model} on {recording}", path, "failed", text, cause="data"))
        job.reporter.end(outcomes[-1])
    if rows:
        key = run.key([pair for pair in pairs if pair not in failed])
        outcomes.append(
            produce(
                job, "crossval", name, path, key, partial(write_csv, rows_table(rows), comments=[f"content_key: {key}"])
            )
        )
        texts = [f"{model} on {recording}: {text}" for (model, recording), text in failed.items()]
        summary, own = summarise(scores_of_rows(job, rows), failed=texts), _summary_key(texts, key)
        for ending, write in ((".h5", _write_summary), (".csv", partial(_write_summary_csv, own))):
            place = job.path(FOLDER, f"{name}{SUMMARY}", ending)
            outcomes.append(produce(job, "crossval", f"{name}{SUMMARY}{ending}", place, own, partial(write, summary)))
    return outcomes, rows


class _Run:
    """The cross-validation of one fit, with what is at hand."""

    def __init__(self, job: Job, name: str) -> None:
        self._job, self._name = job, name
        self._model_keys: dict[str, str] = {}
        self._data_keys: dict[str, str] = {}
        self._missing: dict[tuple[str, str], str] = {}
        self._model = lru_cache(maxsize=_MODELS_AT_HAND)(self._load_model)

    def missing(self, model: str, recording: str) -> str:
        """Say what is not there of a pair, empty when nothing."""
        return self._absent("model", model) or self._absent("recording", recording)

    def key(self, pairs: Sequence[Pair]) -> str:
        """Content key of a table of pairs."""
        for model, recording in pairs:
            if model not in self._model_keys:
                self._model_keys[model] = model_key(self._job.experiment, self._name, model)
            if recording not in self._data_keys:
                self._data_keys[recording] = data_key(self._job.experiment, self._name, recording)
        sources = [f"{self._model_keys[model]} {self._data_keys[recording]}" for model, recording in pairs]
        settings = {"pairs": pairs, "columns": COLUMNS, "residuals": self._residuals(pairs)}
        return content_key("crossval", settings, sources)

    def rows(self, pairs: Sequence[Pair]) -> tuple[list[CrossvalRow], dict[Pair, str]]:
        """Rows of all pairs in their order, and why some failed; each recording is read once."""
        found: dict[Pair, list[CrossvalRow]] = {}
        failed: dict[Pair, str] = {}
        how, tested = self._residuals(pairs), set(dict(reversed(pairs)).items())  # the first pair of each model
        by_recording: dict[str, list[Pair]] = {}
        for pair in pairs:
            by_recording.setdefault(pair[1], []).append(pair)
        for recording, here in by_recording.items():
            try:
                data = load_fit_input(self._job, self._job.experiment.recordings[recording])
            except DataError as error:
                failed |= dict.fromkeys(here, str(error))
                continue
            for pair in here:
                test = how == "pairs" or (how == "models" and pair in tested)
                try:
                    found[pair] = self._rows(pair[0], data, test)
                except DataError as error:
                    failed[pair] = str(error)
        return [row for pair in pairs if pair in found for row in found[pair]], failed

    def _rows(self, model: str, data: Recording, test: bool) -> list[CrossvalRow]:
        fitted, plain = self._model(model)
        if plain.local_names:
            plain = with_local(self._job, self._name, plain, data.name)
            fitted = simulator(plain)
        own = self._data(data, plain)
        percent, largest = score(fitted, own)
        residuals = residuals_on(self._job, self._name, plain, data) if test else None
        return [
            CrossvalRow(
                self._name,
                model,
                data.name,
                output,
                float(percent[i]),
                float(largest[i]),
                own.output_units[i],
                None if residuals is None else float(residuals.p_white[i]),
                None if residuals is None else bool(residuals.white[i]),
                () if residuals is None else residuals.follows[i],
                self._job.experiment.spec.crossval[self._name].minimum_percent,
            )
            for i, output in enumerate(own.output_names)
        ]

    def _data(self, data: Recording, result: FitResult) -> Any:
        if getattr(self, "_last", (None,))[0] is not data:  # the models of one recording come one after the other
            self._last = (data, validation_data(result, data, left_out_of(self._job, self._name, data)))
        return self._last[1]

    def _load_model(self, model: str) -> tuple[Simulator, FitResult]:
        result = load_made_fit(self._job, self._name, model)
        return simulator(result), result

    def _residuals(self, pairs: Sequence[Pair]) -> str:
        return self._job.experiment.spec.crossval[self._name].residuals or (
            "pairs" if len(pairs) <= _MANY else "models"
        )

    def _absent(self, kind: str, item: str) -> str:
        if (kind, item) not in self._missing:
            text = ""
            try:
                if kind == "model":
                    check_model(self._job, self._name, item)
                else:
                    check_fit_input(self._job, item)
            except (DataError, OSError) as error:
                text = str(error)
            self._missing[kind, item] = text
        return self._missing[kind, item]


def _write_summary(summary: ValidationSummary, part: Path) -> None:
    save_validation_summary(summary, part, overwrite=True)


def _write_summary_csv(key: str, summary: ValidationSummary, part: Path) -> None:
    write_csv(summary_csv_table(summary), part, [f"content_key: {key}"])
