"""Stage of the surfaces over pressure and speed (paper, Sec. 4)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gbid import hdf5
from gbid.atomic import scratch_folder
from gbid.errors import GbidError
from gbid.experiment.keys import stored_key
from gbid.experiment.run.inputs import cause_of
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Made, Outcome
from gbid.experiment.run.stage import Stage, Work
from gbid.experiment.stages.lpv.checks import surfaces_can_be_drawn
from gbid.experiment.stages.lpv.surfaces import DIRECT, Surfaces
from gbid.lpv import LPVFit, load_lpv_fit
from gbid.lpv.load import write_model
from gbid.lpv.surface_fit.lpv_fit_store import KIND, write_uncertainty

FOLDER = "lpv"
_UNCERTAINTY = " uncertainty"
_MODEL = "model_file"  # attribute with the model's YAML: the surfaces are then computed once for both files


def lpv_tasks(job: Job) -> Work:
    """Return the task of the lpv section; the model and the direct LPV fit follow."""
    section = job.experiment.spec.lpv
    if section is None:
        return []
    try:
        return [_uncertainty_task(job, section.fit)]
    except GbidError as error:
        path = job.path(FOLDER, section.fit)
        return [Outcome("lpv", f"{section.fit}{_UNCERTAINTY}", path, "failed", str(error), cause=cause_of(error))]


def _model_tasks(job: Job, made: Sequence[Outcome]) -> list[Task]:
    """Return the task of the model; a model is written only after its uncertainty."""
    last = made[-1] if made else None
    if last is None or last.state == "failed" or last.path.suffix != ".h5":
        return []
    item = last.item.removesuffix(_UNCERTAINTY)
    path = job.path(FOLDER, item, ".yaml")
    return [Task("lpv", item, path, stored_key(last.path), _write_model, read=read_status)]


def _direct_tasks(job: Job, made: Sequence[Outcome]) -> list[Task]:
    section = job.experiment.spec.lpv
    if section is None or not section.direct or any(outcome.state == "failed" for outcome in made):
        return []
    return [_uncertainty_task(job, f"{section.fit}{DIRECT}")]


def _uncertainty_task(job: Job, item: str) -> Task:
    return Task("lpv", f"{item}{_UNCERTAINTY}", job.path(FOLDER, item), Surfaces(job).key, _write_uncertainty)


def made_surfaces(outcomes: Sequence[Outcome]) -> dict[str, LPVFit]:
    """Return the existing surfaces by item; the two-step ones first."""
    return {
        o.item: load_lpv_fit(o.path)
        for o in outcomes
        if o.stage == "lpv" and o.state != "failed" and o.path.suffix == ".yaml"
    }


def read_surfaces(job: Job) -> dict[str, LPVFit]:
    """Return the surfaces made from the present fits, by item; empty when there are none."""
    section = job.experiment.spec.lpv
    if section is None:
        return {}
    try:
        key = Surfaces(job).key
    except (GbidError, OSError):
        return {}
    paths = {item: job.path(FOLDER, item, ".yaml") for item in (section.fit, f"{section.fit}{DIRECT}")}
    return {item: load_lpv_fit(path) for item, path in paths.items() if stored_key(path) == key}


def _write_uncertainty(job: Job, item: str, part: Path) -> Made:
    surfaces = Surfaces(job)
    return write_surfaces(surfaces.make(item.removesuffix(_UNCERTAINTY)), part, surfaces.key)


def write_surfaces(fit: LPVFit, part: Path, key: str) -> Made:
    """Write the uncertainty of surfaces, with the text of the model file beside it."""
    with scratch_folder(part) as folder:
        file = folder / "model.yaml"
        write_model(fit.model, file, comment=f"content_key: {key}")
        text = file.read_text(encoding="utf-8")
    with hdf5.writing(part, KIND, overwrite=True) as h5:
        write_uncertainty(fit, h5, key)
        h5.attrs[_MODEL] = text
    return Made(fit.status)


def _write_model(job: Job, item: str, part: Path) -> Made:
    return write_model_beside(job.path(FOLDER, item), part)


def write_model_beside(path: Path, part: Path) -> Made:
    """Write the model file whose text is in the file of the uncertainty."""
    with hdf5.reading(path, KIND) as file:
        part.write_text(str(hdf5.read_attribute(file, _MODEL)), encoding="utf-8")
    return read_status(path)


def read_status(path: Path) -> Made:
    """Return the summary of surfaces."""
    with hdf5.reading(path.with_suffix(".h5"), KIND) as file:
        success, status = (hdf5.read_attribute(file, name) for name in ("success", "status"))
    return Made(str(status), bool(success))


LPV = Stage("lpv", "lpv", (surfaces_can_be_drawn,), lpv_tasks, (_model_tasks, _direct_tasks, _model_tasks))
"""``lpv/<fit>.yaml`` and ``.h5``, and ``lpv/<fit>_direct.*`` when the direct LPV fit is wanted.

A model and its uncertainty are separate outcomes.
"""
