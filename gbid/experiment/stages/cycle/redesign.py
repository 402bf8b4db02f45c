"""Surfaces and controller of a round, from all recordings so far."""

from __future__ import annotations

from pathlib import Path

from gbid.experiment.keys import stored_key
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Made
from gbid.experiment.stages.cycle.closed_recordings import closed_entries
from gbid.experiment.stages.cycle.plan import DESIGN, SURFACES, cycle_design, round_folder, round_of, surfaces_file
from gbid.experiment.stages.lpv.stage import read_status, write_model_beside, write_surfaces
from gbid.experiment.stages.lpv.surfaces import Surfaces
from gbid.experiment.stages.tune.plan import controller_section
from gbid.experiment.stages.tune.stage import (
    designed,
    key_from_surfaces,
    plant_of_surfaces,
    read_design_summary,
    save_design,
    write_controller_of,
)
from gbid.lpv import load_lpv_fit


def surfaces_task(job: Job, number: int) -> Task:
    """Return the task of the surfaces of a round; its fits must exist."""
    path = job.path(round_folder(number), SURFACES)
    return Task("cycle surfaces", f"round{number}", path, _surfaces(job, number).key, _write_surfaces)


def model_task(job: Job, number: int) -> Task:
    """Return the task of the model file of these surfaces, which is written after them."""
    path = job.path(round_folder(number), SURFACES)
    return Task(
        "cycle model", f"round{number}", path.with_suffix(".yaml"), stored_key(path), _write_model, (), read_status
    )


def design_task(job: Job, number: int) -> Task:
    """Return the task of the design of a round; its surfaces must exist."""
    section = controller_section(job.experiment, cycle_design(job.experiment))
    key = key_from_surfaces(job.experiment, section, surfaces_file(job, number))
    path = job.path(round_folder(number), DESIGN)
    return Task("cycle design", f"round{number}", path, key, _write_design, (), read_design_summary)


def controller_task(job: Job, number: int) -> Task:
    """Return the task of the controller file of a round; its design must exist."""
    path = job.path(round_folder(number), DESIGN)
    return Task("cycle controller", f"round{number}", path.with_suffix(".yaml"), stored_key(path), _write_controller)


def _surfaces(job: Job, number: int) -> Surfaces:
    return Surfaces(job, closed_entries(job, number))


def _write_surfaces(job: Job, item: str, part: Path) -> Made:
    assert job.experiment.spec.lpv is not None
    surfaces = _surfaces(job, round_of(item))
    return write_surfaces(surfaces.make(job.experiment.spec.lpv.fit), part, surfaces.key)


def _write_model(job: Job, item: str, part: Path) -> Made:
    return write_model_beside(job.path(round_folder(round_of(item)), SURFACES), part)


def _write_design(job: Job, item: str, part: Path) -> Made:
    name = cycle_design(job.experiment)
    section = controller_section(job.experiment, name)
    fit = load_lpv_fit(surfaces_file(job, round_of(item)))
    return save_design(designed(job, name, *plant_of_surfaces(section, fit)), part)


def _write_controller(job: Job, item: str, part: Path) -> None:
    number = round_of(item)
    model = load_lpv_fit(surfaces_file(job, number)).model
    write_controller_of(job, cycle_design(job.experiment), job.path(round_folder(number), DESIGN), model, part)
