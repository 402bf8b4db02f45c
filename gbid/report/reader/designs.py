"""Designs with the figures that the tuning stored: which can be compared, and what to warn of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from gbid.control import HalfSine, Scheduled, controller_at
from gbid.control.assessment.tuned_design import DesignFigures, TunedDesign
from gbid.control.loop.sampling import Method
from gbid.errors import DataError
from gbid.experiment.run.job import Job
from gbid.experiment.stages.tune.plan import (
    design_structure,
    impact,
    published_design,
    published_structure,
    sample_time,
)
from gbid.experiment.stages.tune.schema import ControllerSection
from gbid.experiment.stages.tune.stage import assess_published, design_plant
from gbid.lpv import LPVModel
from gbid.structure import LinearModel
from gbid.structure.linear import Structure

KEPT = 0.8
"""Share of its damping that a design should keep when it is sampled."""
_HOLDS: dict[Method, str] = {"tustin": "Tustin", "zoh": "zero-order hold"}


@dataclass(frozen=True, eq=False)
class AssessedDesign:
    """A controller with its stored figures, and the conditions under which they hold.

    Attributes
    ----------
    name : str
        Of the controller that came with the machine also the first design beside it, where there are several groups.
    group : str
        First design of those that were assessed alike.
    figures : DesignFigures
    structure : Structure or Scheduled
        Of the controller.
    plant : LPVModel
        That the loop was closed on.
    impact : HalfSine
    sample_time : float
        [s]
    method : {"tustin", "zoh"}
    cap : float or None
        On the peak of S_o.
    came : bool
        Whether it came with the machine.
    """

    name: str
    group: str
    figures: DesignFigures
    structure: Structure | Scheduled
    plant: LPVModel
    impact: HalfSine
    sample_time: float
    method: Method
    cap: float | None
    came: bool = False

    def at(self, point: tuple[float, float]) -> LinearModel:
        """Return the controller at an operating point."""
        return controller_at(self.structure, self.figures.gains, *point)

    def warnings(self) -> list[str]:
        """List what a reader should know before trusting the design."""
        worst = {name: value for name, (value, _) in self.figures.worst.items()}
        if not self.figures.stable.all():
            return ["not stable at every operating point"]
        found = []
        if not self.figures.sampled_stable.all():
            found.append(f"not stable everywhere as it runs, {sampling_words(self.sample_time, self.method)}")
        if worst["sampled_damping"] < KEPT * worst["damping"]:
            text = f"as it runs, sampled, its smallest damping factor is {worst['sampled_damping']:.3f}"
            found.append(f"{text}, not {worst['damping']:.3f}")
        if self.cap is not None and worst["peak_output"] > self.cap * (1 + 1e-4):
            found.append(f"peak of S_o {worst['peak_output']:.3f}, above {self.cap:g}")
        if self.figures.exceeds_travel.any():
            found.append("the reference impact asks for more travel than a stack has")
        return found


def assessed_designs(job: Job, designs: Mapping[str, TunedDesign]) -> tuple[AssessedDesign, ...]:
    """Put structure and plant to tuned designs; the one that came with the machine follows those assessed alike."""
    experiment, groups = job.experiment, assessed_alike(designs)
    found: list[AssessedDesign] = []
    for group in groups:
        first = next(iter(group))
        for name, design in group.items():
            section = experiment.spec.controller[name]
            plant, _ = design_plant(job, section)
            conditions = plant, design.impact, design.sample_time, design.method, section.peak_sensitivity
            for figures in design.performance[: None if name == first else 1]:
                came = None if figures is design.performance[0] else published_design(experiment, plant)
                form = published_structure(came) if came else design_structure(experiment, section, plant.domain)
                own = name if came is None else figures.name if len(groups) == 1 else f"{figures.name} (as {first})"
                found.append(AssessedDesign(own, first, figures, form, *conditions, came=came is not None))
    return tuple(sorted(found, key=lambda q: q.name not in designs))


def assessed_published(job: Job, model: LPVModel | None) -> tuple[AssessedDesign, ...]:
    """Assess the controller that came with a model, of an experiment that tunes none; empty when none came."""
    came = None if model is None else published_design(job.experiment, model)
    figures = None if model is None else assess_published(job.experiment, model)
    if model is None or came is None or figures is None:
        return ()
    section = ControllerSection()
    conditions = impact(section), sample_time(job.experiment, section), section.method, section.peak_sensitivity
    about = figures.name, figures.name, figures, published_structure(came), model
    return (AssessedDesign(*about, *conditions, came=True),)


def assessed_alike(designs: Mapping[str, TunedDesign]) -> list[dict[str, TunedDesign]]:
    """Group designs by plant, operating points, impact and sampling."""
    groups: dict[tuple[object, ...], dict[str, TunedDesign]] = {}
    for name, design in designs.items():
        groups.setdefault(_conditions(design), {})[name] = design
    return list(groups.values())


def comparable_designs(designs: Mapping[str, TunedDesign]) -> dict[str, TunedDesign]:
    """Choose those designs that were assessed alike and tuned with the same aim as the first one.

    Raises
    ------
    DataError
        When there are none.
    """
    if not designs:
        raise DataError("no tuned design of the present settings and fits is there; run `gbid tune` or `gbid run`")
    group = assessed_alike(designs)[0]
    first = next(iter(group.values()))
    return {name: design for name, design in group.items() if _aim(design) == _aim(first)}


def _conditions(design: TunedDesign) -> tuple[object, ...]:
    points = tuple(map(tuple, design.performance[0].points)) if design.performance else ()
    return design.plant, points, design.impact, design.sample_time, design.method


def _aim(design: TunedDesign) -> tuple[object, ...]:
    return design.result.objective, design.result.sample_time


def design_performances(designs: Mapping[str, TunedDesign]) -> list[DesignFigures]:
    """List the performance of comparable designs, the published one last.

    Raises
    ------
    DataError
        When there are no designs.
    """
    chosen = list(comparable_designs(designs).values())
    return [*(design.performance[0] for design in chosen if design.performance), *chosen[0].performance[1:]]


def conditions_words(impact: HalfSine, sample_time: float, method: Method) -> str:
    """Say under which impact and sampling the figures of designs hold."""
    hit = f"disc and stack under a half-sine impact of {impact.peak_n:g} N, {1e3 * impact.duration_s:g} ms"
    return f"{hit}; {sampling_words(sample_time, method)} with one sample for computation"


def sampling_words(sample_time: float, method: Method) -> str:
    """Say how a controller is sampled."""
    return f"sampled at {1e3 * sample_time:g} ms ({_HOLDS[method]})"
