"""Stage that chooses the nominal actuator (paper, Sec. 3.7)."""

from __future__ import annotations

from pathlib import Path

from gbid.errors import DataError
from gbid.experiment.keys import content_key
from gbid.experiment.run.job import Job
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.perform import produce
from gbid.experiment.stages.fit.plan import fit_models
from gbid.experiment.stages.fit.stage import load_made_fit, model_key
from gbid.identify import TableEntry, tabulate
from gbid.validate import NominalActuator, nominal_actuator, save_nominal_actuator

FOLDER = "nominal"


def choose_nominal(job: Job) -> tuple[list[Outcome], NominalActuator | None]:
    """Write ``nominal/<fit>.yaml`` with the most central model of the fit that the nominal section names.

    Returns
    -------
    list of Outcome
        Empty without that section.
    NominalActuator or None
        None without that section, or when there is none.
    """
    section = job.experiment.spec.nominal
    if section is None:
        return [], None
    path = job.path(FOLDER, section.fit, ".yaml")
    try:
        nominal, keys = nominal_of(job)
    except DataError as error:
        outcome = Outcome("nominal", section.fit, path, "failed", str(error), cause="data")
        job.reporter.end(outcome)
        return [outcome], None
    key = content_key("nominal", {"left_out": nominal.left_out}, keys)
    source = f"{job.experiment.spec.name}, fit {section.fit}, model of {nominal.name}"

    def write(part: Path) -> str:
        save_nominal_actuator(nominal, part, source=source, overwrite=True, comment=f"content_key: {key}")
        return f"{nominal.name}; {len(nominal.outliers)} outliers"

    return [produce(job, "nominal", section.fit, path, key, write)], nominal


def nominal_of(job: Job) -> tuple[NominalActuator, list[str]]:
    """Return the most central model of the fit that the nominal section names, and the keys of the fits behind it.

    Raises
    ------
    DataError
        Without that section, or when there is none.
    """
    section = job.experiment.spec.nominal
    if section is None:
        raise DataError("no section 'nominal'; add one")
    entries, keys = [], []
    for model, recordings in fit_models(job.experiment, section.fit).items():
        conditions = job.experiment.recordings[recordings[0]].conditions
        try:
            result, failure = load_made_fit(job, section.fit, model), ""
            keys.append(model_key(job.experiment, section.fit, model))
        except (DataError, OSError) as error:
            result, failure = None, str(error)
        entries.append(TableEntry(section.fit, model, tuple(recordings), conditions, result, failure))
    return nominal_actuator(tabulate(entries)), keys
