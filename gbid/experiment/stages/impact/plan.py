"""Plan of the impacts: recordings, hammer, model of the expected modes, and controllers."""

from __future__ import annotations

from dataclasses import dataclass
from math import modf
from pathlib import Path

from gbid.control import ControllerDesign, load_controller, p_controller
from gbid.errors import UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.keys import file_digest
from gbid.experiment.plan import RIG_SIGNALS, PlannedRecording
from gbid.experiment.problems import nearest
from gbid.experiment.stages.impact.schema import HammerTrain, ImpactPoint, ImpactsSection
from gbid.experiment.stages.rig.model import rig_model
from gbid.lpv import LPVModel, load_model
from gbid.rig import Hammer, Impact
from gbid.structure import LinearModel
from gbid.units import SIGNALS

BEFORE_S = 0.2
"""Time before the first impact [s], which shows the motion of the disc without impact."""
LOOPS = ("open", "closed")
"""Names of the loops that every experiment may have."""
TUNED = "controller"
"""Folder of the tuned controllers in the results."""
_GOLDEN = 0.6180339887


@dataclass(frozen=True)
class ImpactRecording:
    """Planned recording with impacts.

    Attributes
    ----------
    planned : PlannedRecording
        Recording of the rig.
    point : ImpactPoint
        Operating point.
    loop, axis : str
        Name of the loop (``"open"``, ``"closed"`` or that of a further loop), and axis of the impacts.
    """

    planned: PlannedRecording
    point: ImpactPoint
    loop: str
    axis: str


@dataclass(frozen=True, eq=False)
class LoopController:
    """Controller in continuous and in discrete time.

    Attributes
    ----------
    continuous, sampled : LinearModel
        Controllers in continuous time and at the sample time of the rig.
    design : ControllerDesign
        The design, over all operating points.
    key : str
        Digest of its source, for content keys.
    """

    continuous: LinearModel
    sampled: LinearModel
    design: ControllerDesign
    key: str


def impacts_section(experiment: Experiment) -> ImpactsSection:
    """Return the impacts section.

    Raises
    ------
    UsageError
        When the experiment has no such section.
    """
    if experiment.spec.impacts is None:
        raise UsageError(f"{experiment.file.path}: no section 'impacts'; add one")
    return experiment.spec.impacts


def study_name(point: ImpactPoint, loop: str) -> str:
    """Return the name of the study of one operating point in one loop, e.g. ``p6_n0_open``."""
    return f"p{point.pressure_bar:g}_n{point.speed_rpm:g}_{loop}"


def loop_controllers(section: ImpactsSection) -> dict[str, str]:
    """Return the controller entry of each loop, in their order; empty for the open loop."""
    own = {loop: section.controller if loop == "closed" else "" for loop in section.loops}
    return own | dict(section.beside)


def planned_impacts(experiment: Experiment) -> dict[str, ImpactRecording]:
    """Return the recordings with impacts by name, e.g. ``p6_n0_open_x``; empty without the section."""
    section = experiment.spec.impacts
    found: dict[str, ImpactRecording] = {}
    for i, point in enumerate(section.operating_points if section else ()):
        assert section is not None
        conditions = {"pressure_bar": point.pressure_bar, "speed_rpm": point.speed_rpm}
        for loop in loop_controllers(section):
            for axis in section.axes:
                name = f"{study_name(point, loop)}_{axis}"
                signals = {**RIG_SIGNALS, "f": SIGNALS["f"].channels}
                location = ("impacts", "operating_points", i)
                planned = PlannedRecording(name, False, conditions, signals, location, run=("impact", axis))
                found[name] = ImpactRecording(planned, point, loop, axis)
    return found


def hammer_of(section: HammerTrain, axis: str, sample_time: float) -> Hammer:
    """Return the impacts of a recording; their times lie between samples, as those of a real hammer."""
    times = [BEFORE_S + section.spacing_s * i + modf(_GOLDEN * i)[0] * sample_time for i in range(section.repeats)]
    impacts = tuple(Impact.along(axis, time, section.peak_n, section.impact_s) for time in times)
    samples = round((BEFORE_S + section.spacing_s * section.repeats) / sample_time)
    return Hammer(impacts, samples * sample_time)


def expecting_model(experiment: Experiment) -> tuple[LPVModel, str]:
    """Return the model that predicts the modes, and a text that identifies it in content keys.

    Raises
    ------
    UsageError
        When the model is missing or has no actuators.
    """
    section = impacts_section(experiment)
    if section.model is None:
        model = rig_model(experiment)
        return _with_actuators(model), f"rig {model.name}"
    path = Path(section.model)
    if section.model == "lpv":
        assert experiment.spec.lpv is not None
        path = experiment.results / "lpv" / f"{experiment.spec.lpv.fit}.yaml"
        if not path.is_file():
            raise UsageError(f"{path}: file is missing; `gbid lpv` makes it")
    elif path.suffix in (".yaml", ".yml"):
        path = experiment.folder / path
    else:
        return _with_actuators(load_model(section.model)), section.model
    return _with_actuators(load_model(path)), file_digest(path)


def controller_at(experiment: Experiment, point: ImpactPoint, loop: str = "closed") -> LoopController:
    """Return the controller of a loop at an operating point.

    Raises
    ------
    UsageError
        When there is none, its file is faulty, or its sample time is not that of the rig.
    """
    section, rig = impacts_section(experiment), experiment.spec.rig
    assert rig is not None
    word = {"closed": section.controller, **section.beside}[loop]
    if word == "paper":
        design = rig_model(experiment).controller
        if design is None:
            raise UsageError(f"model {rig_model(experiment).name!r} comes with no controller; name a controller file")
        continuous = p_controller(design.kappa_x, design.kappa_y, design.lowpass_hz, design.lowpass_order)
        made = ControllerDesign("paper", None, {}, rig.sample_time_s, models={None: continuous})
        return LoopController(continuous, made.sampled_at(), made, repr(design))
    return loop_controller(experiment, controller_path(experiment, word), point)


def loop_controller(experiment: Experiment, path: Path, point: ImpactPoint) -> LoopController:
    """Return the controller of a file at an operating point, as the rig runs it.

    Raises
    ------
    UsageError
        When the file is faulty, or its sample time is not that of the rig.
    """
    rig, made = experiment.spec.rig, load_controller(path)
    assert rig is not None
    if abs(made.sample_time - rig.sample_time_s) > 1e-9 * rig.sample_time_s:
        raise UsageError(
            f"{path}: sample time is {made.sample_time:g} s, that of the rig {rig.sample_time_s:g} s; save it for that"
        )
    at = (point.pressure_bar, point.speed_rpm)
    return LoopController(made.at(*at), made.sampled_at(*at), made, file_digest(path))


def controller_path(experiment: Experiment, word: str) -> Path:
    """Return the path of the controller file of an entry other than ``paper``.

    Raises
    ------
    UsageError
        When the file is missing.
    """
    if not is_tuned(word):
        path = experiment.folder / word
        if not path.is_file():
            raise UsageError(f"{path}: no such controller file; write paper, tuned, or the name of one")
        return path
    path = experiment.results / TUNED / f"{tuned_design(experiment, word)}.yaml"
    if not path.is_file():
        raise UsageError(f"{path}: file is missing; `gbid tune` makes it")
    return path


def is_tuned(word: str) -> bool:
    """Return whether a controller entry means a tuned design."""
    return word.partition(":")[0] == "tuned"


def tuned_design(experiment: Experiment, word: str) -> str:
    """Return the name of the design that ``tuned`` or ``tuned:NAME`` means.

    Raises
    ------
    UsageError
        When there is no such design, or several and the entry names none.
    """
    designs = experiment.spec.controller
    name = word.partition(":")[2]
    if not designs:
        raise UsageError("there is no section 'controller' with a design; add one")
    if name and name not in designs:
        raise UsageError(f"no design {name!r}; {nearest(name, designs)}")
    if not name and len(designs) > 1:
        raise UsageError(f"several designs are tuned; write tuned:NAME, there is {', '.join(designs)}")
    return name or next(iter(designs))


def _with_actuators(model: LPVModel) -> LPVModel:
    if not model.actuators:
        raise UsageError(f"model {model.name!r} has no actuators, which a closed loop needs; add them to its file")
    return model
