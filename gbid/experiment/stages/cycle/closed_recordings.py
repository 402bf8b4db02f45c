"""Recordings of a round in closed loop, and the fits to them."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from gbid.experiment.keys import content_key, stored_key
from gbid.experiment.recordings import refuse_bad_signals
from gbid.experiment.run.inputs import load_checked
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Made
from gbid.experiment.stages.cycle.plan import (
    RoundRecording,
    controller_file,
    cycle_section,
    excitation,
    round_folder,
    round_of,
    round_recordings,
    trial_recordings,
)
from gbid.experiment.stages.fit.stage import fit_settings, fitted, read_fit_summary, save_made_fit
from gbid.experiment.stages.fit.structures import fit_channels
from gbid.experiment.stages.impact.loop_program import loop_of, loop_settings
from gbid.experiment.stages.impact.plan import hammer_of, loop_controller
from gbid.experiment.stages.prefilter.stage import filtered_input, stationary_keys
from gbid.experiment.stages.rig.model import rig_model
from gbid.experiment.stages.rig.plan import as_settings, machine_at, record_options
from gbid.identify import TableEntry, load_fit
from gbid.recording import Recording, save_recording
from gbid.rig import Hammer, Prbs, record

RECORDINGS, FITS = "recordings", "fits"


def recording_tasks(job: Job, planned: dict[str, RoundRecording]) -> list[Task]:
    """Return the tasks that record with the controllers of the rounds; their files must exist."""
    return [
        Task("cycle recording", name, recording_path(job, one), recording_key(job, one), _write_recording, (name,))
        for name, one in planned.items()
    ]


def fit_tasks(job: Job, number: int) -> list[Task]:
    """Return the tasks of the fits to the recordings of a round."""
    return [
        Task("cycle fit", name, fit_path(job, one), fit_key(job, one), _write_fit, (name,), read_fit_summary)
        for name, one in round_recordings(job.experiment, number).items()
    ]


def recording_path(job: Job, one: RoundRecording) -> Path:
    """Return the path of a recording."""
    return job.path(f"{round_folder(one.number)}/{RECORDINGS}", one.planned.name)


def fit_path(job: Job, one: RoundRecording) -> Path:
    """Return the path of the fit to a recording."""
    return job.path(f"{round_folder(one.number)}/{FITS}", one.planned.name)


def load_closed(job: Job, one: RoundRecording) -> Recording:
    """Return a recording after a check that it was made from the present settings.

    Raises
    ------
    DataError
        When it is missing or was made from other settings.
    """
    return load_checked(recording_path(job, one), recording_key(job, one), "gbid cycle")


def recording_key(job: Job, one: RoundRecording) -> str:
    """Return the content key of a recording: rig, excitation, and the controller that runs."""
    experiment = job.experiment
    settings: dict[str, Any] = {
        **as_settings(record_options(experiment, one.planned)),
        "experiment": asdict(_experiment(job, one)),
        "machine": asdict(machine_at(experiment, one.planned, rig_model(experiment))),
        **loop_settings(experiment),
    }
    return content_key("cycle recording", settings, [stored_key(_running(job, one))])


def fit_key(job: Job, one: RoundRecording) -> str:
    """Return the content key of the fit to a recording."""
    experiment, name = job.experiment, _fit_name(job)
    section = experiment.spec.prefilter
    settings = {
        **fit_settings(experiment, name, [one.planned.name]),
        "prefilter": None if section is None else section.model_dump(),
    }
    return content_key(
        "cycle fit", settings, [recording_key(job, one), *stationary_keys(experiment, one.planned.point)]
    )


def closed_entries(job: Job, last: int) -> dict[str, TableEntry]:
    """Return the fits of the rounds 1 to `last` by their content keys."""
    found = {}
    for number in range(1, last + 1):
        for name, one in round_recordings(job.experiment, number).items():
            result = load_fit(fit_path(job, one))
            found[fit_key(job, one)] = TableEntry(_fit_name(job), name, (name,), one.planned.conditions, result, "")
    return found


def _write_recording(job: Job, name: str, part: Path) -> None:
    experiment, number = job.experiment, round_of(name)
    one = {**round_recordings(experiment, number), **trial_recordings(experiment, number)}[name]
    machine = machine_at(experiment, one.planned, rig_model(experiment))
    options = record_options(experiment, one.planned)
    running = loop_of(experiment, loop_controller(experiment, _running(job, one), one.point), machine, options)
    save_recording(record(machine, _experiment(job, one), **options, controller=running), part, overwrite=True)


def _write_fit(job: Job, name: str, part: Path) -> Made:
    one = round_recordings(job.experiment, round_of(name))[name]
    raw, (inputs, outputs) = load_closed(job, one), fit_channels(job.experiment, _fit_name(job))
    refuse_bad_signals(one.planned, raw, [*inputs, *outputs], driving=inputs)
    return save_made_fit(fitted(job, _fit_name(job), [filtered_input(job, one.planned, raw)]), part)


def _experiment(job: Job, one: RoundRecording) -> Hammer | Prbs:
    rig = job.experiment.spec.rig
    assert rig is not None
    if one.axis:
        return hammer_of(cycle_section(job.experiment).impacts, one.axis, rig.sample_time_s)
    return excitation(job.experiment)


def _running(job: Job, one: RoundRecording) -> Path:
    """Return the file of the controller that runs: of impacts that of their round, else that of the round before."""
    return controller_file(job, one.number if one.axis else one.number - 1)


def _fit_name(job: Job) -> str:
    assert job.experiment.spec.lpv is not None
    return job.experiment.spec.lpv.fit
