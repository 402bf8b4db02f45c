"""Designs with the figures that the tuning stored: comparable designs and warnings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from gbid.control import HalfSine, Scheduled, controller_at
from gbid.control.assessment.tuned_design import DesignFigures, TunedDesign
from gbid.control.loop.sampling import Method
from gbid.errors import DataError
from gbid.experiment.run.job import Job
from gbid.experiment.stages.tune.design_goals import peak_cap
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
"""Smallest share of its damping that a design keeps when sampled, without a warning."""
_HOLDS: dict[Method, str] = {"tustin": "Tustin", "zoh": "zero-order hold"}


@dataclass(frozen=True, eq=False)
class AssessedDesign:
    """Controller with its stored figures, and the conditions of their assessment.

    Attributes
    ----------
    name : str
        Name of the design. With several groups, the name of the published controller contains that of the first design
        of its group.
    group : str
        First design of the group that was assessed under the same conditions.
    figures : DesignFigures
        Stored figures.
    structure : Structure or Scheduled
        Structure of the controller.
    plant : LPVModel
        Plant of the loop.
    impact : HalfSine
        Impact of the assessment.
    sample_time : float
        Sample time of the controller [s].
    method : {"tustin", "zoh"}
        Discretisation of the controller.
    cap : float or None
        Cap on the peak of S_o.
    for_sampling : bool
        Whether the cap is on the sampled loop, for which the controller was designed.
    came : bool
        Whether it is the published controller.
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
    for_sampling: bool = False
    came: bool = False

    def at(self, point: tuple[float, float]) -> LinearModel:
        """Return the controller at an operating point."""
        return controller_at(self.structure, self.figures.gains, *point)

    def warnings(self) -> list[str]:
        """Return the warnings of the design: stability, sampling, peak of S_o and travel."""
        worst = {name: value for name, (value, _) in self.figures.worst.items()}
        if not self.figures.stable.all():
            return ["not stable at every operating point"]
        found = []
        if not self.figures.sampled_stable.all():
            found.append(f"sampled loop not stable at every point, {sampling_words(self.sample_time, self.method)}")
        if worst["sampled_damping"] < KEPT * worst["damping"]:
            text = f"sampled, its smallest damping factor is {worst['sampled_damping']:.3f}"
            found.append(f"{text}, not {worst['damping']:.3f}")
        peak = worst["sampled_peak_output" if self.for_sampling else "peak_output"]
        if self.cap is not None and peak > self.cap * (1 + 1e-4):
            found.append(f"peak of S_o {peak:.3f}, above {self.cap:g}")
        if self.figures.exceeds_travel.any():
            found.append("the reference impact asks for more travel than a stack has")
        return found


def assessed_designs(job: Job, designs: Mapping[str, TunedDesign]) -> tuple[AssessedDesign, ...]:
    """Return tuned designs with structure and plant, each group followed by its published controller."""
    experiment, groups = job.experiment, assessed_alike(designs)
    found: list[AssessedDesign] = []
    for group in groups:
        first = next(iter(group))
        for name, design in group.items():
            section = experiment.spec.controller[name]
            plant, _ = design_plant(job, section)
            sampled = section.design_for == "sampled"
            conditions = plant, design.impact, design.sample_time, design.method, peak_cap(section), sampled
            for figures in design.performance[: None if name == first else 1]:
                came = None if figures is design.performance[0] else published_design(experiment, plant)
                form = published_structure(came) if came else design_structure(experiment, section, plant.domain)
                own = name if came is None else figures.name if len(groups) == 1 else f"{figures.name} (as {first})"
                found.append(AssessedDesign(own, first, figures, form, *conditions, came=came is not None))
    return tuple(sorted(found, key=lambda q: q.name not in designs))


def assessed_published(job: Job, model: LPVModel | None) -> tuple[AssessedDesign, ...]:
    """Return the published controller of a model, assessed, for an experiment without designs; empty without one."""
    came = None if model is None else published_design(job.experiment, model)
    figures = None if model is None else assess_published(job.experiment, model)
    if model is None or came is None or figures is None:
        return ()
    section = ControllerSection()
    conditions = impact(section), sample_time(job.experiment, section), section.method, peak_cap(section)
    about = figures.name, figures.name, figures, published_structure(came), model
    return (AssessedDesign(*about, *conditions, came=True),)


def assessed_alike(designs: Mapping[str, TunedDesign]) -> list[dict[str, TunedDesign]]:
    """Return the designs in groups with equal plant, operating points, impact and sampling."""
    groups: dict[tuple[object, ...], dict[str, TunedDesign]] = {}
    for name, design in designs.items():
        groups.setdefault(_conditions(design), {})[name] = design
    return list(groups.values())


def comparable_designs(designs: Mapping[str, TunedDesign]) -> dict[str, TunedDesign]:
    """Return the designs with the same assessment and objective as the first one.

    Raises
    ------
    DataError
        When there are no designs.
    """
    if not designs:
        raise DataError("there is no tuned design of the present settings and fits; run `gbid tune` or `gbid run`")
    group = assessed_alike(designs)[0]
    first = next(iter(group.values()))
    return {name: design for name, design in group.items() if _aim(design) == _aim(first)}


def _conditions(design: TunedDesign) -> tuple[object, ...]:
    points = tuple(map(tuple, design.performance[0].points)) if design.performance else ()
    return design.plant, points, design.impact, design.sample_time, design.method


def _aim(design: TunedDesign) -> tuple[object, ...]:
    return design.result.objective, design.result.sample_time


def design_performances(designs: Mapping[str, TunedDesign]) -> list[DesignFigures]:
    """Return the performance of comparable designs, the published controller last.

    Raises
    ------
    DataError
        When there are no designs.
    """
    chosen = list(comparable_designs(designs).values())
    return [*(design.performance[0] for design in chosen if design.performance), *chosen[0].performance[1:]]


def conditions_words(impact: HalfSine, sample_time: float, method: Method) -> str:
    """Return impact and sampling of the figures of designs as text."""
    hit = f"disc and stack under a half-sine impact of {impact.peak_n:g} N, {1e3 * impact.duration_s:g} ms"
    return f"{hit}; {sampling_words(sample_time, method)} with one sample for computation"


def sampling_words(sample_time: float, method: Method) -> str:
    """Return the sampling of a controller as text."""
    return f"sampled at {1e3 * sample_time:g} ms ({_HOLDS[method]})"
