"""Cross-validation stage, choice of the nominal actuator, and checks of the fits that the section `figures` names."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache, partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from gbid import identify, validate
from gbid.core.errors import DataError, nearest
from gbid.core.hdf5 import load, save
from gbid.core.tables import Column, Entry, Table, Value, csv_rows, formatted, plain_table, write_csv
from gbid.experiment.experiment import SPECIAL, Experiment, validation_pairs
from gbid.experiment.fields import Found, Item, Result, needed, stored_key
from gbid.experiment.run import (
    Cause,
    Failure,
    Job,
    Made,
    Outcome,
    Stage,
    Task,
    Work,
    no_tasks,
    remember_failure,
    remembered_failure,
)
from gbid.experiment.stages.fit import a_fit_is_named, fit_entries, fit_result, left_out_of, load_made_fit
from gbid.experiment.stages.prefilter import fit_input, load_fit_input
from gbid.experiment.structures import make_structure
from gbid.identify.table import tabulate
from gbid.recording import Recording
from gbid.structure.kinds import kind_of
from gbid.validate.central import ACTUATOR, save_nominal_actuator, summary_csv_table
from gbid.validate.crossval import score
from gbid.validate.simulate import Simulator, ValidationData, simulator, validation_data


def crossval_has_partners(experiment: Experiment) -> Found:
    """Yield a problem for each cross-validation without a fit or without recordings."""
    for name, section in experiment.spec.crossval.items():
        if name not in experiment.spec.fits:
            yield ("crossval", name), f"no fit of this name; {nearest(name, experiment.spec.fits)}"
            continue
        if f"{name}_summary" in experiment.spec.crossval:
            text = f"its file {name}_summary.csv is that of the summary of {name}; rename one of the two fits"
            yield ("crossval", f"{name}_summary"), text
        yield from ((("crossval", name, "on"), text) for text in _partner_problems(experiment, name, section.on))


def _partner_problems(experiment: Experiment, name: str, on: Sequence[str]) -> Iterator[str]:
    special = [word for word in on if word in SPECIAL]
    if special and len(on) > 1:
        yield f"{special[0]} stands alone; list names or write {special[0]} only"
    elif not special:
        for pattern in on:
            if not experiment.matching((pattern,)):
                yield f"no recording matches {pattern!r}; {nearest(pattern, (*SPECIAL, *experiment.recordings))}"
    elif experiment.spec.fits[name].together and special == ["cyclic"]:
        yield "cyclic needs a fit per recording; write others or point, or name recordings"
    else:
        partners: dict[str, list[str]] = {}
        for model, recording in validation_pairs(experiment, name):
            partners.setdefault(model, []).append(recording)
        alone = next((model for model, recordings in partners.items() if not any(recordings)), None)
        if alone is not None:
            where = "" if special == ["others"] else " at its operating point"
            yield f"no other recording for {alone!r}{where}; name some"


def validate_pair(job: Job, name: str, model: str, recording: str) -> validate.Validation:
    """Return the scores of one model on one recording.

    Raises
    ------
    DataError
        When the fit or the recording is missing, or their signals differ.
    """
    result, data = model_and_recording(job, name, model, recording)
    return validate.cross_validate(result, data, left_out_of(job.experiment, name, data))


def model_and_recording(job: Job, name: str, model: str, recording: str) -> tuple[identify.FitResult, Recording]:
    """Return a model of a fit with the local parameters for a recording, and the recording.

    Raises
    ------
    DataError
        When the fit or the recording is missing.
    """
    result = load_made_fit(job, name, model)
    data = load_fit_input(job, job.experiment.recordings[recording])
    return with_local(job, name, result, recording), data


def residuals_on(job: Job, name: str, result: identify.FitResult, data: Recording) -> validate.ResidualTest:
    """Return the residual tests of a model on a recording."""
    return validate.check_residuals(result, data, left_out=left_out_of(job.experiment, name, data))


def data_key(experiment: Experiment, name: str, recording: str) -> str:
    """Return the content key of a validation recording with its left-out stretches."""
    key = fit_input(experiment, experiment.recordings[recording]).key
    left_out = experiment.spec.fits[name].left_out.get(recording)
    return f"{key} without {left_out}" if left_out else key


def with_local(job: Job, name: str, result: identify.FitResult, recording: str) -> identify.FitResult:
    """Return a fit result with the local parameters of a recording or of its operating point.

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
    structure, estimates = make_structure(job.experiment, name), result.parameters_of(alike[0])
    parameters = {q.name: estimates[q.name] for q in structure.parameters}
    model = kind_of(structure).model(parameters, result.model.input_names, result.model.output_names)
    first, other = (result.local_names.get(name, {}) for name in (result.recordings[0], alike[0]))
    return result.changed(model=model, model_slopes=result.model_slopes if first == other else None)


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
        """Whether the fit percent is below the required value."""
        return self.minimum_percent is not None and not self.fit_percent >= self.minimum_percent


def pair_table(rows: Sequence[CrossvalRow]) -> Table:
    """Return the table of the fit percent of each model on each recording, and of the residual tests."""
    missed = any(row.missed for row in rows)
    columns = [
        *(Column("model of"), Column("on"), Column("output"), Column("fit\n", "%", ".2f")),
        *(Column("largest\nerror", format=2), Column("residuals\nwhite", format="s"), Column("follow")),
        *([Column("")] if missed else []),
    ]
    cells: list[list[Entry]] = [
        [
            *(row.model, row.recording, row.output, row.fit_percent),
            *(formatted(row.infinity_norm, 2, row.unit), row.residuals_white, ", ".join(row.residuals_follow) or None),
            *([f"below {row.minimum_percent:g} %" if row.missed else ""] if missed else []),
        ]
        for row in rows
    ]
    return Table("cross-validation, simulated", columns, cells)


def _scores(job: Job, rows: Sequence[CrossvalRow]) -> validate.ValidationScores:
    """Return the scores of the rows of one fit as arrays."""
    outputs = tuple(dict.fromkeys(row.output for row in rows))
    first = rows[:: len(outputs)]
    conditions = [job.experiment.recordings[row.recording].conditions for row in first]
    percent, norm = np.array([[row.fit_percent, row.infinity_norm] for row in rows]).T
    return validate.ValidationScores(
        tuple(row.model for row in first),
        tuple(row.recording for row in first),
        np.array([known.get("pressure_bar", np.nan) for known in conditions]),
        np.array([known.get("speed_rpm", np.nan) for known in conditions]),
        outputs,
        tuple(row.unit for row in rows[: len(outputs)]),
        percent.reshape(len(first), -1),
        norm.reshape(len(first), -1),
    )


_NOTES = (
    "fit_percent: 100 (1 - |y - yhat| / |y - mean y|), yhat simulated; infinity_norm: largest |y - yhat|",
    "residual_p: p-value of the whiteness test, empty where not tested; "
    "residuals_follow: inputs that are correlated with the residuals",
)


def _read_rows(job: Job, name: str, path: Path) -> list[CrossvalRow]:
    """Return the rows in the CSV table of the cross-validation of a fit."""
    table = csv_rows(path)
    minimum = job.experiment.spec.crossval[name].minimum_percent
    level = _LEVEL / max(1, len({cells["output"] for cells in table}))
    rows = []
    for cells in table:
        p = float(cells["residual_p"]) if cells["residual_p"] else None
        values: dict[str, Any] = {**cells, "residual_p": p, "residuals_white": None if p is None else p >= level}
        values |= {key: float(cells[key]) for key in ("fit_percent", "infinity_norm")}
        values["residuals_follow"] = tuple(shlex.split(cells["residuals_follow"]))
        rows.append(CrossvalRow(fit=name, minimum_percent=minimum, **values))
    return rows


_MANY = 200  # largest number of pairs for which the residuals of each pair are tested
_MODELS_IN_MEMORY = 256

Pair = tuple[str, str]
"""Model and recording."""


class FitPairs:
    """Pairs of model and recording for one fit; models and keys are loaded once.

    Parameters
    ----------
    job : Job
        The job.
    name : str
        Name of the fit.
    """

    def __init__(self, job: Job, name: str) -> None:
        self._job, self._name = job, name
        self.path = job.path(FOLDER, name, ending=".csv")
        # A model is discretised once for all recordings; the cache of files behind it needs a content key per pair.
        self._model = lru_cache(maxsize=_MODELS_IN_MEMORY)(self._load_model)
        self._model_key = cache(lambda model: fit_result(job.experiment, name, model).key)
        self._data_key = cache(lambda recording: data_key(job.experiment, name, recording))

    @cached_property
    def missing(self) -> dict[Pair, str]:
        """Pairs with a missing model or recording, with the reason."""
        experiment = self._job.experiment
        pairs = validation_pairs(experiment, self._name)
        models = {m: _why_missing(fit_result(experiment, self._name, m)) for m in {m for m, _ in pairs}}
        recordings = {r: _why_missing(fit_input(experiment, experiment.recordings[r])) for r in {r for _, r in pairs}}
        return {(m, r): text for m, r in pairs if (text := models[m] or recordings[r])}

    @cached_property
    def possible(self) -> list[Pair]:
        """Pairs that can be validated."""
        return [pair for pair in validation_pairs(self._job.experiment, self._name) if pair not in self.missing]

    @cached_property
    def table(self) -> Result:
        """Result file with the rows of all pairs."""
        experiment = self._job.experiment
        settings = {"columns": COLUMNS, "residuals": self._residuals, "pairs": self.possible}
        keys = [self.of(pair).key for pair in self.possible]
        return experiment.result(Item("crossval", self._name), FOLDER, settings, keys, ending=".csv")

    def of(self, pair: Pair) -> Result:
        """Return a pair as a result, for the record of its failure."""
        return Result(self.item(pair), self.path, f"{self._model_key(pair[0])} {self._data_key(pair[1])}")

    def item(self, pair: Pair) -> Item:
        """Return a pair as an item."""
        return Item("crossval", self._name, pair[0], f"{{}} on {pair[1]}")

    def failed(self, pair: Pair, text: str, cause: Cause) -> Outcome:
        """Return the outcome of a pair without rows."""
        return Outcome(self.item(pair), self.path, "failed", text, cause=cause)

    def rows(self) -> tuple[list[Sequence[Value]], dict[Pair, str]]:
        """Return the rows of all pairs in order, and reasons for missing rows; each recording is read once."""
        rows: dict[Pair, list[Sequence[Value]]] = {}
        failed: dict[Pair, str] = {}
        tested = set(dict(reversed(self.possible)).items())  # the first pair of each model
        for recording, pairs in groupby(sorted(self.possible, key=itemgetter(1)), key=itemgetter(1)):
            data: Recording | None = None
            validation: ValidationData | None = None  # the same for all models of a recording
            for pair in pairs:
                test = self._residuals == "pairs" or (self._residuals == "models" and pair in tested)
                try:
                    data = data or load_fit_input(self._job, self._job.experiment.recordings[recording])
                    left_out = left_out_of(self._job.experiment, self._name, data)
                    validation = validation or validation_data(self._model(pair[0])[1], data, left_out)
                    rows[pair] = self._rows(pair[0], data, validation, test)
                except DataError as error:
                    failed[pair] = str(error)
        return [row for pair in self.possible for row in rows.get(pair, ())], failed

    def _rows(self, model: str, data: Recording, validation: ValidationData, test: bool) -> list[Sequence[Value]]:
        fitted, plain = self._model(model)
        if plain.local_names:
            plain = with_local(self._job, self._name, plain, data.name)
            fitted = simulator(plain)
        percent, largest = score(fitted, validation)
        outputs = validation.output_names
        p: Sequence[float | None] = [None] * len(outputs)
        follows: Sequence[Sequence[str]] = [()] * len(outputs)
        if test:
            residuals = residuals_on(self._job, self._name, plain, data)
            p, follows = residuals.p_white.tolist(), residuals.follows
        columns = (outputs, percent.tolist(), largest.tolist(), validation.output_units, p, map(shlex.join, follows))
        return [(model, data.name, *cells) for cells in zip(*columns, strict=True)]

    def _load_model(self, model: str) -> tuple[Simulator, identify.FitResult]:
        result = load_made_fit(self._job, self._name, model)
        return simulator(result), result

    @cached_property
    def _residuals(self) -> str:
        return self._job.experiment.spec.crossval[self._name].residuals or (
            "pairs" if len(self.possible) <= _MANY else "models"
        )


def _why_missing(result: Result) -> str:
    """Return the reason for a missing result; empty if the result exists."""
    try:
        result.require()
    except (DataError, OSError) as error:
        return str(error)
    return ""


FOLDER = "crossval"
SUMMARY = "_summary"


def crossval_tasks(job: Job) -> Work:
    """Return one task for each fit, and failed outcomes for pairs whose model or recording is missing."""
    work: list[Task | Outcome] = []
    for name in job.experiment.spec.crossval:
        pairs = FitPairs(job, name)
        work += [pairs.failed(pair, text, "input") for pair, text in pairs.missing.items()]
        if pairs.possible:
            work.append(Task.of(pairs.table, partial(_write_table, name=name)))
    return work


def crossval_rows(job: Job) -> list[CrossvalRow]:
    """Return the existing rows of all cross-validated fits."""
    return [row for name in job.experiment.spec.crossval for row in read_crossval(job, name)]


def read_crossval(job: Job, name: str) -> list[CrossvalRow]:
    """Return the cross-validation rows of a fit; empty unless they belong to the present results."""
    pairs = FitPairs(job, name)
    return _read_rows(job, name, pairs.table.path) if pairs.possible and pairs.table.is_made else []


def read_summary(job: Job, name: str) -> validate.ValidationSummary | None:
    """Return the cross-validation summary of a fit; None unless it belongs to the existing rows."""
    path = job.path(FOLDER, name, ending=f"{SUMMARY}.h5")
    if not path.is_file():
        return None
    summary = load(path, validate.ValidationSummary)
    rows_key = stored_key(job.path(FOLDER, name, ending=".csv"))
    return summary if _summary_result(job, name, summary.failed, rows_key, ".h5").is_made else None


def _write_table(job: Job, part: Path, name: str) -> None:
    """Write the rows of all pairs; pairs without rows are recorded as failed."""
    pairs = FitPairs(job, name)
    rows, failed = pairs.rows()
    for pair, text in failed.items():
        result = pairs.of(pair)
        remember_failure(job, result, Failure(result.key, "data", text))
    if not rows:
        first = next(iter(failed.values()))
        raise DataError(f"all {len(failed)} pairs of model and recording failed, the first because of: {first}")
    write_csv(plain_table(COLUMNS, rows, _NOTES), part)


def _failed_pairs(job: Job, pairs: FitPairs, rows: Sequence[CrossvalRow]) -> dict[Pair, str]:
    """Return the possible pairs without rows, with the reason."""
    done = {(row.model, row.recording) for row in rows}
    failures = {pair: remembered_failure(job, pairs.of(pair)) for pair in pairs.possible if pair not in done}
    unknown = "failed in an earlier run; run again with --overwrite"
    return {pair: failure.text if failure else unknown for pair, failure in failures.items()}


def _summary_work(job: Job, outcomes: Sequence[Outcome]) -> Work:
    """Return failed outcomes of pairs without rows, and the tasks of the summaries."""
    work: list[Task | Outcome] = []
    for outcome in outcomes:
        name = outcome.item.section
        if outcome.state == "failed":
            continue
        pairs = FitPairs(job, name)
        failed = _failed_pairs(job, pairs, _read_rows(job, name, outcome.path))
        work += [pairs.failed(pair, text, "data") for pair, text in failed.items()]
        texts = [f"{model} on {recording}: {text}" for (model, recording), text in {**pairs.missing, **failed}.items()]
        for ending in (".h5", ".csv"):
            result = _summary_result(job, name, texts, pairs.table.key, ending)
            work.append(Task.of(result, partial(_write_summary, name=name, failed=texts, ending=ending)))
    return work


def _summary_result(job: Job, name: str, failed: Sequence[str], rows_key: str, ending: str) -> Result:
    """Return the result file of the summary for a table with a given content key."""
    item = Item("crossval", name, form=f"{{}}{SUMMARY}{ending}")
    return job.experiment.result(item, FOLDER, {"failed": list(failed)}, [rows_key], ending=f"{SUMMARY}{ending}")


def _write_summary(job: Job, part: Path, name: str, failed: Sequence[str], ending: str) -> None:
    summary = validate.summarise(
        _scores(job, _read_rows(job, name, job.path(FOLDER, name, ending=".csv"))), failed=failed
    )
    if ending == ".h5":
        save(summary, part, overwrite=True)
    else:
        write_csv(summary_csv_table(summary), part)


CROSSVAL = Stage("crossval", "crossval", (crossval_has_partners,), crossval_tasks, (_summary_work,))
"""``crossval/<fit>.csv`` and its summary, ``<fit>_summary.h5`` and ``.csv``, for each fit that is cross-validated."""


# ---- Stage of the nominal actuator (paper, Sec. 3.7).

NOMINAL_FOLDER = "nominal"


def nominal_is_an_actuator(experiment: Experiment) -> Found:
    """Yield problems of the nominal section: fit, its parameters, and its number of models."""
    section = needed(experiment.spec.nominal, "nominal")
    yield from a_fit_is_named(
        experiment, ("nominal", "fit"), section.fit, ACTUATOR, "name a fit of piezo_pair or plant with real poles"
    )


def nominal_tasks(job: Job) -> Work:
    """Return the task of the nominal section; a failed outcome when no fit has a result."""
    try:
        return [Task.of(nominal_of(job)[1], _write_nominal)]
    except DataError as error:
        fit = needed(job.experiment.spec.nominal, "nominal").fit
        path = job.path(NOMINAL_FOLDER, fit, ending=".yaml")
        return [Outcome(Item("nominal", fit), path, "failed", str(error), cause="input")]


def nominal_of(job: Job) -> tuple[validate.NominalActuator, Result]:
    """Return the most central model of the fit in the nominal section, and the result file of this choice.

    Raises
    ------
    UsageError
        When the section is missing.
    DataError
        When its fit has no models.
    """
    experiment, fit = job.experiment, needed(job.experiment.spec.nominal, "nominal").fit
    entries = fit_entries(job, fit)
    if all(entry.result is None for entry in entries):
        raise DataError(f"fit {fit!r} has none of its {len(entries)} models yet; `gbid fit` makes them")
    nominal = validate.nominal_actuator(tabulate(entries))
    models = [fit_result(experiment, fit, entry.model) for entry in entries if entry.result is not None]
    settings = {"left_out": nominal.left_out}
    return nominal, experiment.result(Item("nominal", fit), NOMINAL_FOLDER, settings, models, ending=".yaml")


def _write_nominal(job: Job, part: Path) -> Made:
    nominal, result = nominal_of(job)
    source = f"{job.experiment.spec.name}, fit {result.item}, model of {nominal.name}"
    save_nominal_actuator(nominal, part, source=source, overwrite=True)
    return Made(f"{nominal.name}; {len(nominal.outliers)} outliers")


NOMINAL = Stage("nominal", "nominal", (nominal_is_an_actuator,), nominal_tasks)
"""``nominal/<fit>.yaml`` with the most central model of the fit in the nominal section."""


# ---- Stage of the figures of fits; `gbid.report` draws them from the results of the other stages.


def figures_show_fits(experiment: Experiment) -> Found:
    """Yield a problem for each figure of an unknown fit or of an empty time range."""
    for name, section in experiment.spec.figures.items():
        if name not in experiment.spec.fits:
            yield ("figures", name), f"no fit of this name; {nearest(name, experiment.spec.fits)}"
        begin = section.from_s or 0.0
        if section.to_s is not None and section.to_s <= begin:
            yield ("figures", name, "to_s"), f"{section.to_s:g} s is not after from_s = {begin:g} s; make it larger"
        rig = experiment.spec.rig
        if rig is not None and experiment.spec.imported is None and begin >= rig.duration_s:
            text = f"{begin:g} s lies beyond the end of the recordings, {rig.duration_s:g} s; make it smaller"
            yield ("figures", name, "from_s"), text


FIGURES = Stage("figure", "figures", (figures_show_fits,), no_tasks)
