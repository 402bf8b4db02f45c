"""Pairs of model and recording in the cross-validation of a fit: those possible, their content key and rows."""

from __future__ import annotations

from functools import cached_property, lru_cache

from gbid.errors import DataError
from gbid.experiment.keys import content_key
from gbid.experiment.run.job import Job
from gbid.experiment.stages.crossval.pairing import (
    check_fit_input,
    check_model,
    data_key,
    left_out_of,
    residuals_on,
    with_local,
)
from gbid.experiment.stages.crossval.plan import validation_pairs
from gbid.experiment.stages.crossval.rows import COLUMNS, CrossvalRow
from gbid.experiment.stages.fit.stage import load_made_fit, model_key
from gbid.experiment.stages.prefilter.stage import load_fit_input
from gbid.identify import FitResult
from gbid.recording import Recording
from gbid.validate.any_simulator import AnySimulator, simulator
from gbid.validate.crossval import score
from gbid.validate.validation_data import ValidationData, validation_data

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
