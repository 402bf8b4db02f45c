"""Stage that cross-validates (paper, Sec. 3.8): models on recordings that they were not fitted to."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from gbid.errors import DataError
from gbid.experiment.keys import content_key
from gbid.experiment.pairs import figure_pairs, fit_models, validation_pairs
from gbid.experiment.stages.common import Job, Outcome, produce
from gbid.experiment.stages.fitting import fit_key, load_made_fit
from gbid.experiment.stages.prefiltering import fit_input_key, load_fit_input
from gbid.validate import Validation, cross_validate

FOLDER = "crossval"


@dataclass(frozen=True)
class CrossvalRow:
    """How one output of a recording is explained by one model.

    Attributes
    ----------
    fit, model, recording, output : str
    fit_percent : float
    infinity_norm : float
        Largest deviation, in `unit`.
    unit : str
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
                found += _rows(job, name, model, validate_pair(job, name, model, recording))
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
    result = load_made_fit(job, name, model)
    return cross_validate(result, load_fit_input(job, job.experiment.recordings[recording]))


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


def _rows(job: Job, name: str, model: str, validation: Validation) -> list[CrossvalRow]:
    return [
        CrossvalRow(
            name,
            model,
            validation.recording,
            output,
            float(validation.fit_percent[i]),
            float(validation.infinity_norm[i]),
            validation.output_units[i],
            job.experiment.spec.crossval[name].minimum_percent,
        )
        for i, output in enumerate(validation.output_names)
    ]


def _store(job: Job, name: str, rows: list[CrossvalRow], sources: list[str]) -> Outcome:
    key = content_key("crossval", {"pairs": [(row.model, row.recording) for row in rows]}, sources)

    def write(part: Path) -> None:
        columns = ("model", "recording", "output", "fit_percent", "infinity_norm", "unit")
        with part.open("w", encoding="utf-8", newline="") as handle:
            handle.write("# fit_percent: 100 (1 - |y - yhat| / |y - mean y|), yhat simulated; ")
            handle.write("infinity_norm: largest |y - yhat|\n")
            handle.write(f"# content_key: {key}\n")
            writer = csv.writer(handle, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows([getattr(row, column) for column in columns] for row in rows)

    return produce(job, "crossval", name, job.path(FOLDER, name, ".csv"), key, write)
