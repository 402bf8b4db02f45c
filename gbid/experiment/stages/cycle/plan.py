"""Plan of the cycle: folders of the rounds, recordings in closed loop, and the controller of each round."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gbid.errors import UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.plan import RIG_SIGNALS, PlannedRecording
from gbid.experiment.run.job import Job
from gbid.experiment.stages.cycle.schema import CycleSection
from gbid.experiment.stages.impact.plan import TUNED, tuned_design
from gbid.experiment.stages.impact.schema import ImpactPoint
from gbid.rig import Prbs
from gbid.units import SIGNALS

FOLDER = "cycle"
DESIGN, SURFACES = "controller", "surfaces"
"""Names of the files of a round."""


@dataclass(frozen=True)
class RoundRecording:
    """Planned recording of a round.

    Attributes
    ----------
    planned : PlannedRecording
        Recording of the rig.
    point : ImpactPoint
        Operating point.
    number : int
        The round; 0 is the design of the experiment.
    axis : str
        Axis of the impacts; empty for a recording with moving references.
    """

    planned: PlannedRecording
    point: ImpactPoint
    number: int
    axis: str = ""


def cycle_section(experiment: Experiment) -> CycleSection:
    """Return the cycle section.

    Raises
    ------
    UsageError
        When the experiment has no such section.
    """
    if experiment.spec.cycle is None:
        raise UsageError(f"{experiment.file.path}: no section 'cycle'; add one")
    return experiment.spec.cycle


def cycle_design(experiment: Experiment) -> str:
    """Return the name of the design.

    Raises
    ------
    UsageError
        When there is none, or several and the section names none.
    """
    name = cycle_section(experiment).design
    return tuned_design(experiment, f"tuned:{name}" if name else "tuned")


def round_folder(number: int) -> str:
    """Return the folder of a round in the results."""
    return f"{FOLDER}/round{number}"


def controller_file(job: Job, number: int) -> Path:
    """Return the path of the controller of a round."""
    if number == 0:
        return job.path(TUNED, cycle_design(job.experiment), ".yaml")
    return job.path(round_folder(number), DESIGN, ".yaml")


def surfaces_file(job: Job, number: int) -> Path:
    """Return the path of the surfaces of a round."""
    if number == 0:
        assert job.experiment.spec.lpv is not None
        return job.path("lpv", job.experiment.spec.lpv.fit, ".yaml")
    return job.path(round_folder(number), SURFACES, ".yaml")


def excitation(experiment: Experiment) -> Prbs:
    """Return the references of the new recordings."""
    section, rig = cycle_section(experiment), experiment.spec.rig
    assert rig is not None
    return Prbs(
        section.duration_s or rig.duration_s,
        section.amplitude_m or rig.prbs.amplitude_m,
        section.hold_s or rig.prbs.hold_s,
    )


def recording_points(experiment: Experiment) -> tuple[ImpactPoint, ...]:
    """Return the operating points of the new recordings."""
    section, rig = cycle_section(experiment), experiment.spec.rig
    if section.operating_points is not None:
        return section.operating_points
    points = rig.operating_points if rig is not None else ()
    return tuple(ImpactPoint(pressure_bar=q.pressure_bar, speed_rpm=q.speed_rpm) for q in points)


def trial_points(experiment: Experiment) -> tuple[ImpactPoint, ...]:
    """Return the operating points of the impacts."""
    return cycle_section(experiment).impacts.operating_points or recording_points(experiment)


def round_recordings(experiment: Experiment, number: int) -> dict[str, RoundRecording]:
    """Return the recordings of a round in closed loop by name, e.g. ``round1_p4_n0_prbs1``."""
    found = {}
    for point in recording_points(experiment):
        for i in range(cycle_section(experiment).recordings):
            name = f"round{number}_{_label(point)}_prbs{i + 1}"
            planned = PlannedRecording(name, True, _conditions(point), RIG_SIGNALS, ("cycle",), run=("prbs",))
            found[name] = RoundRecording(planned, point, number)
    return found


def trial_recordings(experiment: Experiment, number: int) -> dict[str, RoundRecording]:
    """Return the recordings with impacts of a round by name, e.g. ``round1_p4_n0_x``."""
    found = {}
    for point in trial_points(experiment):
        for axis in cycle_section(experiment).impacts.axes:
            name = f"{trial_name(point, number)}_{axis}"
            signals = {**RIG_SIGNALS, "f": SIGNALS["f"].channels}
            planned = PlannedRecording(
                name, False, _conditions(point), signals, ("cycle", "impacts"), run=("impact", axis)
            )
            found[name] = RoundRecording(planned, point, number, axis)
    return found


def trial_name(point: ImpactPoint, number: int) -> str:
    """Return the name of the impact study of a round at an operating point, e.g. ``round1_p4_n0``."""
    return f"round{number}_{_label(point)}"


def round_of(item: str) -> int:
    """Return the round of an item, e.g. 1 of ``round1_p4_n0_x``."""
    return int(item.removeprefix("round").partition("_")[0])


def _label(point: ImpactPoint) -> str:
    return f"p{point.pressure_bar:g}_n{point.speed_rpm:g}"


def _conditions(point: ImpactPoint) -> dict[str, float]:
    return {"pressure_bar": point.pressure_bar, "speed_rpm": point.speed_rpm}
