"""Which recordings with impacts an experiment has, what the rig does in them, and which controller runs."""

from __future__ import annotations

from dataclasses import dataclass
from math import modf
from pathlib import Path

from gbid.control import ControllerDesign, load_controller, p_controller
from gbid.control.loop.sampling import sample_controller
from gbid.errors import UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.keys import file_digest
from gbid.experiment.plan import RIG_SIGNALS, PlannedRecording
from gbid.experiment.problems import nearest
from gbid.experiment.stages.impact.schema import ImpactPoint, ImpactsSection
from gbid.experiment.stages.rig.model import rig_model
from gbid.lpv import LPVModel, load_model
from gbid.rig import Hammer, Impact
from gbid.structure import LinearModel
from gbid.units import SIGNALS

BEFORE_S = 0.2
"""Time before the first impact, which shows what the disc does anyway."""
LOOPS = ("open", "closed")
"""Names of the loops that need no further controller."""
TUNED = "controller"
"""Folder of the results in which the tuning leaves its controller."""
_GOLDEN = 0.6180339887


@dataclass(frozen=True)
class ImpactRecording:
    """A recording with impacts to be made.

    Attributes
    ----------
    planned : PlannedRecording
        As the rig takes it.
    point : ImpactPoint
    loop, axis : str
        The loop is open, closed, or a further one by its name.
    """

    planned: PlannedRecording
    point: ImpactPoint
    loop: str
    axis: str


@dataclass(frozen=True, eq=False)
class LoopController:
    """A controller in both its forms.

    Attributes
    ----------
    continuous, sampled : LinearModel
    key : str
        What decides it, for content keys.
    """

    continuous: LinearModel
    sampled: LinearModel
    key: str


def impacts_section(experiment: Experiment) -> ImpactsSection:
    """Return the section.

    Raises
    ------
    UsageError
        When there is none.
    """
    if experiment.spec.impacts is None:
        raise UsageError(f"{experiment.file.path}: no section 'impacts', so there is nothing to do; add one")
    return experiment.spec.impacts


def study_name(point: ImpactPoint, loop: str) -> str:
    """Name of the study of one operating point in one loop, ``p6_n0_open``."""
    return f"p{point.pressure_bar:g}_n{point.speed_rpm:g}_{loop}"


def loop_controllers(section: ImpactsSection) -> dict[str, str]:
    """Return the word for the controller of each loop, in their order; empty for the open one."""
    own = {loop: section.controller if loop == "closed" else "" for loop in section.loops}
    return own | dict(section.beside)


def planned_impacts(experiment: Experiment) -> dict[str, ImpactRecording]:
    """List the recordings with impacts by name, ``p6_n0_open_x`` for example; none without a section."""
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


def hammer_of(section: ImpactsSection, axis: str, sample_time: float) -> Hammer:
    """Return the impacts of a recording; they fall anywhere between samples, as those of a real hammer do."""
    times = [BEFORE_S + section.spacing_s * i + modf(_GOLDEN * i)[0] * sample_time for i in range(section.repeats)]
    impacts = tuple(Impact.along(axis, time, section.peak_n, section.impact_s) for time in times)
    samples = round((BEFORE_S + section.spacing_s * section.repeats) / sample_time)
    return Hammer(impacts, samples * sample_time)


def expecting_model(experiment: Experiment) -> tuple[LPVModel, str]:
    """Load the model that the modes are expected from, and what decides it, for content keys.

    Raises
    ------
    UsageError
        When it is not there, or knows no actuators.
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
            raise UsageError(f"{path}: not there; `gbid lpv` makes it")
    elif path.suffix in (".yaml", ".yml"):
        path = experiment.folder / path
    else:
        return _with_actuators(load_model(section.model)), section.model
    return _with_actuators(load_model(path)), file_digest(path)


def controller_at(experiment: Experiment, point: ImpactPoint, loop: str = "closed") -> LoopController:
    """Return the controller that runs in a loop at an operating point.

    Raises
    ------
    UsageError
        When there is none, its file is broken, or it is sampled at another time than the rig.
    """
    section, rig = impacts_section(experiment), experiment.spec.rig
    assert rig is not None
    word = {"closed": section.controller, **section.beside}[loop]
    if word == "paper":
        design = rig_model(experiment).controller
        if design is None:
            raise UsageError(f"model {rig_model(experiment).name!r} comes with no controller; name a controller file")
        continuous = p_controller(design.kappa_x, design.kappa_y, design.lowpass_hz, design.lowpass_order)
        return LoopController(continuous, sample_controller(continuous, rig.sample_time_s), repr(design))
    path = controller_path(experiment, word)
    made: ControllerDesign = load_controller(path)
    if abs(made.sample_time - rig.sample_time_s) > 1e-9 * rig.sample_time_s:
        raise UsageError(
            f"{path}: sampled at {made.sample_time:g} s, the rig at {rig.sample_time_s:g} s; save it for that time"
        )
    at = (point.pressure_bar, point.speed_rpm)
    return LoopController(made.at(*at), made.sampled_at(*at), file_digest(path))


def controller_path(experiment: Experiment, word: str) -> Path:
    """Path of the controller file that a word other than ``paper`` means.

    Raises
    ------
    UsageError
        When it is not there.
    """
    if not is_tuned(word):
        path = experiment.folder / word
        if not path.is_file():
            raise UsageError(f"{path}: no such controller file; write paper, tuned, or the name of one")
        return path
    path = experiment.results / TUNED / f"{tuned_design(experiment, word)}.yaml"
    if not path.is_file():
        raise UsageError(f"{path}: not there; `gbid tune` makes it")
    return path


def is_tuned(word: str) -> bool:
    """Whether a word means a controller that the tuning leaves."""
    return word.partition(":")[0] == "tuned"


def tuned_design(experiment: Experiment, word: str) -> str:
    """Name of the design that is meant by ``tuned`` or ``tuned:NAME``.

    Raises
    ------
    UsageError
        When there is no such design, or several and none is named.
    """
    designs = experiment.spec.controller
    name = word.partition(":")[2]
    if not designs:
        raise UsageError("there is no section 'controller' whose design could be meant; add one")
    if name and name not in designs:
        raise UsageError(f"no design {name!r}; {nearest(name, designs)}")
    if not name and len(designs) > 1:
        raise UsageError(f"several designs are tuned; write tuned:NAME, there is {', '.join(designs)}")
    return name or next(iter(designs))


def _with_actuators(model: LPVModel) -> LPVModel:
    if not model.actuators:
        raise UsageError(f"model {model.name!r} has no actuators, which a closed loop needs; add them to its file")
    return model
