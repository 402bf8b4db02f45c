"""Nominal actuator: check of its section, and its file."""

from __future__ import annotations

from pathlib import Path

from gbid.core.errors import DataError
from gbid.experiment.experiment import Experiment
from gbid.experiment.fields import Found, Result, needed
from gbid.experiment.run import Job, Made, Outcome, Stage, Task, Work
from gbid.experiment.stages.fit import a_fit_is_named, fit_entries, fit_result
from gbid.identify import tabulate
from gbid.validate import NominalActuator, nominal_actuator, save_nominal_actuator
from gbid.validate.central import ACTUATOR


def nominal_is_an_actuator(experiment: Experiment) -> Found:
    """Yield problems of the nominal section: its fit must exist, have the parameters, and give several models."""
    section = experiment.spec.nominal
    if section is None:
        return
    yield from a_fit_is_named(
        experiment, ("nominal", "fit"), section.fit, ACTUATOR, "name a fit of piezo_pair or plant"
    )


# ---- Stage of the nominal actuator (paper, Sec. 3.7).

FOLDER = "nominal"


def nominal_tasks(job: Job) -> Work:
    """Return the task of the nominal section; a failed outcome when no fit has a result."""
    section, experiment = job.experiment.spec.nominal, job.experiment
    if section is None:
        return []
    path = experiment.path(FOLDER, section.fit, ".yaml")
    try:
        _, result = nominal_of(job)
    except DataError as error:
        return [Outcome("nominal", section.fit, path, "failed", str(error), cause="input")]
    return [Task.of(result, _write)]


def nominal_of(job: Job) -> tuple[NominalActuator, Result]:
    """Return the most central model of the fit in the nominal section, and the result file of the choice.

    Raises
    ------
    UsageError
        When the section is missing.
    DataError
        When its fit has no models.
    """
    experiment, section = job.experiment, needed(job.experiment.spec.nominal, "nominal")
    entries = fit_entries(job, section.fit)
    nominal = nominal_actuator(tabulate(entries))
    models = [fit_result(experiment, section.fit, entry.model) for entry in entries if entry.result is not None]
    path = experiment.path(FOLDER, section.fit, ".yaml")
    return nominal, experiment.result("nominal", section.fit, path, {"left_out": nominal.left_out}, models)


def _write(job: Job, part: Path) -> Made:
    nominal, result = nominal_of(job)
    source = f"{job.experiment.spec.name}, fit {result.item}, model of {nominal.name}"
    save_nominal_actuator(nominal, part, source=source, overwrite=True)
    return Made(f"{nominal.name}; {len(nominal.outliers)} outliers")


NOMINAL = Stage("nominal", "nominal", (nominal_is_an_actuator,), nominal_tasks)
"""``nominal/<fit>.yaml`` with the most central model of the fit in the nominal section."""
