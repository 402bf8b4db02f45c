"""Controllers of an experiment: goals, designs, impacts, control chain, and controllers in the loop of recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from gbid import control, export, lpv
from gbid.core.errors import UsageError, nearest
from gbid.core.hdf5 import load
from gbid.experiment.experiment import Experiment, PlannedRecording
from gbid.experiment.fields import InputError, Item, Result, about, file_digest, needed, stored_key
from gbid.experiment.machine import PlannedRun, machine_data, rig_machine, rig_model
from gbid.experiment.rig_schema import ControllerChoice, ControllerName, LoopSection, Place
from gbid.experiment.schema import (
    ControllerSection,
    TargetSection,
)
from gbid.experiment.user_code import file_of, user_structure, user_structure_or_model
from gbid.lpv.model_file import ProportionalDesign, PublishedMachine
from gbid.prefilter.runout_identification import identify_runout
from gbid.rig import ProgramController, SampledController, Stationary
from gbid.structure import LinearModel, LinearStructure
from gbid.structure.kinds import kind_of
from gbid.structure.linear import Structure

if TYPE_CHECKING:
    from gbid.control.assessment import TunedDesign
    from gbid.experiment.goal_schema import GoalEntry

# ---- Goals of a design from the entries of its controller section.

Disturbance = Callable[[tuple[str, ...]], "control.DisturbanceSpectrum"]
"""From names of recordings to the disturbance that they show."""


def made_goal(entry: GoalEntry, disturbance: Disturbance) -> control.Goal:
    """Return the goal object of a YAML entry.

    Parameters
    ----------
    entry : GoalEntry
        Name and arguments.
    disturbance : callable
        Returns the disturbance of the recordings that an entry names.

    Raises
    ------
    UsageError
        When an argument is not allowed.
    """
    arguments = dict(entry.arguments)
    for name, value in arguments.items():
        if name == "impact":
            arguments[name] = control.HalfSine(**value)
        elif name == "disturbance":
            arguments[name] = disturbance(value)
        elif name == "spectrum":
            n = len(arguments["sources"])
            if any(len(row) != 1 + n for row in value):
                raise UsageError(
                    f"{entry.goal}: spectrum; give rows of a frequency and a density for each of {n} sources"
                )
            hz, *densities = zip(*value, strict=True)
            density = np.array(densities).T[:, :, None] * np.eye(n)
            arguments[name] = control.DisturbanceSpectrum(np.array(hz, float), density.astype(complex), "spectrum")
        elif isinstance(value, Mapping):
            arguments[name] = _transfer_function(value, f"{entry.goal}: {name}")
    goal: control.Goal = getattr(control, entry.goal)(**arguments)
    return goal


def goal_recordings(experiment: Experiment, section: ControllerSection) -> list[PlannedRecording]:
    """Return the recordings whose disturbance spectrum the goals of a design need."""
    named = (entry.arguments.get("disturbance", ()) for entry in section.goals or ())
    return experiment.matching(tuple(pattern for patterns in named for pattern in patterns))


def peak_cap(section: ControllerSection) -> float | None:
    """Return the limit on the peak of S_o at all frequencies; None if a design has none."""
    if section.goals is None:
        return section.peak_sensitivity
    limits = [entry.arguments["limit"] for entry in section.goals if _caps_peak(entry)]
    return min(map(float, limits), default=None)


def without_cap(section: ControllerSection, goals: Sequence[control.Goal]) -> list[control.Goal]:
    """Return the goals of a design without its limits on the peak of S_o, for a Pareto front with other limits."""
    return [goal for goal, entry in zip(goals, section.goals or (), strict=True) if not _caps_peak(entry)]


def no_disturbance(_names: tuple[str, ...]) -> control.DisturbanceSpectrum:
    """Return a placeholder disturbance for checks before the recordings exist."""
    return control.DisturbanceSpectrum(np.array([1.0, 2.0]), np.tile(1e-18 * np.eye(2, dtype=complex), (2, 1, 1)))


def _caps_peak(entry: GoalEntry) -> bool:
    given = entry.arguments
    return entry.goal == "PeakSensitivity" and not given.get("soft") and isinstance(given["limit"], int | float)


def _transfer_function(given: Mapping[str, Sequence[float]], what: str) -> LinearModel:
    """Return a transfer function of the YAML as a linear model.

    Raises
    ------
    UsageError
        When its denominator is zero, or when the numerator has a higher order.
    """
    numerator, denominator = (np.trim_zeros(np.asarray(given[key], float), "f") for key in ("numerator", "denominator"))
    if not len(denominator) or not len(numerator) or len(numerator) > len(denominator):
        raise UsageError(f"{what}: the numerator must not be zero or of a higher order than the denominator")
    A, B, C, D = scipy.signal.tf2ss(numerator, denominator)
    return LinearModel(A, B, C, D, name=what)


SURFACES = {"lpv": "", "lpv_direct": "_direct"}
"""Words for the surfaces of an experiment, and the suffixes of their files."""


def controller_section(experiment: Experiment, name: str) -> ControllerSection:
    """Return the YAML section of a design.

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
    """Return the model name of a design: ``lpv``, ``lpv_direct``, a name or file; None for the model of the rig."""
    return section.model or ("lpv" if experiment.spec.lpv is not None else None)


def surfaces_item(experiment: Experiment, section: ControllerSection) -> str | None:
    """Return the name of the surfaces that a design uses; None if it uses another model."""
    word = model_word(experiment, section)
    if word not in SURFACES:
        return None
    if experiment.spec.lpv is None:
        raise UsageError("there is no section 'lpv'; add one, or name a model")
    return f"{experiment.spec.lpv.fit}{SURFACES[str(word)]}"


def is_fitted(experiment: Experiment, section: ControllerSection) -> bool:
    """Return whether a design uses the models of a fit as plants."""
    return section.model in experiment.spec.fits


def named_model(experiment: Experiment, section: ControllerSection) -> lpv.LPVModel:
    """Return the model that a design names instead of the surfaces of the experiment.

    Raises
    ------
    UsageError
        When the model is missing, has no actuators, or is not named in an experiment without rig.
    """
    word = model_word(experiment, section)
    if word is not None:
        model = with_actuators(lpv.load_machine(model_source(experiment, word)).model)
        return replace(model, machine=machine_data(experiment).filled(model.machine))
    if experiment.spec.rig is None:
        raise UsageError("needs a model; name a fit or a model, or add a section lpv")
    return with_actuators(rig_model(experiment))


def model_source(experiment: Experiment, word: str) -> Path | str:
    """Return the source of a model name: a file relative to the experiment, or a model of gbid."""
    return experiment.folder / word if Path(word).suffix in (".yaml", ".yml") else word


def with_actuators(model: lpv.LPVModel) -> lpv.LPVModel:
    """Return a model after a check that it has actuators, which a closed loop needs.

    Raises
    ------
    UsageError
        When the model has no actuators.
    """
    if not model.actuators:
        raise UsageError(f"model {model.name!r} has no actuators, which a closed loop needs; add them (lpv: actuators)")
    return model


def design_structure(
    experiment: Experiment, section: ControllerSection, domain: lpv.Domain | None = None
) -> Structure | control.Scheduled:
    """Return the controller structure of a design.

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
    from gbid.control.controllers.built_in import built_in_structures
    from gbid.control.controllers.structures import with_schedule

    given = section.model_dump(include={"lowpass_hz", "order", "tune_corner"}, exclude_none=True)
    # a whole number stays one: orders are counted
    options = {key: int(v) if isinstance(v, float) and v.is_integer() else v for key, v in section.options.items()}
    options |= given
    wrong = "options" if section.options else "structure"
    if section.structure in built_in_structures():
        with about(wrong):
            base = control.controller_structure(section.structure, **options)
    elif not file_of(section.structure):
        hint = nearest(section.structure, built_in_structures())
        text = f"no structure {section.structure!r}; {hint} (or name one of your own as file.py:name)"
        raise UsageError(text, "structure")
    else:
        with about("structure"):
            linear = kind_of(user_structure(section.structure, experiment.folder)).linear
            if linear is None:
                raise UsageError(f"structure {section.structure!r}: a controller is a gbid.LinearStructure")
            with about(wrong):
                base = control.controller_structure(linear, **options)
            if not is_fitted(experiment, section) and (len(base.inputs), len(base.outputs)) != (2, 2):
                raise UsageError(f"structure {section.structure!r}: a controller has two inputs and two outputs")
    with about("schedule"):
        schedule = section.schedule
        return with_schedule(base, domain) if schedule is None else control.scheduled(base, schedule, domain)


def _structure_text(experiment: Experiment, name: str | None) -> str:
    """Return the source text of a user-defined structure, for content keys; empty for built-in structures."""
    file = file_of(name or "")
    return (experiment.folder / file).read_text(errors="replace") if file else ""


def sample_time(experiment: Experiment, section: ControllerSection | ControllerChoice | None = None) -> float:
    """Return the sample time of a controller [s]: from its section, else from the rig."""
    if stated := getattr(section, "sample_time_s", None):
        return float(stated)
    if experiment.spec.rig is None:
        raise UsageError(
            "sample_time_s: without a section rig the sample time of the target is unknown; give it in seconds",
            "sample_time_s",
        )
    return experiment.spec.rig.sample_time_s


def published_machine(experiment: Experiment, section: ControllerSection | None = None) -> PublishedMachine | None:
    """Return the machine that a design names if it has a published controller, else the machine of the rig, if any."""
    if section is not None and is_fitted(experiment, section):
        return None
    word = None if section is None or surfaces_item(experiment, section) else model_word(experiment, section)
    named = None if word is None else lpv.load_machine(model_source(experiment, word))
    if experiment.spec.rig is None or (named is not None and named.controller is not None):
        return named
    return rig_machine(experiment)


def published_design(experiment: Experiment, section: ControllerSection | None = None) -> ProportionalDesign | None:
    """Return the published controller of `published_machine`; None if it has none."""
    machine = published_machine(experiment, section)
    return None if machine is None else machine.controller


def published_structure(design: ProportionalDesign) -> Structure:
    """Return the structure of a published controller."""
    return control.controller_structure("P", lowpass_hz=design.lowpass_hz, order=design.lowpass_order)


def design_result(
    experiment: Experiment, name: str, surfaces: Path | None = None, sources: Iterable[Result] = ()
) -> Result:
    """Return the result file of a tuned design.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    name : str
        Name of the design.
    surfaces : pathlib.Path, optional
        Model file of the surfaces for which it is tuned; without it the model that its section names.
    sources : iterable of Result
        Recordings whose disturbance its goals need, and fits whose models are its plants.

    Raises
    ------
    UsageError
        When the model is missing or has no actuators.
    """
    section = controller_section(experiment, name)
    settings = {
        **section.model_dump(),
        "text": _structure_text(experiment, section.structure),
        "sampled_at": sample_time(experiment, section),
        "published": published_design(experiment, section),
    }
    if surfaces is not None:
        settings["model"] = stored_key(surfaces)
    elif not is_fitted(experiment, section):
        settings["model"] = named_model(experiment, section)
    return experiment.result(Item("tune", name), TUNED, settings, sources)


# ---- Plan of the impacts: recordings, hammer, model of the expected modes, and controllers.

LOOPS = ("open", "closed")
"""Names of the loops that every experiment may have."""
TUNED = "controller"
"""Folder of the tuned controllers in the results."""


@dataclass(frozen=True, eq=False)
class LoopController:
    """Controller of a loop in continuous and in discrete time.

    Attributes
    ----------
    continuous, sampled : LinearModel
        Controllers in continuous time and at the sample time of the rig.
    design : ControllerDesign
        The design, over all operating points.
    """

    continuous: LinearModel
    sampled: LinearModel
    design: control.ControllerDesign


def controller_at(experiment: Experiment, point: Place, loop: str = "closed") -> LoopController:
    """Return the controller of a loop at an operating point.

    Raises
    ------
    UsageError
        When there is none, its file is faulty, or its sample time is not that of the rig.
    """
    word = _word_of(experiment, loop)
    controller = _named_controller(
        experiment, word, lambda name: control.load_controller(_controller_file(experiment, name))
    )
    return running_controller(experiment, controller, point.model_dump())


def controller_key(experiment: Experiment, loop: str) -> str:
    """Return the identity of a loop's controller for content keys; raises as `controller_at`."""
    word = _word_of(experiment, loop)
    return _source_key(experiment, word, lambda name: file_digest(_controller_file(experiment, name)))


def _word_of(experiment: Experiment, loop: str) -> ControllerName:
    section = needed(experiment.spec.impacts, "impacts")
    return {"closed": section.controller, **section.beside}[loop]


def _controller_file(experiment: Experiment, name: str) -> Path:
    """Return the controller file of a design; raises UsageError before `gbid tune` has written it."""
    path = experiment.path(TUNED, name, ending=".yaml")
    if not path.is_file():
        raise UsageError(f"{path}: file is missing; `gbid tune` makes it")
    return path


def running_controller(
    experiment: Experiment, controller: control.ControllerDesign | Structure, conditions: Mapping[str, float]
) -> LoopController:
    """Return a controller at an operating point in the form that the rig runs.

    Raises
    ------
    UsageError
        When its gains are not all known, when it is not for two axes, or when its sample time is not that of the rig.
    """
    if not isinstance(controller, control.ControllerDesign):
        unknown = ", ".join(gain.name for gain in controller.parameters if not gain.fixed)
        raise UsageError(f"controller {controller.name!r}: no value for {unknown}; the rig needs all gains")
    needed_time = needed(experiment.spec.rig, "rig").sample_time_s
    continuous = controller.at(*at_point(controller, conditions))
    label = f"controller {controller.name!r}"
    if continuous.D.shape != (2, 2):
        raise UsageError(f"{label} has not two inputs and two outputs, the axes x and y of the rig")
    sample_time = controller.rate
    if abs(sample_time - needed_time) > 1e-9 * needed_time:
        text = f"sample time is {sample_time:g} s, that of the rig {needed_time:g} s; make it for that"
        raise UsageError(f"{label}: {text}")
    is_continuous = continuous.dt is None
    sampled = control.sample_controller(continuous, sample_time, controller.method) if is_continuous else continuous
    return LoopController(continuous, sampled, controller)


def tuned_design(experiment: Experiment, name: str) -> str:
    """Return the name of a design; for an empty name the only design.

    Raises
    ------
    UsageError
        When there is no such design, or several and the entry names none.
    """
    designs = experiment.spec.controller
    if not designs:
        raise UsageError("there is no section 'controller' with a design; add one")
    if name and name not in designs:
        raise UsageError(f"no design {name!r}; {nearest(name, designs)}")
    if not name and len(designs) > 1:
        raise UsageError(f"several designs are tuned; write tuned:NAME with NAME out of {', '.join(designs)}")
    return name or next(iter(designs))


# ---- Plan of the control chain of an experiment: its options.


def chain_options(experiment: Experiment) -> export.ChainOptions:
    """Return the options of the control chain from the section target, completed by the machine data.

    Raises
    ------
    UsageError
        When values do not fit each other.
    """
    settings = (experiment.spec.target or TargetSection()).model_dump(exclude_unset=True)
    return export.ChainOptions(**settings).on(machine_data(experiment))


# ---- Controller in the rig's loop: sampled matrices, or the exported control chain in C.

_ZEROING_S = 0.5
_HARMONICS = 5
_SHARE_OF_SETTLING = 0.2


def loop_settings(experiment: Experiment) -> dict[str, Any]:
    """Return the settings of the rig's loop for content keys; empty for sampled matrices."""
    rig = needed(experiment.spec.rig, "rig")
    return {} if rig.controller == "python" else {"compiled": asdict(chain_options(experiment))}


def loop_of(
    experiment: Experiment, controller: LoopController, run: PlannedRun
) -> SampledController | ProgramController:
    """Return the controller of the rig for one recording.

    Sampled matrices get the zero position from a stationary run with the same shaft angle. The control chain gets the
    run-out map of this run, as on the machine; ramp and fade are shortened so that they end before the logger starts.

    Raises
    ------
    UsageError
        When there is no C compiler for the control chain.
    """
    rig = needed(experiment.spec.rig, "rig")
    options = {**run.options, "faults": None}
    still = replace(run, experiment=Stationary(_ZEROING_S), surfaces=None, options=options).record()
    if rig.controller == "python":
        sampled = controller.sampled
        A, B, C, D = (np.array(m) for m in (sampled.A, sampled.B, sampled.C, sampled.D))
        zero = still.signal("p").mean(axis=0)
        return SampledController(A, B, C, D, rig.sample_time_s, offset=zero, name=sampled.name)
    section = experiment.spec.prefilter
    harmonics = _HARMONICS if section is None or section.harmonics == "auto" else section.harmonics
    start_s = max(_SHARE_OF_SETTLING * rig.settle_s, controller.design.rate)
    ramps = replace(chain_options(experiment), ramp_s=start_s, fade_s=start_s)
    runout_map = identify_runout([still], harmonics=harmonics)
    chain = export.chain_of(controller.design, name="chain", runout_maps=[runout_map], options=ramps)
    return ProgramController(export.CompiledChain(chain), chain.sample_time, f"{chain.title}, compiled")


# ---- Controllers of recordings in closed loop: controller named in the YAML, its gains, and its content key.

RIG = "rig"
"""What a loop without controller and structure means: the controller of the rig's recordings."""


def chosen(experiment: Experiment, section: ControllerChoice) -> ControllerChoice:
    """Return the section that names a controller; an empty section of a fit refers to the section of the rig.

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


def found_controller(
    experiment: Experiment, section: ControllerChoice, *, planned: bool = False
) -> control.ControllerDesign | Structure:
    """Return the controller of a section: a design, or a structure with unknown gains.

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
    if section.controller is None:
        return _of_structure(experiment, section)
    return _named_controller(experiment, section.controller, partial(_tuned, experiment, planned=planned))


def _named_controller(
    experiment: Experiment, named: ControllerName, tuned: Callable[[str], control.ControllerDesign]
) -> control.ControllerDesign | Structure:
    """Return the controller named in the YAML; the function `tuned` returns designs of the experiment by name."""
    if named.kind == "paper":
        return _published(experiment)
    if named.kind == "tuned":
        return tuned(tuned_design(experiment, named.name))
    if named.kind == "python":
        return _of_python(experiment, named)
    path = experiment.folder / named.file
    if not path.is_file():
        raise UsageError(f"{path}: no such controller file; write paper, tuned, or the name of one")
    return control.load_controller(path)


def _source_key(experiment: Experiment, named: ControllerName, tuned: Callable[[str], str]) -> str:
    """Return the identity of a named controller for content keys; `tuned` returns the key of a design."""
    if named.kind == "paper":
        return repr(rig_machine(experiment).controller)
    if named.kind == "tuned":
        return tuned(tuned_design(experiment, named.name))
    return file_digest(experiment.folder_of(named.file) / named.file)


def controller_identity(experiment: Experiment, section: ControllerChoice) -> dict[str, Any]:
    """Return the sources of a controller for content keys; known before anything runs.

    Raises
    ------
    UsageError
        When there is no such controller.
    """
    section = chosen(experiment, section)
    settings: dict[str, Any] = section.model_dump(include=set(ControllerChoice.model_fields))
    if section.controller is None:
        return {**settings, "text": _structure_text(experiment, section.structure)}
    key = _source_key(experiment, section.controller, lambda name: early_design(experiment, name).key)
    return {**settings, "source": key}


def closed_loop_settings(experiment: Experiment) -> dict[str, Any]:
    """Return the settings of the rig's loop for content keys; known before a design is tuned."""
    loop, prefilter = needed(needed(experiment.spec.rig, "rig").loop, "rig.loop"), experiment.spec.prefilter
    settings = {"loop": controller_identity(experiment, loop), "runout": loop.runout, **loop_settings(experiment)}
    if loop.runout == "online" and prefilter is not None:
        settings["map"] = prefilter.model_dump(include={"method", "harmonics", "bins"})
    return settings


def stationary_at(experiment: Experiment, point: str) -> list[PlannedRecording]:
    """Return the stationary recordings of the rig without controller at an operating point."""
    return [q for q in experiment.points.get(point, ()) if q.stationary and q.imported is None]


def answered(experiment: Experiment, planned: PlannedRecording) -> bool:
    """Return whether the controller responds to run-out because it does not subtract it."""
    rig = experiment.spec.rig
    return planned.in_loop and rig is not None and rig.loop is not None and rig.loop.runout == "offline"


def early_design(experiment: Experiment, name: str) -> Result:
    """Return the result file of a design without recordings of this experiment; `gbid tune` uses it as well.

    Raises
    ------
    UsageError
        When it is for the surfaces of the experiment, or when its goals name recordings.
    """
    section = experiment.spec.controller[name]
    if surfaces_item(experiment, section) is not None:
        raise UsageError(
            f"design {name!r} needs the surfaces of this experiment, which are fitted after its recordings; name a "
            "model in the section of the design (model: ...), or name a controller file"
        )
    if goal_recordings(experiment, section):
        raise UsageError(f"design {name!r} has goals with recordings of this experiment; name a controller file")
    return design_result(experiment, name)


def at_point(design: control.ControllerDesign, conditions: Mapping[str, float]) -> tuple[float | None, float | None]:
    """Return the pressure and speed at which a design is needed; None for a design without schedule.

    Raises
    ------
    UsageError
        When its gains follow an operating point that is not known.
    """
    point = (conditions.get("pressure_bar"), conditions.get("speed_rpm"))
    scheduled = isinstance(design.structure, control.Scheduled) or (
        design.structure is None and None not in design.models
    )
    if scheduled and None in point:
        raise UsageError(
            f"controller {design.name!r}: its gains follow the operating point; write a fit for each operating point"
        )
    return point


def _of_structure(experiment: Experiment, section: ControllerChoice) -> control.ControllerDesign | Structure:
    structure = design_structure(experiment, _as_design(section))
    if isinstance(structure, control.Scheduled):
        raise UsageError(f"structure {structure.name!r} follows the speed; name a controller file")
    names = [gain.name for gain in structure.parameters]
    unknown = [name for name in section.gains if name not in names]
    if unknown:
        raise UsageError(f"{structure.name} has no gain {unknown[0]!r}; {nearest(unknown[0], names)}", "gains")
    if len(section.gains) < len(names):
        return structure if not section.gains else _with_known(structure, section.gains)
    return control.ControllerDesign(structure.name, structure, section.gains, sample_time(experiment, section))


def _with_known(structure: Structure, gains: Mapping[str, float]) -> Structure:
    """Return a structure with the known gains fixed."""
    parameters = [
        replace(q, start=gains[q.name], lower=-np.inf, upper=np.inf, fixed=True) if q.name in gains else q
        for q in structure.parameters
    ]
    return LinearStructure(structure.name, parameters, structure.matrices, structure.inputs, structure.outputs)


def _as_design(section: ControllerChoice) -> ControllerSection:
    """Return structure and options of a loop's controller as a design section, which checks them."""
    given = section.model_dump(include={"structure", "lowpass_hz", "order", "options"}, exclude_none=True)
    return ControllerSection.model_validate(given)


def _of_python(experiment: Experiment, named: ControllerName) -> control.ControllerDesign | Structure:
    word = str(named)
    loaded = user_structure_or_model(word, experiment.folder_of(named.file))
    if isinstance(loaded, LinearModel):
        return control.ControllerDesign(word, None, {}, loaded.dt or sample_time(experiment), models={None: loaded})
    linear = kind_of(loaded).linear
    if linear is None:
        raise UsageError(f"{word}: a controller is a gbid.LinearModel or a gbid.LinearStructure")
    return linear


def _published(experiment: Experiment) -> control.ControllerDesign:
    if experiment.spec.rig is None:
        raise UsageError("controller: paper is that of the model of the rig, and there is no section rig; name a file")
    design = rig_machine(experiment).controller
    if design is None:
        raise UsageError(f"model {rig_model(experiment).name!r} comes with no controller; name a controller file")
    continuous = control.p_controller(design.kappa_x, design.kappa_y, design.lowpass_hz, design.lowpass_order)
    return control.ControllerDesign("paper", None, {}, sample_time(experiment), models={None: continuous})


def _tuned(experiment: Experiment, name: str, planned: bool) -> control.ControllerDesign:
    result, section = early_design(experiment, name), experiment.spec.controller[name]
    structure = design_structure(experiment, section, named_model(experiment, section).domain)
    if result.is_made:
        gains = _stored_gains(result)
    elif planned:
        gains = {
            gain.name: float(np.clip(0.0, gain.lower, gain.upper)) if gain.start is None else gain.start
            for gain in structure.parameters
        }
    else:
        raise InputError(f"{result.path}: no design {name!r} with the present settings; `gbid tune` makes it")
    return control.ControllerDesign(name, structure, gains, sample_time(experiment, section), section.method)


@lru_cache(maxsize=16)
def _stored_gains(result: Result) -> dict[str, float]:
    return dict(load_design(result.path).result.gains)


def load_design(path: Path) -> TunedDesign:
    """Return the tuned design stored in a file.

    Raises
    ------
    DataError
        When the file cannot be read.
    """
    from gbid.control.assessment import TunedDesign  # with all that tunes

    return load(path, TunedDesign)
