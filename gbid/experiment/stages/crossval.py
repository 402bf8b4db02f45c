"""Checks of the crossval section: its fits and the recordings for validation exist."""

from __future__ import annotations

import csv
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from gbid.core.errors import DataError
from gbid.core.hdf5 import load, save
from gbid.core.tables import Table, Value, plain_table, write_csv
from gbid.experiment.experiment import SPECIAL, Experiment, figure_pairs, validation_pairs
from gbid.experiment.fields import Found, content_key, nearest, stored_key
from gbid.experiment.recordings import FOLDER as RECORDINGS
from gbid.experiment.run import (
    Cause,
    Failure,
    Job,
    Outcome,
    Stage,
    Task,
    Work,
    check_made,
    remember_failure,
    remembered_failure,
)
from gbid.experiment.stages.fit import fit_path, load_made_fit, model_key, samples_of
from gbid.experiment.stages.prefilter import FOLDER as PREFILTERED
from gbid.experiment.stages.prefilter import fit_input_key, load_fit_input
from gbid.experiment.structures import make_structure
from gbid.identify import FitResult, MeasuredResponse, measured_response
from gbid.recording import Recording
from gbid.structure import model_of
from gbid.validate import (
    ResidualTest,
    Validation,
    ValidationScores,
    ValidationSummary,
    check_residuals,
    cross_validate,
    summarise,
)
from gbid.validate.central import summary_csv_table
from gbid.validate.crossval import score
from gbid.validate.simulate import AnySimulator, ValidationData, simulator, validation_data


def crossval_has_partners(experiment: Experiment) -> Found:
    """Yield a problem for each cross-validation without a fit or without recordings."""
    for name, section in experiment.spec.crossval.items():
        if name not in experiment.spec.fits:
            yield ("crossval", name), f"no fit of this name; {nearest(name, experiment.spec.fits)}"
            continue
        if f"{name}_summary" in experiment.spec.crossval:
            text = f"its file {name}_summary.csv is that of the summary of {name}; rename one of the two fits"
            yield ("crossval", f"{name}_summary"), text
        special = [word for word in section.on if word in SPECIAL]
        if special and len(section.on) > 1:
            yield ("crossval", name, "on"), f"{special[0]} stands alone; list names or write {special[0]} only"
            continue
        if not special:
            for pattern in section.on:
                if not experiment.matching((pattern,)):
                    yield (
                        ("crossval", name, "on"),
                        f"no recording matches {pattern!r}; {nearest(pattern, (*SPECIAL, *experiment.recordings))}",
                    )
            continue
        if experiment.spec.fits[name].together and special == ["cyclic"]:
            text = "cyclic needs a fit per recording; write others or point, or name recordings"
            yield ("crossval", name, "on"), text
            continue
        pairs = validation_pairs(experiment, name)
        for model in dict.fromkeys(model for model, _ in pairs):
            if not any(m == model and recording for m, recording in pairs):
                where = "" if special == ["others"] else " at its operating point"
                yield ("crossval", name, "on"), f"no other recording for {model!r}{where}; name some"
                break


# ---- Cross-validation of one model on one recording.

_LAGS = 50  # largest lag of the residual test


def validate_pair(job: Job, name: str, model: str, recording: str) -> Validation:
    """Return the scores of one model of a fit on one recording.

    Raises
    ------
    DataError
        When the fit or the recording is missing, or their signals differ.
    """
    result, data = _model_and_recording(job, name, model, recording)
    return cross_validate(result, data, left_out_of(job, name, data))


def residuals_of_pair(job: Job, name: str, model: str, recording: str) -> ResidualTest:
    """Return the residual tests of one model of a fit on one recording.

    Raises
    ------
    DataError
        When the fit or the recording is missing, or their signals differ.
    """
    return residuals_on(job, name, *_model_and_recording(job, name, model, recording))


def bode_of_pair(job: Job, name: str, model: str, recording: str) -> tuple[FitResult, MeasuredResponse]:
    """Return one model of a fit, and the frequency response measured in one recording.

    Raises
    ------
    DataError
        When the fit or the recording is missing, or their signals differ.
    """
    result, data = _model_and_recording(job, name, model, recording)
    options = result.options
    return result, measured_response(data, options.inputs, options.outputs, intersample=options.intersample)


def residuals_on(job: Job, name: str, result: FitResult, data: Recording) -> ResidualTest:
    """Return the residual tests of a loaded model on a loaded recording."""
    left_out = left_out_of(job, name, data)
    edges = [0, *sorted(edge for stretch in left_out for edge in stretch), data.n_samples]
    longest = max(stop - start for start, stop in zip(edges[::2], edges[1::2], strict=True))
    return check_residuals(result, data, lags=max(1, min(_LAGS, longest // 4)), left_out=left_out)


def left_out_of(job: Job, name: str, data: Recording) -> list[tuple[int, int]]:
    """Return the samples of a recording that the experiment leaves out of a fit, as (first, stop) pairs.

    Raises
    ------
    DataError
        When a stretch lies beyond the end of the recording.
    """
    stretches = job.experiment.spec.fits[name].left_out.get(data.name, ())
    return [samples_of(data, *stretch) for stretch in stretches]


def pair_keys(job: Job, name: str, model: str, recording: str) -> list[str]:
    """Return the content keys of a model and of the recording on which it is validated."""
    return [model_key(job.experiment, name, model), data_key(job.experiment, name, recording)]


def data_key(experiment: Experiment, name: str, recording: str) -> str:
    """Return the content key of a recording for validation, with the stretches that are left out."""
    key = fit_input_key(experiment, experiment.recordings[recording])
    left_out = experiment.spec.fits[name].left_out.get(recording)
    return f"{key} without {left_out}" if left_out else key


def check_model(job: Job, name: str, model: str) -> None:
    """Refuse a model that is missing or was made from other settings; the file is not read in full.

    Raises
    ------
    DataError
        When the model is missing or was made from other settings.
    """
    check_made(fit_path(job, name, model), model_key(job.experiment, name, model), "gbid fit")


def check_fit_input(job: Job, recording: str) -> None:
    """Refuse a recording that is missing or was made from other settings; the file is not read in full.

    Raises
    ------
    DataError
        When the recording is missing or was made from other settings.
    """
    planned = job.experiment.recordings[recording]
    raw = job.experiment.spec.prefilter is None
    verb = "gbid fit" if not raw else "gbid import" if planned.imported else "gbid rig"
    check_made(job.path(RECORDINGS if raw else PREFILTERED, recording), fit_input_key(job.experiment, planned), verb)


def drawn_pairs(job: Job) -> Iterable[tuple[str, str, str]]:
    """Yield fit, model and recording of each figure of the experiment."""
    for name in job.experiment.spec.figures:
        for model, recording in figure_pairs(job.experiment, name):
            yield name, model, recording


def with_local(job: Job, name: str, result: FitResult, recording: str) -> FitResult:
    """Return a fit result with the local parameters of a recording, or those of its operating point.

    Raises
    ------
    DataError
        When the result has no local parameters for the recording.
    """
    if not result.local_names:
        return result
    known, scopes = job.experiment.recordings, job.experiment.spec.fits[name].local
    alike = [recording] if recording in result.recordings else []
    if not alike and all(scope == "operating_point" for scope in scopes.values()):
        alike = [other for other in result.recordings if known[other].point == known[recording].point]
    if not alike:
        raise DataError(
            f"fit {name!r} has parameters local to a recording or operating point ({', '.join(scopes)}); "
            f"there are none for recording {recording!r}; validate it on one of its own"
        )
    structure, found = make_structure(job.experiment, name), result.parameters_of(alike[0])
    own = {q.name: found[q.name] for q in structure.parameters}
    model = model_of(structure, own, result.model.input_names, result.model.output_names)
    first, other = (result.local_names.get(name, {}) for name in (result.recordings[0], alike[0]))
    return replace(result, model=model, model_slopes=result.model_slopes if first == other else None)


def _model_and_recording(job: Job, name: str, model: str, recording: str) -> tuple[FitResult, Recording]:
    result = load_made_fit(job, name, model)
    data = load_fit_input(job, job.experiment.recordings[recording])
    return with_local(job, name, result, recording), data


# ---- Rows of a cross-validation, and their table in CSV.

COLUMNS = ("model", "recording", "output", "fit_percent", "infinity_norm", "unit", "residual_p", "residuals_follow")
_LEVEL = 0.01  # significance level of the whiteness test, over all outputs


@dataclass(frozen=True)
class CrossvalRow:
    """Scores of one model for one output of a recording.

    Attributes
    ----------
    fit, model, recording, output : str
        Names.
    fit_percent : float
        Fit percent of the simulation.
    infinity_norm : float
        Largest deviation of the simulation, in `unit`.
    unit : str
        Unit of the output.
    residual_p : float or None
        p-value of the whiteness test of the residuals. The residuals are those of the focus of the fit. None when they
        were not tested.
    residuals_white : bool or None
        Whether the whiteness test does not reject; None when it was not made.
    residuals_follow : tuple of str
        Inputs that are correlated with the residuals.
    minimum_percent : float or None
        Smallest fit percent that the experiment requires.
    """

    fit: str
    model: str
    recording: str
    output: str
    fit_percent: float
    infinity_norm: float
    unit: str
    residual_p: float | None
    residuals_white: bool | None
    residuals_follow: tuple[str, ...]
    minimum_percent: float | None

    @property
    def missed(self) -> bool:
        """Whether the fit percent is below the required minimum."""
        return self.minimum_percent is not None and not self.fit_percent >= self.minimum_percent


def scores_of_rows(job: Job, rows: Sequence[CrossvalRow]) -> ValidationScores:
    """Return the scores of the rows of one fit as arrays."""
    outputs = tuple(dict.fromkeys(row.output for row in rows))
    first = rows[:: len(outputs)]
    known = [job.experiment.recordings[row.recording].conditions for row in first]
    shape = (len(first), len(outputs))
    return ValidationScores(
        tuple(row.model for row in first),
        tuple(row.recording for row in first),
        np.array([conditions.get("pressure_bar", np.nan) for conditions in known]),
        np.array([conditions.get("speed_rpm", np.nan) for conditions in known]),
        outputs,
        tuple(row.unit for row in rows[: len(outputs)]),
        np.array([row.fit_percent for row in rows]).reshape(shape),
        np.array([row.infinity_norm for row in rows]).reshape(shape),
    )


def rows_table(rows: Sequence[CrossvalRow]) -> Table:
    """Return the table of the cross-validation of a fit, as in its CSV file."""
    notes = (
        "fit_percent: 100 (1 - |y - yhat| / |y - mean y|), yhat simulated; infinity_norm: largest |y - yhat|",
        "residual_p: p-value of the whiteness test, empty where not tested; "
        "residuals_follow: inputs that are correlated with the residuals",
    )
    values = [[_value(getattr(row, column)) for column in COLUMNS] for row in rows]
    return plain_table(COLUMNS, values, notes)


def read_rows(job: Job, name: str, path: Path) -> list[CrossvalRow]:
    """Return the rows in the CSV table of the cross-validation of a fit."""
    with path.open(encoding="utf-8", newline="") as handle:
        table = list(csv.DictReader(line for line in handle if not line.startswith("#")))
    minimum = job.experiment.spec.crossval[name].minimum_percent
    n_outputs = len({row["output"] for row in table})
    rows = []
    for row in table:
        p = float(row["residual_p"]) if row["residual_p"] else None
        rows.append(
            CrossvalRow(
                name,
                row["model"],
                row["recording"],
                row["output"],
                float(row["fit_percent"]),
                float(row["infinity_norm"]),
                row["unit"],
                p,
                None if p is None else p >= _LEVEL / n_outputs,
                tuple(shlex.split(row["residuals_follow"])),
                minimum,
            )
        )
    return rows


def _value(value: Any) -> Value:
    return shlex.join(value) if isinstance(value, tuple) else value


# ---- Pairs of model and recording in the cross-validation of a fit: those possible, their content key and rows.

_MANY = 200  # largest number of pairs for which the residuals of each pair are tested
_MODELS_IN_MEMORY = 256

Pair = tuple[str, str]
"""Model and recording."""


class FitPairs:
    """Pairs of one fit; models and keys are loaded once.

    Parameters
    ----------
    job : Job
        The job.
    name : str
        Name of the fit.
    """

    def __init__(self, job: Job, name: str) -> None:
        self._job, self._name = job, name
        self._model = lru_cache(maxsize=_MODELS_IN_MEMORY)(self._load_model)
        self._model_key = lru_cache(maxsize=None)(lambda model: model_key(job.experiment, name, model))
        self._data_key = lru_cache(maxsize=None)(lambda recording: data_key(job.experiment, name, recording))

    @cached_property
    def missing(self) -> dict[Pair, str]:
        """Pairs whose model or recording is missing, with the reason."""
        pairs = validation_pairs(self._job.experiment, self._name)
        models = {model: self._why_not(model, "model") for model in {model for model, _ in pairs}}
        recordings = {each: self._why_not(each, "recording") for each in {recording for _, recording in pairs}}
        return {(m, r): models[m] or recordings[r] for m, r in pairs if models[m] or recordings[r]}

    @cached_property
    def there(self) -> list[Pair]:
        """Pairs that can be validated."""
        pairs = validation_pairs(self._job.experiment, self._name)
        return [pair for pair in pairs if pair not in self.missing]

    @cached_property
    def key(self) -> str:
        """Content key of the table."""
        settings = {"pairs": self.there, "columns": COLUMNS, "residuals": self._residuals}
        return content_key("crossval", settings, [self.key_of(pair) for pair in self.there])

    def key_of(self, pair: Pair) -> str:
        """Return the content keys of model and recording of a pair, as one text."""
        return f"{self._model_key(pair[0])} {self._data_key(pair[1])}"

    def rows(self) -> tuple[list[CrossvalRow], dict[Pair, str]]:
        """Return the rows of all pairs in order, and the reason for pairs without rows; reads each recording once."""
        found: dict[Pair, list[CrossvalRow]] = {}
        failed: dict[Pair, str] = {}
        tested = set(dict(reversed(self.there)).items())  # the first pair of each model
        by_recording: dict[str, list[Pair]] = {}
        for pair in self.there:
            by_recording.setdefault(pair[1], []).append(pair)
        for recording, here in by_recording.items():
            try:
                data = load_fit_input(self._job, self._job.experiment.recordings[recording])
            except DataError as error:
                failed |= dict.fromkeys(here, str(error))
                continue
            own: ValidationData | None = None  # the same for all models of a recording
            for pair in here:
                test = self._residuals == "pairs" or (self._residuals == "models" and pair in tested)
                try:
                    if own is None:
                        own = self._data(pair[0], data)
                    found[pair] = self._rows(pair[0], data, own, test)
                except DataError as error:
                    failed[pair] = str(error)
        return [row for pair in self.there if pair in found for row in found[pair]], failed

    def _rows(self, model: str, data: Recording, own: ValidationData, test: bool) -> list[CrossvalRow]:
        fitted, plain = self._model(model)
        if plain.local_names:
            plain = with_local(self._job, self._name, plain, data.name)
            fitted = simulator(plain)
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

    def _data(self, model: str, data: Recording) -> ValidationData:
        return validation_data(self._model(model)[1], data, left_out_of(self._job, self._name, data))

    def _load_model(self, model: str) -> tuple[AnySimulator, FitResult]:
        result = load_made_fit(self._job, self._name, model)
        return simulator(result), result

    @cached_property
    def _residuals(self) -> str:
        return self._job.experiment.spec.crossval[self._name].residuals or (
            "pairs" if len(self.there) <= _MANY else "models"
        )

    def _why_not(self, item: str, kind: str) -> str:
        try:
            if kind == "model":
                check_model(self._job, self._name, item)
            else:
                check_fit_input(self._job, item)
        except (DataError, OSError) as error:
            return str(error)
        return ""


# ---- Stage of the cross-validation (paper, Sec. 3.8): models on recordings to which they were not fitted.

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
    summary = load(path, ValidationSummary)
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
    save(_summary(job, item)[0], part, overwrite=True)


def _write_summary_csv(job: Job, item: str, part: Path) -> None:
    summary, key = _summary(job, item)
    write_csv(summary_csv_table(summary), part, [f"content_key: {key}"])


CROSSVAL = Stage("crossval", "crossval", (crossval_has_partners,), crossval_tasks, (_summary_work,))
"""``crossval/<fit>.csv`` and its summary, ``<fit>_summary.h5`` and ``.csv``, for each fit that is cross-validated."""
