"""What a controller section asks for: structure, model, impact, sampling."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gbid.control import HalfSine, Scheduled, controller_structure, scheduled
from gbid.control.controllers.built_in import built_in_structures
from gbid.errors import UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.problems import nearest
from gbid.experiment.stages.rig.model import rig_model
from gbid.experiment.stages.tune.schema import ControllerSection
from gbid.lpv import Domain, LPVModel, ProportionalDesign, load_model
from gbid.structure import load_structure
from gbid.structure.linear import Structure

SURFACES = {"lpv": "", "lpv_direct": "_direct"}
"""Words for the surfaces of an experiment, and what their files add to the name of the fit."""
_SAMPLE_TIME_S = 2e-4


def controller_section(experiment: Experiment, name: str) -> ControllerSection:
    """Return the section of a design.

    Raises
    ------
    UsageError
        When there is none of this name.
    """
    designs = experiment.spec.controller
    if name not in designs:
        raise UsageError(f"controller: no design {name!r}; {nearest(name, designs)}")
    return designs[name]


def model_word(experiment: Experiment, section: ControllerSection) -> str | None:
    """Return which model a design is for: ``lpv``, ``lpv_direct``, a name or file; None for the rig's own."""
    return section.model or ("lpv" if experiment.spec.lpv is not None else None)


def surfaces_item(experiment: Experiment, section: ControllerSection) -> str | None:
    """Return the name of the surfaces that a design is for, None when it is for another model."""
    word = model_word(experiment, section)
    if word not in SURFACES:
        return None
    if experiment.spec.lpv is None:
        raise UsageError("there is no section 'lpv'; add one, or name a model")
    return f"{experiment.spec.lpv.fit}{SURFACES[str(word)]}"


def named_model(experiment: Experiment, section: ControllerSection) -> LPVModel:
    """Load the model of a design that is not for the surfaces of the experiment.

    Raises
    ------
    UsageError
        When it is not there or knows no actuators, or none is named and there is no rig either.
    """
    word = model_word(experiment, section)
    if word is None:
        if experiment.spec.rig is None:
            raise UsageError("needs a model; name one, or add a section lpv")
        model = rig_model(experiment)
    else:
        path = Path(word)
        model = load_model(experiment.folder / path if path.suffix in (".yaml", ".yml") else word)
    return with_actuators(model)


def with_actuators(model: LPVModel) -> LPVModel:
    """Return a model that a loop can be closed on.

    Raises
    ------
    UsageError
        When it has no actuators.
    """
    if not model.actuators:
        raise UsageError(f"model {model.name!r} has no actuators, which a closed loop needs; add them (lpv: actuators)")
    return model


def design_structure(
    experiment: Experiment, section: ControllerSection, domain: Domain | None = None
) -> Structure | Scheduled:
    """Build the controller's structure.

    Parameters
    ----------
    experiment : Experiment
    section : ControllerSection
    domain : Domain, optional
        Range of pressure and speed that scales a schedule.

    Raises
    ------
    UsageError
        For an unknown structure or option, or a file that does not give one.
    """
    given = {key: getattr(section, key) for key in ("lowpass_hz", "order", "tune_corner")}
    options = {key: value for key, value in given.items() if value is not None}
    if section.structure in built_in_structures():
        base = controller_structure(section.structure, **options)
    elif ":" not in section.structure:
        hint = nearest(section.structure, built_in_structures())
        raise UsageError(f"no structure {section.structure!r}; {hint} (or name one of your own as file.py:name)")
    else:
        base = controller_structure(load_structure(section.structure, experiment.folder), **options)
        if (len(base.inputs), len(base.outputs)) != (2, 2):
            raise UsageError(f"structure {section.structure!r}: a controller has two inputs and two outputs")
    return base if section.schedule is None else scheduled(base, section.schedule, domain)


def structure_text(experiment: Experiment, section: ControllerSection) -> bytes:
    """Return the text of the file that a structure of one's own is in, for content keys; empty for the others."""
    file = section.structure.rpartition(":")[0]
    return (experiment.folder / file).read_bytes() if file else b""


def impact(section: ControllerSection) -> HalfSine:
    """Return the impact that designs are compared under: that of the section, or the default."""
    given = section.impact
    return HalfSine() if given is None else HalfSine(given.peak_n, given.duration_s)


def tune_options(section: ControllerSection) -> dict[str, Any]:
    """Return the arguments of `gbid.tune` that the section gives as they are; not model, structure and cap."""
    points: Any = {"model": None, "domain": "domain"}.get(str(section.operating_points))
    if not isinstance(section.operating_points, str):
        points = [(q.pressure_bar, q.speed_rpm) for q in section.operating_points]
    options: dict[str, Any] = {
        "operating_points": points,
        "bounds": section.bounds or None,
        "start": section.start or None,
        **{
            key: getattr(section, key)
            for key in ("peak_control", "static_amplification", "slowest_pole", "objective", "starts", "seed")
        },
    }
    if section.impact is not None:
        options |= {"impact": impact(section), "piezo_travel_m": section.impact.piezo_travel_m}
    return options


def assess_options(experiment: Experiment, section: ControllerSection) -> dict[str, Any]:
    """Return the conditions under which designs are assessed, as arguments of `gbid.control.assess`; not the points."""
    travel = None if section.impact is None else section.impact.piezo_travel_m
    return {
        "sample_time": sample_time(experiment, section),
        "method": section.method,
        "impact": impact(section),
        "piezo_travel_m": travel,
    }


def sample_time(experiment: Experiment, section: ControllerSection) -> float:
    """Return the time at which the controller is sampled [s]."""
    rig = experiment.spec.rig
    return section.sample_time_s or (rig.sample_time_s if rig is not None else _SAMPLE_TIME_S)


def published_design(experiment: Experiment, model: LPVModel) -> ProportionalDesign | None:
    """Return the controller that came with the model, or with the rig; None when there is none."""
    if model.controller is not None or experiment.spec.rig is None:
        return model.controller
    return rig_model(experiment).controller


def published_structure(came: ProportionalDesign) -> Structure:
    """Return the structure of a controller that came with a model."""
    return controller_structure("P", lowpass_hz=came.lowpass_hz, order=came.lowpass_order)
