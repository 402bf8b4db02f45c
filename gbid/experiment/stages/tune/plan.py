"""Plan of a design: structure, model, impact and sampling from its controller section."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gbid.control import HalfSine, Scheduled, controller_structure, scheduled
from gbid.control.controllers.built_in import built_in_structures
from gbid.control.controllers.scheduled import with_schedule
from gbid.errors import UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.keys import content_key
from gbid.experiment.problems import nearest
from gbid.experiment.stages.rig.model import rig_model
from gbid.experiment.stages.tune.design_goals import impact_of_goals
from gbid.experiment.stages.tune.schema import ControllerSection
from gbid.lpv import Domain, LPVModel, ProportionalDesign, load_model
from gbid.structure import NonlinearStructure, ScheduledStructure, load_structure
from gbid.structure.linear import Structure

SURFACES = {"lpv": "", "lpv_direct": "_direct"}
"""Words for the surfaces of an experiment, and the suffixes of their files."""
SHORT_FORM = (
    "peak_sensitivity",
    "peak_control",
    "static_amplification",
    "slowest_pole",
    "objective",
    "impact",
)
"""Keys of a design in whose place goals come."""
_SAMPLE_TIME_S = 2e-4


def controller_section(experiment: Experiment, name: str) -> ControllerSection:
    """Return the section of a design.

    Raises
    ------
    UsageError
        When no design has this name.
    """
    designs = experiment.spec.controller
    if name not in designs:
        raise UsageError(f"controller: no design {name!r}; {nearest(name, designs)}")
    return designs[name]


def model_word(experiment: Experiment, section: ControllerSection) -> str | None:
    """Return the model entry of a design: ``lpv``, ``lpv_direct``, a name or file; None for the model of the rig."""
    return section.model or ("lpv" if experiment.spec.lpv is not None else None)


def surfaces_item(experiment: Experiment, section: ControllerSection) -> str | None:
    """Return the name of the surfaces of a design; None when it uses another model."""
    word = model_word(experiment, section)
    if word not in SURFACES:
        return None
    if experiment.spec.lpv is None:
        raise UsageError("there is no section 'lpv'; add one, or name a model")
    return f"{experiment.spec.lpv.fit}{SURFACES[str(word)]}"


def named_model(experiment: Experiment, section: ControllerSection) -> LPVModel:
    """Return the model of a design that does not use the surfaces of the experiment.

    Raises
    ------
    UsageError
        When the model is missing, has no actuators, or is not named in an experiment without rig.
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
    """Return the model after a check that it has actuators, which a closed loop needs.

    Raises
    ------
    UsageError
        When the model has no actuators.
    """
    if not model.actuators:
        raise UsageError(f"model {model.name!r} has no actuators, which a closed loop needs; add them (lpv: actuators)")
    return model


def design_structure(
    experiment: Experiment, section: ControllerSection, domain: Domain | None = None
) -> Structure | Scheduled:
    """Return the structure of the controller.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    section : ControllerSection
        Section of the design.
    domain : Domain, optional
        Range of pressure and speed that scales a schedule.

    Returns
    -------
    Structure or Scheduled
        The structure, scheduled when the section has a schedule.

    Raises
    ------
    UsageError
        When the structure or an option is unknown, or the file does not define a structure.
    """
    given = {key: getattr(section, key) for key in ("lowpass_hz", "order", "tune_corner")}
    # a whole number stays one: orders are counted
    own = {key: int(v) if isinstance(v, float) and v.is_integer() else v for key, v in section.options.items()}
    options = {**own, **{key: value for key, value in given.items() if value is not None}}
    if section.structure in built_in_structures():
        base = controller_structure(section.structure, **options)
    elif ":" not in section.structure:
        hint = nearest(section.structure, built_in_structures())
        raise UsageError(f"no structure {section.structure!r}; {hint} (or name one of your own as file.py:name)")
    else:
        chosen = load_structure(section.structure, experiment.folder)
        if isinstance(chosen, NonlinearStructure | ScheduledStructure):
            raise UsageError(f"structure {section.structure!r}: a controller is a gbid.LinearStructure")
        base = controller_structure(chosen, **options)
        if (len(base.inputs), len(base.outputs)) != (2, 2):
            raise UsageError(f"structure {section.structure!r}: a controller has two inputs and two outputs")
    return with_schedule(base, domain) if section.schedule is None else scheduled(base, section.schedule, domain)


def structure_text(experiment: Experiment, section: ControllerSection) -> bytes:
    """Return the text of the file of a user's structure, for content keys; empty for built-in structures."""
    file = section.structure.rpartition(":")[0]
    return (experiment.folder / file).read_bytes() if file else b""


def impact(section: ControllerSection) -> HalfSine:
    """Return the impact for the assessment of designs: that of the goals or of the section, or the default."""
    goal, given = impact_of_goals(section), section.impact
    if goal is not None:
        return goal.impact
    return HalfSine() if given is None else HalfSine(given.peak_n, given.duration_s)


def tune_options(section: ControllerSection) -> dict[str, Any]:
    """Return the arguments of `gbid.tune` from the section, except model, structure and cap."""
    points: Any = {"model": None, "domain": "domain"}.get(str(section.operating_points))
    if not isinstance(section.operating_points, str):
        points = [(q.pressure_bar, q.speed_rpm) for q in section.operating_points]
    options: dict[str, Any] = {
        "operating_points": points,
        "bounds": section.bounds or None,
        "start": section.start or None,
        "starts": section.starts,
        "seed": section.seed,
    }
    if section.goals is None:
        options |= {key: getattr(section, key) for key in SHORT_FORM[1:5]}
    if section.impact is not None:
        options |= {"impact": impact(section), "piezo_travel_m": section.impact.piezo_travel_m}
    return options


def assess_options(experiment: Experiment, section: ControllerSection) -> dict[str, Any]:
    """Return the arguments of `gbid.control.assess` from the section, except the points."""
    goal = impact_of_goals(section)
    travel = section.impact.piezo_travel_m if section.impact else goal.travel_m if goal else None
    return {
        "sample_time": sample_time(experiment, section),
        "method": section.method,
        "impact": impact(section),
        "piezo_travel_m": travel,
    }


def sample_time(experiment: Experiment, section: ControllerSection) -> float:
    """Return the sample time of the controller [s]."""
    rig = experiment.spec.rig
    return section.sample_time_s or (rig.sample_time_s if rig is not None else _SAMPLE_TIME_S)


def published_design(experiment: Experiment, model: LPVModel) -> ProportionalDesign | None:
    """Return the published controller of the model or of the rig; None when there is none."""
    if model.controller is not None or experiment.spec.rig is None:
        return model.controller
    return rig_model(experiment).controller


def published_structure(came: ProportionalDesign) -> Structure:
    """Return the structure of a published controller."""
    return controller_structure("P", lowpass_hz=came.lowpass_hz, order=came.lowpass_order)


def design_key(
    experiment: Experiment,
    section: ControllerSection,
    published: ProportionalDesign | None,
    model: LPVModel | None = None,
    sources: Sequence[str] = (),
) -> str:
    """Return the content key of a design.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    section : ControllerSection
        Section of the design.
    published : ProportionalDesign, optional
        Published controller, which is assessed beside it.
    model : LPVModel, optional
        Named model; None for surfaces, whose keys are among the sources.
    sources : sequence of str
        Content keys of surfaces and recordings.
    """
    settings = {
        **section.model_dump(),
        "text": structure_text(experiment, section).decode(errors="replace"),
        "sampled_at": sample_time(experiment, section),
        "published": published,
        "model": model,
    }
    return content_key("tuned design", settings, sources)
