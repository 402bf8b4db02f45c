"""Controllers of recordings in closed loop: which one the YAML means, its gains, and its content key."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from gbid.control import ControllerDesign, load_controller, p_controller
from gbid.control.assessment.tuned_design import load_tuned
from gbid.control.controllers.scheduled import Scheduled
from gbid.errors import UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.keys import file_digest, stored_key
from gbid.experiment.plan import PlannedRecording
from gbid.experiment.problems import nearest
from gbid.experiment.run.inputs import InputError
from gbid.experiment.stages.impact.loop_program import loop_settings
from gbid.experiment.stages.impact.plan import TUNED, is_tuned, tuned_design
from gbid.experiment.stages.loop.schema import ControllerChoice, LoopSection
from gbid.experiment.stages.rig.model import rig_model
from gbid.experiment.stages.tune.design_goals import goal_recordings
from gbid.experiment.stages.tune.plan import (
    design_key,
    design_structure,
    named_model,
    published_design,
    sample_time,
    structure_text,
    surfaces_item,
)
from gbid.experiment.stages.tune.schema import ControllerSection
from gbid.structure import LinearModel, NonlinearStructure, ScheduledStructure, load_structure_or_model
from gbid.structure.linear import Structure

RIG = "rig"
"""What a loop without controller and structure means: the controller of the rig's recordings."""
_SAMPLE_TIME_S = 2e-4


@dataclass(frozen=True, eq=False)
class FoundController:
    """Controller of a loop.

    Attributes
    ----------
    name : str
        Its name.
    design : ControllerDesign or None
        A controller whose gains are known, over operating points.
    model : LinearModel or None
        A known model of your own, continuous or sampled.
    structure : Structure or None
        A controller with unknown gains.
    """

    name: str
    design: ControllerDesign | None = None
    model: LinearModel | None = None
    structure: Structure | None = None


def chosen(experiment: Experiment, section: ControllerChoice) -> ControllerChoice:
    """Return the section that names the controller: for an empty one of a fit that of the rig.

    Raises
    ------
    UsageError
        When nothing or too much is named.
    """
    if section.controller is not None and section.structure is not None:
        raise UsageError("controller and structure both name a controller; remove one of the two")
    if section.controller is None and section.structure is None:
        rig = experiment.spec.rig
        if isinstance(section, LoopSection) and rig is not None and rig.loop is not None:
            return rig.loop
        raise UsageError("names no controller; write controller: paper, tuned or a file, or structure: with gains:")
    if section.controller is not None:
        for key in ("gains", "lowpass_hz", "order", "options"):
            if getattr(section, key):
                raise UsageError(f"{key} is for structure:, not for controller: {section.controller}; remove it")
    return section


def found_controller(experiment: Experiment, section: ControllerChoice, *, planned: bool = False) -> FoundController:
    """Return the controller that a section means.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    section : ControllerChoice
        The section.
    planned : bool
        Whether a design that is not tuned yet may stand with the start values of its gains, for checks before a run.

    Raises
    ------
    UsageError
        When there is no such controller, or when it is faulty.
    InputError
        When a design has not been tuned with the present settings.
    """
    section = chosen(experiment, section)
    word = section.controller
    if word is None:
        return _of_structure(experiment, section)
    if word == "paper":
        return FoundController(word, _published(experiment))
    if is_tuned(word):
        return FoundController(word, _tuned(experiment, tuned_design(experiment, word), planned))
    if ":" in word:
        return _of_python(experiment, word)
    path = experiment.folder / word
    if not path.is_file():
        raise UsageError(f"{path}: no such controller file; write paper, tuned, or the name of one")
    return FoundController(word, load_controller(path))


def controller_identity(experiment: Experiment, section: ControllerChoice) -> dict[str, Any]:
    """Return what a controller is made from, for content keys; known before anything runs.

    Raises
    ------
    UsageError
        When there is no such controller.
    """
    section = chosen(experiment, section)
    word = section.controller
    settings: dict[str, Any] = section.model_dump(include=set(ControllerChoice.model_fields))
    if word is None:
        settings["text"] = structure_text(experiment, _as_design(section)).decode(errors="replace")
    elif word == "paper":
        settings["design"] = repr(rig_model(experiment).controller)
    elif is_tuned(word):
        settings["design"] = early_key(experiment, tuned_design(experiment, word))
    else:
        file = word.rpartition(":")[0] or word
        settings["digest"] = file_digest(experiment.folder_of(file) / file)
    return settings


def closed_loop_settings(experiment: Experiment) -> dict[str, Any]:
    """Return the settings of the rig's loop for content keys; known before a design is tuned."""
    rig, prefilter = experiment.spec.rig, experiment.spec.prefilter
    assert rig is not None
    assert rig.loop is not None
    settings = {
        "loop": controller_identity(experiment, rig.loop),
        "runout": rig.loop.runout,
        **loop_settings(experiment),
    }
    if rig.loop.runout == "online" and prefilter is not None:
        settings["map"] = prefilter.model_dump(include={"method", "harmonics", "bins"})
    return settings


def stationary_at(experiment: Experiment, point: str) -> list[PlannedRecording]:
    """Return the stationary recordings of the rig without controller at an operating point."""
    return [q for q in experiment.points.get(point, ()) if q.stationary and q.imported is None]


def answered(experiment: Experiment, planned: PlannedRecording) -> bool:
    """Return whether the controller of a recording answers to run-out, because it does not subtract it."""
    rig = experiment.spec.rig
    return planned.in_loop and rig is not None and rig.loop is not None and rig.loop.runout == "offline"


def loop_stills(experiment: Experiment, point: str) -> list[PlannedRecording]:
    """Return the recordings of the rig under the controller and without excitation at an operating point."""
    return [planned for planned in experiment.points[point] if planned.run[:1] == ("loop_still",)]


def early_designs(experiment: Experiment) -> list[str]:
    """Return the names of the designs that close the loop of recordings, so that they are tuned before all others."""
    spec, found = experiment.spec, []
    loops = [spec.rig.loop if spec.rig else None, *(fit.loop for fit in spec.fits.values())]
    for section in loops:
        if section is not None and section.controller is not None and is_tuned(section.controller):
            try:
                found.append(tuned_design(experiment, section.controller))
            except UsageError:
                continue  # a check reports it
    return list(dict.fromkeys(found))


def check_early(experiment: Experiment, name: str) -> None:
    """Refuse a design that needs the recordings of this experiment.

    Raises
    ------
    UsageError
        When it is for their surfaces, or when its goals name recordings.
    """
    section = experiment.spec.controller[name]
    if surfaces_item(experiment, section) is not None:
        raise UsageError(
            f"design {name!r} is for the surfaces of this experiment, which come after its recordings; write model: "
            "with the name of a model there, or name a controller file"
        )
    if goal_recordings(experiment, section):
        raise UsageError(f"design {name!r} has goals with recordings of this experiment; name a controller file")


def early_key(experiment: Experiment, name: str) -> str:
    """Return the content key of a design for a named model; `gbid tune` stores the same.

    Raises
    ------
    UsageError
        When the design needs recordings.
    """
    check_early(experiment, name)
    section = experiment.spec.controller[name]
    model = named_model(experiment, section)
    return design_key(experiment, section, published_design(experiment, model), model)


def at_point(design: ControllerDesign, conditions: dict[str, float]) -> tuple[float | None, float | None]:
    """Return the operating point at which a design is needed: pressure and speed, or nothing.

    Raises
    ------
    UsageError
        When its gains follow an operating point that is not known.
    """
    point = (conditions.get("pressure_bar"), conditions.get("speed_rpm"))
    scheduled = isinstance(design.structure, Scheduled) or (design.structure is None and None not in design.models)
    if scheduled and None in point:
        raise UsageError(
            f"controller {design.name!r}: its gains follow the operating point; write a fit for each operating point"
        )
    return point


def _of_structure(experiment: Experiment, section: ControllerChoice) -> FoundController:
    structure = design_structure(experiment, _as_design(section), None)
    if isinstance(structure, Scheduled):
        raise UsageError(f"structure {structure.name!r} follows the speed; name a controller file")
    names = [gain.name for gain in structure.parameters]
    unknown = [name for name in section.gains if name not in names]
    if unknown:
        raise UsageError(f"{structure.name} has no gain {unknown[0]!r}; {nearest(unknown[0], names)}")
    if len(section.gains) < len(names):
        return FoundController(structure.name, structure=structure)
    own_rate = section.sample_time_s if isinstance(section, LoopSection) else None
    return FoundController(
        structure.name, ControllerDesign(structure.name, structure, section.gains, own_rate or rig_time(experiment))
    )


def rig_time(experiment: Experiment) -> float:
    """Return the sample time of controllers that state none: that of the rig [s]."""
    rig = experiment.spec.rig
    return rig.sample_time_s if rig is not None else _SAMPLE_TIME_S


def _as_design(section: ControllerChoice) -> ControllerSection:
    """Return the structure and its options as a section of a design, whose rules are the same."""
    given = section.model_dump(include={"structure", "lowpass_hz", "order", "options"}, exclude_none=True)
    return ControllerSection.model_validate(given)


def _of_python(experiment: Experiment, word: str) -> FoundController:
    own = load_structure_or_model(word, experiment.folder_of(word.rpartition(":")[0]))
    if isinstance(own, LinearModel):
        return FoundController(word, model=own)
    if isinstance(own, NonlinearStructure | ScheduledStructure):
        raise UsageError(f"{word}: a controller is a gbid.LinearModel or a gbid.LinearStructure")
    return FoundController(word, structure=own)


def _published(experiment: Experiment) -> ControllerDesign:
    if experiment.spec.rig is None:
        raise UsageError("controller: paper is that of the model of the rig, and there is no section rig; name a file")
    design = rig_model(experiment).controller
    if design is None:
        raise UsageError(f"model {rig_model(experiment).name!r} comes with no controller; name a controller file")
    continuous = p_controller(design.kappa_x, design.kappa_y, design.lowpass_hz, design.lowpass_order)
    return ControllerDesign("paper", None, {}, rig_time(experiment), models={None: continuous})


def _tuned(experiment: Experiment, name: str, planned: bool) -> ControllerDesign:
    key, section = early_key(experiment, name), experiment.spec.controller[name]
    path = experiment.results / TUNED / f"{name}.h5"
    structure = design_structure(experiment, section, named_model(experiment, section).domain)
    if path.is_file() and stored_key(path) == key:
        gains = _stored_gains(path, key)
    elif planned:
        gains = {gain.name: _about(gain.start, gain.lower, gain.upper) for gain in structure.parameters}
    else:
        raise InputError(f"{path}: no design {name!r} with the present settings; `gbid tune` makes it")
    return ControllerDesign(name, structure, gains, sample_time(experiment, section), section.method)


@lru_cache(maxsize=16)
def _stored_gains(path: Path, _key: str) -> dict[str, float]:
    return dict(load_tuned(path).result.gains)


def _about(start: float | None, lower: float, upper: float) -> float:
    if start is not None:
        return start
    return float(np.clip(0.0, lower, upper))
