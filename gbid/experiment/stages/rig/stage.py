"""Stage of the recordings of the virtual rig."""

from __future__ import annotations

from pathlib import Path

from gbid.experiment.recordings import recording_task
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.stage import Stage
from gbid.experiment.stages.loop.running import running
from gbid.experiment.stages.rig.checks import RIG_CHECKS
from gbid.experiment.stages.rig.model import rig_model
from gbid.experiment.stages.rig.plan import machine_at, record_options, rig_experiment
from gbid.recording import (
    save_recording,
)
from gbid.rig import ScheduledRun, record


def rig_tasks(job: Job) -> list[Task]:
    """Return the tasks of the rig section, one for each recording."""
    return [
        recording_task(job, "rig", planned, _write_rig_recording)
        for planned in job.experiment.recordings.values()
        if planned.imported is None
    ]


def _write_rig_recording(job: Job, name: str, part: Path) -> None:
    experiment, planned = job.experiment, job.experiment.recordings[name]
    model = rig_model(experiment)
    machine, run = machine_at(experiment, planned, model), rig_experiment(experiment, planned)
    surfaces = model.key_parameters if isinstance(run, ScheduledRun) else None
    options = record_options(experiment, planned)
    controller = running(experiment, planned, machine, options) if planned.in_loop else None
    made = record(machine, run, surfaces=surfaces, controller=controller, **options)
    save_recording(made, part, overwrite=True)


RIG = Stage("rig", "rig", RIG_CHECKS, rig_tasks, early=True)
"""Recordings of the virtual rig, ``recordings/<name>.h5``."""
