"""Stage that cross-validates (paper, Sec. 3.8): models on recordings that they were not fitted to."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gbid.errors import DataError
from gbid.experiment.keys import content_key
from gbid.experiment.pairs import figure_pairs, fit_models, validation_pairs
from gbid.experiment.stages.common import Job, Outcome, produce
from gbid.experiment.stages.fitting import fit_key, load_made_fit
from gbid.experiment.stages.prefiltering import fit_input_key, load_fit_input
from gbid.experiment.structures import make_structure
from gbid.identify import FitResult
from gbid.recording import Recording
from gbid.structure import evaluate
from gbid.validate import ResidualTest, Validation, check_residuals, cross_validate

FOLDER = "crossval"
_LAGS = 50  # of the residual test


@dataclass(frozen=True)
class CrossvalRow:
    """How one output of a recording is explained by one model.

    Attributes
    ----------
    fit, model, recording, output : str
    fit_percent : float
        Simulated.
    infinity_norm : float
        Largest deviation of the simulation, in `unit`.
    unit : str
    residual_p : float
        Probability of less white residuals if they were white; the residuals are those of the fit's own focus.
    residuals_white : bool
    residuals_follow : tuple of str
        Inputs that are still to be found in the residuals.
    minimum_percent : float or None
        What the experiment asks for.
    """

    fit: str
    model: str
    recording: str
    output: str
    fit_percent: float
    infinity_norm: float
    unit: str
    residual_p: float
    residuals_white: bool
    residuals_follow: tuple[str, ...]
    minimum_percent: float | None

    @property
    def missed(self) -> bool:
        """Whether the fit stays below the minimum asked for."""
        return self.minimum_percent is not None and not self.fit_percent >= self.minimum_percent


def run_crossval(job: Job) -> tuple[list[Outcome], list[CrossvalRow]]:
    """Write ``crossval/<fit>.csv`` for each fit that is cross-validated.

    Returns
    -------
    list of Outcome
    list of CrossvalRow
        Of all fits. A threshold that was missed is a matter of the caller: the results are written.
    """
    outcomes: list[Outcome] = []
    rows: list[CrossvalRow] = []
    for name in job.experiment.spec.crossval:
        found: list[CrossvalRow] = []
        sources: list[str] = []
        for model, recording in validation_pairs(job.experiment, name):
            try:
                validation = validate_pair(job, name, model, recording)
                found += _rows(job, name, model, validation, residuals_of_pair(job, name, model, recording))
                sources += pair_keys(job, name, model, recording)
            except DataError as error:
                item, path = f"{name}/{model} on {recording}", job.path(FOLDER, name, ".csv")
                outcomes.append(Outcome("crossval", item, path, "failed", str(error)))
                job.reporter.end(outcomes[-1])
        if found:
            outcomes.append(_store(job, name, found, sources))
            rows += found
    return outcomes, rows


def validate_pair(job: Job, name: str, model: str, recording: str) -> Validation:
    """Put one model of a fit to one recording.

    Raises
    ------
    DataError
        When the fit or the recording is not there, or they do not go together.
    """
    return cross_validate(*_model_and_recording(job, name, model, recording))


def residuals_of_pair(job: Job, name: str, model: str, recording: str) -> ResidualTest:
    """Test the residuals of one model of a fit on one recording.

    Raises
    ------
    DataError
        When the fit or the recording is not there, or they do not go together.
    """
    result, data = _model_and_recording(job, name, model, recording)
    return check_residuals(result, data, lags=min(_LAGS, data.n_samples // 4))


def pair_keys(job: Job, name: str, model: str, recording: str) -> list[str]:
    """Content keys of a model and the recording that it is put to."""
    fitted_to = fit_models(job.experiment, name)[model]
    planned = job.experiment.recordings[recording]
    return [fit_key(job.experiment, name, fitted_to), fit_input_key(job.experiment, planned)]


def drawn_pairs(job: Job) -> Iterable[tuple[str, str, str]]:
    """Fit, model and recording of each picture that the experiment asks for."""
    for name in job.experiment.spec.figures:
        for model, recording in figure_pairs(job.experiment, name):
            yield name, model, recording


def _model_and_recording(job: Job, name: str, model: str, recording: str) -> tuple[FitResult, Recording]:
    result = load_made_fit(job, name, model)
    data = load_fit_input(job, job.experiment.recordings[recording])
    return (_with_local(job, name, result, recording) if result.local_names else result), data


def _with_local(job: Job, name: str, result: FitResult, recording: str) -> FitResult:
    """Give the model the local parameters that hold for a recording: its own, or those of its operating point."""
    known, scopes = job.experiment.recordings, job.experiment.spec.fits[name].local
    alike = [recording] if recording in result.recordings else []
    if not alike and all(scope == "operating_point" for scope in scopes.values()):
        alike = [other for other in result.recordings if known[other].point == known[recording].point]
    if not alike:
        raise DataError(
            f"fit {name!r} has parameters local to a recording or operating point ({', '.join(scopes)}); "
            f"there are none for recording {recording!r}"
        )
    structure, found = make_structure(job.experiment, name), result.parameters_of(alike[0])
    own = {q.name: found[q.name] for q in structure.parameters}
    return replace(result, model=evaluate(structure, own, result.model.input_names, result.model.output_names))


def _rows(job: Job, name: str, model: str, validation: Validation, test: ResidualTest) -> list[CrossvalRow]:
    return [
        CrossvalRow(
            name,
            model,
            validation.recording,
            output,
            float(validation.fit_percent[i]),
            float(validation.infinity_norm[i]),
            validation.output_units[i],
            float(test.p_white[i]),
            bool(test.white[i]),
            test.follows[i],
            job.experiment.spec.crossval[name].minimum_percent,
        )
        for i, output in enumerate(validation.output_names)
    ]


def _store(job: Job, name: str, rows: list[CrossvalRow], sources: list[str]) -> Outcome:
    columns = ("model", "recording", "output", "fit_percent", "infinity_norm", "unit", "residual_p", "residuals_follow")
    pairs = [(row.model, row.recording) for row in rows]
    key = content_key("crossval", {"pairs": pairs, "columns": columns}, sources)

    def write(part: Path) -> None:
        with part.open("w", encoding="utf-8", newline="") as handle:
            handle.write("# fit_percent: 100 (1 - |y - yhat| / |y - mean y|), yhat simulated; ")
            handle.write("infinity_norm: largest |y - yhat|\n")
            handle.write("# residual_p: probability of less white residuals if they were white; ")
            handle.write("residuals_follow: inputs still to be found in them\n")
            handle.write(f"# content_key: {key}\n")
            writer = csv.writer(handle, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows([_cell(getattr(row, column)) for column in columns] for row in rows)

    return produce(job, "crossval", name, job.path(FOLDER, name, ".csv"), key, write)


def _cell(value: Any) -> Any:
    return " ".join(value) if isinstance(value, tuple) else value
