"""Assessment of control designs: performance figures over operating points, comparison, storage and tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass, field, replace
from math import inf, isnan, nan
from typing import Annotated, Any, ClassVar, NamedTuple

import h5py
import numpy as np

from gbid.control.controllers.structures import Scheduled, controller_at, controller_structure
from gbid.control.loop.close import Method, smallest_damping
from gbid.control.loop.half_sine import HalfSine, impact_response
from gbid.control.loop.norm import Peak
from gbid.control.loop.sampled import exact_plant, sampled_loop
from gbid.control.loop.sensitivity import (
    DiskMargin,
    disk_margin,
    sensitivities,
    static_amplification,
    static_stiffness_ratio,
)
from gbid.control.tuning.loops import PADE_ORDER
from gbid.control.tuning.plants import ModelPlants, PlantsLike, TuneOptions, plants_of
from gbid.control.tuning.result import GainResult
from gbid.core import hdf5
from gbid.core.arrays import BoolArray, FloatArray, Point, point_label
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import UsageError
from gbid.core.extras import data_frame
from gbid.core.hdf5 import Stored
from gbid.core.tables import Cell, Column, Entry, Row, Table, formatted, keyed_table
from gbid.lpv import LPVFit, LPVModel
from gbid.structure import LinearModel, PiezoPair
from gbid.structure.delay import with_pade
from gbid.structure.linear import Structure, evaluate
from gbid.structure.scheduling import SCHEDULING


@dataclass(frozen=True)
class PointAssessment:
    """Performance figures of a design at one operating point.

    Attributes
    ----------
    pressure_bar, speed_rpm : float
        Operating point; NaN for a plant that is a linear model, and where they are no scheduling variables.
    stable : bool
        Whether the continuous loop is stable, which has no computation time.
    damping : float
        Smallest damping factor of the oscillatory modes of the continuous loop; -1 for an unstable real pole.
    modes : tuple of (frequency_hz, damping)
        Oscillatory modes by rising frequency.
    slowest_decay_hz : float
        Decay rate of the slowest pole, real or complex, over 2 pi [Hz]; negative when it is unstable.
    peak_output, peak_control : Peak
        Largest singular values of S_o and K S_o over frequency.
    disk : DiskMargin
        Disk margin of all loops together, at the positions.
    static_amplification : float
        Largest singular value of S_o at zero frequency; infinite for an unstable loop.
    stiffness_ratio : tuple of float
        Static stiffness of the closed loop over that of the open loop, x and y; NaN for an unstable loop, and for a
        plant that does not show where a force enters.
    impact_p_m : float
        Largest motion of the disc after the impact, the larger of x and y [m]. This figure and the next three are those
        of gas bearings with piezo stacks, NaN (and False) for other plants.
    stack_travel_m : float
        Largest motion of one stack from its middle after the impact [m].
    exceeds_travel : bool
        Whether this motion is larger than the travel of a stack.
    decay_time_s : float
        Time until the motion of the disc after the impact stays below 5 % of its peak, the longer of x and y [s].
    sampled_stable : bool, optional
        Whether the sampled loop is stable; None without a sample time, and the next two figures are then nan.
    sampled_damping : float
        Smallest damping factor of the sampled loop, with computation time and exact delays, over the modes that last
        longer than a sample.
    sampled_peak_output : Peak
        Largest singular value of S_o of the sampled loop.
    plant : str
        Name of a plant that is a linear model.
    place : dict of str to float
        Scheduling variables of an LPV model or a scheduled controller by name.
    """

    pressure_bar: float
    speed_rpm: float
    stable: bool
    damping: float
    modes: tuple[tuple[float, float], ...]
    slowest_decay_hz: float
    peak_output: Peak
    peak_control: Peak
    disk: DiskMargin
    static_amplification: float
    stiffness_ratio: tuple[float, ...]
    impact_p_m: float
    stack_travel_m: float
    exceeds_travel: bool
    decay_time_s: float
    sampled_stable: bool | None
    sampled_damping: float
    sampled_peak_output: Peak
    plant: str = ""
    place: Mapping[str, float] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Operating point, or the name of the plant."""
        return self.plant or point_label(*self.place.values(), variables=tuple(self.place))

    def figures(self) -> dict[str, float]:
        """Return the performance figures that comparisons of designs show, in the order of `FIGURES`."""
        return {name: figure.of(self) for name, figure in FIGURES.items()}


class ComparedFigure(NamedTuple):
    """Figure by which designs are compared: heading, value at a point, factor and format of tables."""

    heading: str
    of: Callable[[PointAssessment], float]
    factor: float = 1.0
    format: str = ".3f"
    lowest_is_worst: bool = False


FIGURES = {
    "damping": ComparedFigure("continuous damping", lambda q: q.damping, lowest_is_worst=True),
    "peak_output": ComparedFigure("peak S_o", lambda q: q.peak_output.value),
    "peak_control": ComparedFigure("peak K S_o", lambda q: q.peak_control.value),
    "disk_margin": ComparedFigure("disk margin", lambda q: q.disk.alpha, lowest_is_worst=True),
    "static_amplification": ComparedFigure("static S_o", lambda q: q.static_amplification),
    "stiffness_ratio": ComparedFigure(
        "stiffness ratio", lambda q: min(q.stiffness_ratio) if q.stable else -inf, lowest_is_worst=True
    ),
    "slowest_decay_hz": ComparedFigure(
        "slowest decay [Hz]", lambda q: q.slowest_decay_hz, format=".1f", lowest_is_worst=True
    ),
    "impact_p_m": ComparedFigure("disc [µm]", lambda q: q.impact_p_m, 1e6, ".2f"),
    "stack_travel_m": ComparedFigure("stack [µm]", lambda q: q.stack_travel_m, 1e6, ".2f"),
    "decay_time_s": ComparedFigure("decay [ms]", lambda q: q.decay_time_s, 1e3, ".1f"),
    "sampled_damping": ComparedFigure("sampled damping", lambda q: q.sampled_damping, lowest_is_worst=True),
    "sampled_peak_output": ComparedFigure("sampled peak S_o", lambda q: q.sampled_peak_output.value),
}
"""Figures by name."""


@dataclass(frozen=True)
class Assessment(Brief):
    """Performance figures of a design over its operating points.

    Attributes
    ----------
    name : str
        Name of the design.
    structure : str
        Name of the structure of the controller.
    gains : dict of str to float
        Gains by name.
    points : tuple of PointAssessment
        Figures at each operating point, in the given order.
    sample_time : float, optional
        Sample time of the sampled loop [s]; None for the continuous loop alone.
    computation_s : float
        Computation time of the sampled loop [s]; nan without it.
    method : str
        Method by which the controller was discretised.
    impact : HalfSine
        The reference impact, applied along x and along y; without a mass when the moving mass is not known. The figures
        of its response are then nan.
    for_sampling : bool
        Whether the design is for the sampled loop: a result of `gbid.tune` with a sample time.
    """

    name: str
    structure: str
    gains: Mapping[str, float]
    points: tuple[PointAssessment, ...]
    sample_time: float | None
    computation_s: float
    method: Method
    impact: HalfSine
    for_sampling: bool = False

    def _brief(self) -> Description:
        known = {name: pair for name, pair in self.worst.items() if not isnan(pair[0])}
        worst = {name: f"{value:.5g} at {point.label}" for name, (value, point) in known.items()}
        loops = {} if self.sample_time is None else {"sampled": self.sampled_stable}
        loops["continuous"] = self.continuous_stable
        verdicts = ", ".join(f"{loop} loop {'' if stable else 'not '}stable" for loop, stable in loops.items())
        about = f"{self.name or self.structure}, {len(self.points)} operating points, {verdicts}"
        return brief(self, about, gains=self.gains, **worst)

    def to_frame(self) -> Any:
        """Return the performance figures as a data frame, a row for each operating point.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        rows = [{**(p.place or dict.fromkeys(SCHEDULING, nan)), **p.figures()} for p in self.points]
        return data_frame({name: [row[name] for row in rows] for name in rows[0]})

    @property
    def stable(self) -> bool:
        """Whether the loop is stable at all points: the sampled loop if `for_sampling`, else the continuous loop."""
        return self.sampled_stable if self.for_sampling else self.continuous_stable

    @property
    def continuous_stable(self) -> bool:
        """Whether the continuous loop, without computation time, is stable at all points."""
        return all(point.stable for point in self.points)

    @property
    def sampled_stable(self) -> bool:
        """Whether the sampled loop is stable at all points; false without a sample time."""
        return all(bool(point.sampled_stable) for point in self.points)

    @property
    def worst(self) -> dict[str, tuple[float, PointAssessment]]:
        """Worst value of each of `FIGURES`, and the point where it occurs; nan for an unknown figure."""
        worst = {}
        for name, figure in FIGURES.items():
            entries = [(figure.of(point), point) for point in self.points]
            worst[name] = (min if figure.lowest_is_worst else max)(entries, key=lambda entry: entry[0])
        return worst


def assess(
    model: PlantsLike,
    controller: str | Structure | GainResult,
    gains: Mapping[str, float] | None = None,
    points: Sequence[Point] | None = None,
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    name: str = "",
    sample_time: float | None = None,
    computation_s: float | None = None,
    method: Method | None = None,
    impact: HalfSine | None = None,
    piezo_travel_m: float | None = None,
) -> Assessment:
    """Return the performance figures of a design over operating points.

    Parameters
    ----------
    model : LPVModel, LinearModel, LPVFit, FitResult, sequence of these, or dict of str to them
        The plant, as `gbid.tune` takes it; an LPV model has actuators. Each linear model of a list is a point.
    controller : str, Structure or GainResult
        ``"P"``, ``"PD"`` or ``"biquad"`` with default options, or a structure from `controller_structure` or
        `scheduled`, or your own. A result of `gbid.tune` has structure, gains and sampling.
    gains : dict of str to float, optional
        A value for every parameter of the structure; those of a result are its own.
    points : sequence of (pressure_bar, speed_rpm), optional
        Operating points of an LPV model, or values of its other scheduling variables; by default those of the model.
        For linear models and a scheduled controller those of each model, by default of the result.
    inputs, outputs : sequence of str, optional
        Channels of linear models that the controller drives and measures, as in `gbid.tune`; by default all.
    name : str
        Name of the design, for tables; by default that of the structure.
    sample_time : float, optional
        Sample time of the sampled loop [s]. By default that of the result; else 0.2 ms, that of the paper, for an LPV
        model. Without one, as for other plants by default, there is the continuous loop alone.
    computation_s : float, optional
        Time from the sample of p to the change of r [s]. By default that of the result, or one sample.
    method : {"tustin", "zoh"}, optional
        Method by which the controller is discretised. By default that of the result, or ``"tustin"``.
    impact : HalfSine, optional
        Reference impact, along x and along y; by default that of `HalfSine`. Its moving mass is by default that of the
        LPV model (`gbid.lpv.MachineData`); where nobody gives it, the figures of the response are nan.
    piezo_travel_m : float, optional
        Whole travel of one stack [m]; by default that of the LPV model.

    Returns
    -------
    Assessment
        Figures of the continuous loop with the Pade delays of the model, and of the sampled loop with exact delays.

    Raises
    ------
    UsageError
        When the model has no actuators or no points, when a point lies outside its domain, when gains do not fit, or
        when a plant is none or has other channels than the controller.
    """
    law: Any = controller
    for_sampling = isinstance(controller, GainResult) and controller.sample_time is not None
    if isinstance(controller, GainResult):
        sample_time = controller.sample_time if sample_time is None else sample_time
        computation_s = controller.computation_s if computation_s is None else computation_s
        method, gains = method or controller.method, controller.gains if gains is None else gains
        law = controller.controller
        each = model[0] if isinstance(model, Sequence) and model else model
        if isinstance(law, Scheduled) and points is None and not isinstance(each, LPVModel | LPVFit):
            points = controller.points
    structure = law if isinstance(law, Scheduled) else controller_structure(law)
    if gains is None:
        raise UsageError(f"assess: give the gains of {structure.name!r}, or the result of gbid.tune")
    plants = _plants(model, structure, points, TuneOptions(inputs=inputs, outputs=outputs))
    T = 2e-4 if sample_time is None and plants[0].lpv is not None else sample_time
    if T is None and (computation_s is not None or method is not None):
        raise UsageError("assess: computation_s and method are those of a sampled loop; give sample_time=, too")
    computation, impact = (nan if T is None else T) if computation_s is None else computation_s, impact or HalfSine()
    if (lpv := plants[0].lpv) is not None:
        impact = impact.on(lpv.machine)
        piezo_travel_m = lpv.machine.piezo_travel_m if piezo_travel_m is None else piezo_travel_m
    about = name or structure.name, structure.name, dict(gains)
    plan = Assessment(*about, (), T, computation, method or "tustin", impact, for_sampling)
    results = (_assess_point(plant, structure, plan, piezo_travel_m) for plant in plants)
    return replace(plan, points=tuple(results))


class _AssessedPlant(NamedTuple):
    """Plant with Padé delays, plant with exact delays, scheduling variables and LPV model (None if unknown)."""

    continuous: LinearModel
    exact: LinearModel
    place: Mapping[str, float]
    lpv: LPVModel | None = None


def _plants(
    model: PlantsLike,
    structure: Structure | Scheduled,
    points: Sequence[Point] | None,
    channels: TuneOptions,
) -> list[_AssessedPlant]:
    """Return the plants of an assessment, each with Padé delays and with exact delays."""
    model = model.model if isinstance(model, LPVFit) else model
    if isinstance(model, Sequence) and all(isinstance(each, LPVModel | LPVFit) for each in model):
        return [plant for each in model for plant in _plants(each, structure, points, channels)]
    if isinstance(model, LPVModel):
        if channels.inputs or channels.outputs:
            raise UsageError("assess: inputs and outputs choose channels of linear models; an LPV model has r and p")
        chosen = [tuple(map(float, point)) for point in (model.operating_points if points is None else points)]
        names = model.scheduling
        if not chosen:
            raise UsageError(f"assess: no operating points; give points=[({', '.join(names)}), ...] for {model.name!r}")
        both = [(model.plant_at(*point), exact_plant(model, *point)) for point in chosen]
        places = [dict(zip(names, point, strict=True)) for point in chosen]
        return [_AssessedPlant(*plants, place, model) for plants, place in zip(both, places, strict=True)]
    if points is not None and not isinstance(structure, Scheduled):
        raise UsageError("assess: points belong to an LPV model; give the linear models of a list")
    names = structure.domain.variables if isinstance(structure, Scheduled) else ()
    places = [dict(zip(names, map(float, point), strict=True)) for point in points or ()]
    speeds = [place.get("speed_rpm", 0.0) for place in places] or None
    plants = plants_of(model, structure, replace(channels, speeds_rpm=speeds))
    assert isinstance(plants, ModelPlants)
    each = zip(plants.models, plants.scenarios(plants.points)[1], places or [{}] * len(plants.models), strict=True)
    return [
        _AssessedPlant(replace(with_pade(plant, PADE_ORDER), name=label), plant, place) for plant, label, place in each
    ]


def _assess_point(
    assessed: _AssessedPlant, structure: Structure | Scheduled, plan: Assessment, piezo_travel_m: float | None
) -> PointAssessment:
    """Return all performance figures of a design with one plant, under the conditions of an assessment."""
    plant, lpv = assessed.continuous, assessed.lpv
    controller = controller_at(structure, plan.gains, *assessed.place.values())
    loop = sensitivities(plant, controller)
    closed = loop.model("plant")
    impacts = []
    if lpv is not None and lpv.actuators and plan.impact.mass_kg is not None:
        actuators = evaluate(PiezoPair(), lpv.actuators, plant.input_names, ("u_x", "u_y"))
        given: dict[str, Any] = {"actuators": actuators, "piezo_travel_m": piezo_travel_m}
        impacts = [impact_response(plant, controller, plan.impact.towards(angle), **given) for angle in (0.0, 90.0)]

    def largest(figure: str) -> float:
        return max((float(getattr(response, figure)) for response in impacts), default=nan)

    sampled = None
    if plan.sample_time is not None:
        timing: dict[str, Any] = {"computation_s": plan.computation_s, "method": plan.method}
        sampled = sampled_loop(assessed.exact, controller, plan.sample_time, **timing)
    stable, stiffness = closed.is_stable(), np.full(len(plant.C), np.nan)
    if stable:
        with nullcontext() if lpv is not None and lpv.actuators else suppress(UsageError, np.linalg.LinAlgError):
            stiffness = static_stiffness_ratio(loop)  # a plant may not show where a force enters, or be free
    return PointAssessment(
        assessed.place.get("pressure_bar", nan),
        assessed.place.get("speed_rpm", nan),
        stable,
        smallest_damping(closed),
        tuple(closed.modes()),
        float(-loop.poles.real.max() / (2 * np.pi)),
        loop.peak("output"),
        loop.peak("control"),
        disk_margin(loop),
        static_amplification(loop) if stable else inf,
        tuple(float(ratio) for ratio in stiffness),
        largest("peak_p_m"),
        largest("stack_travel_m"),
        any(response.exceeds_travel for response in impacts),
        largest("decay_time_s"),
        None if sampled is None else sampled.stable,
        nan if sampled is None else sampled.damping,
        Peak(nan, nan) if sampled is None else sampled.peak_output,
        "" if lpv is not None else plant.name or "plant",
        assessed.place,
    )


# ---- Comparison of control designs.


@dataclass(frozen=True)
class Comparison:
    """Worst performance figures of several designs, side by side.

    Attributes
    ----------
    columns : tuple of str
        Headings; the first is for the name of the design.
    values : tuple of tuple of float
        One row per design, without its name, in the units of the headings.
    rows : tuple of tuple of str
        One row per design as formatted texts.
    """

    columns: tuple[str, ...]
    values: tuple[tuple[float, ...], ...]
    rows: tuple[tuple[str, ...], ...]

    def __repr__(self) -> str:
        return str(self)

    def tables(self) -> list[Table]:
        """Return the comparison as a list with one table."""
        return [self.table()]

    def table(self) -> Table:
        """Return the comparison as one table with a row for each design; cells hold numbers and their printed text."""
        names = [row[0] for row in self.rows]
        shown = zip(names, self.rows, self.values, strict=True)
        rows: list[list[Entry]] = [[name, *map(Cell, values, texts[1:])] for name, texts, values in shown]
        return Table("", [Column(heading) for heading in self.columns], rows)

    def to_frame(self) -> Any:
        """Return the performance figures as a pandas.DataFrame, a row for each design.

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        return self.table().to_frame().set_index(self.columns[0])

    def __str__(self) -> str:
        """Return the comparison as text with aligned columns."""
        table = (self.columns, *self.rows)
        widths = [max(len(row[i]) for row in table) for i in range(len(self.columns))]
        return "\n".join("  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in table)


def compare_designs(assessments: Sequence[Assessment]) -> Comparison:
    """Return the worst performance figures of several designs in one table.

    Parameters
    ----------
    assessments : sequence of Assessment
        Assessments over the same operating points, with the same impact and sampling.

    Returns
    -------
    Comparison
        Without the figures that are known for none of them, as those of an impact without a moving mass.

    Raises
    ------
    UsageError
        When there are no assessments, or when their conditions differ.
    """
    if not assessments:
        raise UsageError("compare_designs: no designs")
    first = assessments[0]
    for other in assessments[1:]:
        if _conditions(other) != _conditions(first):
            raise UsageError(
                f"compare_designs: {other.name!r} and {first.name!r} were assessed at other points, with other impacts "
                "or another sampling; assess both with the same options"
            )
    worst = [{name: value for name, (value, _) in assessment.worst.items()} for assessment in assessments]
    shown = {name: figure for name, figure in FIGURES.items() if any(not isnan(row[name]) for row in worst)}
    values = tuple(tuple(figure.factor * row[name] for name, figure in shown.items()) for row in worst)
    rows = tuple(
        (assessment.name, *(format(value, figure.format) for value, figure in zip(row, shown.values(), strict=True)))
        for assessment, row in zip(assessments, values, strict=True)
    )
    return Comparison(("design", *(figure.heading for figure in shown.values())), values, rows)


def _conditions(assessment: Assessment) -> tuple[object, ...]:
    points = tuple(point.label for point in assessment.points)
    timing = () if assessment.sample_time is None else (assessment.sample_time, assessment.computation_s)
    return points, assessment.impact, timing, assessment.method


# ---- Tuned designs and their performance, as stored.

_VERDICTS = ("stable", "sampled_stable", "exceeds_travel")


@dataclass(frozen=True, eq=False)
class DesignFigures:
    """Performance of a design at operating points, as numbers.

    Attributes
    ----------
    name, structure : str
        Names of design and structure.
    gains : dict of str to float
        Gains by name.
    points : (m, n_variables) array
        Operating points; of a gas bearing pressure [bar], speed [rpm].
    figures : (m, 12) array
        Figures in the order and units of `gbid.control.assessment.FIGURES`.
    stable, sampled_stable, exceeds_travel : (m,) boolean array
        At each point: whether the continuous loop is stable; whether the sampled loop is stable; whether the impact
        needs more travel than a stack has.
    variables : tuple of str
        Names of the scheduling variables.
    """

    name: str
    structure: str
    gains: Annotated[Mapping[str, float], Stored("", "gains", "gains")]
    points: Annotated[FloatArray, Stored("bar, rpm", "operating points", "points variables")]
    figures: Annotated[FloatArray, Stored("SI", "figures of the design at the points", "points figures")]
    stable: Annotated[BoolArray, Stored("", "stable, at the points", "points")]
    sampled_stable: Annotated[BoolArray, Stored("", "sampled stable, at the points", "points")]
    exceeds_travel: Annotated[BoolArray, Stored("", "exceeds travel, at the points", "points")]
    variables: Annotated[tuple[str, ...], Stored(late=True)] = SCHEDULING

    @classmethod
    def of(cls, assessment: Assessment) -> DesignFigures:
        """Return the performance figures of an assessment as plain numbers."""
        variables = tuple(assessment.points[0].place) or SCHEDULING
        points = [tuple(q.place.values()) or (nan,) * len(variables) for q in assessment.points]
        figures = [[q.figures()[name] for name in FIGURES] for q in assessment.points]
        stable, sampled, travel = (np.array([bool(getattr(q, name)) for q in assessment.points]) for name in _VERDICTS)
        about = assessment.name, assessment.structure, assessment.gains
        return cls(*about, np.array(points), np.array(figures), stable, sampled, travel, variables)

    def at(self, row: int) -> dict[str, float]:
        """Return the performance figures at one operating point by name."""
        return dict(zip(FIGURES, map(float, self.figures[row]), strict=True))

    def where(self, row: int) -> str:
        """Return the label of an operating point."""
        return point_label(*self.points[row], variables=self.variables)

    @property
    def worst(self) -> dict[str, tuple[float, Point]]:
        """Worst value of each figure and the operating point where it occurs."""
        worst = {}
        for (name, figure), column in zip(FIGURES.items(), self.figures.T, strict=True):
            row = int((np.argmin if figure.lowest_is_worst else np.argmax)(column))
            worst[name] = (float(column[row]), tuple(self.points[row].tolist()))
        return worst


class CappedDesign(NamedTuple):
    """Best design whose peak of S_o stays below a limit.

    Attributes
    ----------
    cap : float
        The cap.
    result : GainResult
        The design.
    """

    cap: float
    result: GainResult


class RobustPromise(NamedTuple):
    """Performance that a robust design reaches on random plants with a probability, compared with the nominal design.

    Attributes
    ----------
    probability, confidence : float
        Probability of the promise, and its confidence.
    promised : float
        Objective that a plant reaches with this probability; minus infinity when there were too few draws.
    keeps_limits : float
        Lower confidence bound of the probability that a plant keeps all limits.
    plants : int
        Number of drawn plants for which the design was optimised.
    fresh : int
        Number of drawn plants that verified it.
    of_nominal : float
        Objective that the nominal design reaches with this probability.
    limits_of_nominal : float
        Share of the plants in which the nominal design keeps the limits.
    nominal : float
        Objective of the nominal design on the nominal plant.
    """

    probability: float
    confidence: float
    promised: float
    keeps_limits: float
    plants: int
    fresh: int
    of_nominal: float
    limits_of_nominal: float
    nominal: float

    @property
    def holds(self) -> bool:
        """Whether the predicted performance is finite and the limits hold with the stated probability."""
        return bool(np.isfinite(self.promised) and self.keeps_limits >= self.probability)


@dataclass(frozen=True, eq=False)
class TunedDesign(hdf5.InFile):
    """Tuned design with its performance.

    Attributes
    ----------
    name : str
        Name of the design.
    plant : str
        Name of the model for which it was tuned.
    result : GainResult
        Result of the tuning. Read from a file it has no structure; the controller file contains that.
    performance : tuple of DesignFigures
        Performance of the design, and of the published controller if there is one.
    front : tuple of CappedDesign
        Designs of the same structure under other caps on the peak of S_o, in rising order.
    impact : HalfSine
        Impact for the figures.
    sample_time : float
        Sample time of the sampled loop [s]; its computation takes one sample.
    method : {"tustin", "zoh"}
        Discretisation of the controller.
    promises : tuple of RobustPromise
        Of a robust design: its promise, and those of designs for other probabilities, in rising order.
    """

    name: str
    plant: str
    result: GainResult
    performance: tuple[DesignFigures, ...]
    front: tuple[CappedDesign, ...]
    impact: HalfSine
    sample_time: float
    method: Method = "tustin"
    promises: tuple[RobustPromise, ...] = ()
    FILE: ClassVar[hdf5.FileKind] = hdf5.FileKind("tuning", "make it again with `gbid tune`", 2)

    def to_hdf5(self, group: h5py.Group) -> None:
        """Write this design and its performance figures, with their names, to the `group`."""
        hdf5.write_fields(group, self)
        for performance in group["performance"].values():
            hdf5.add_texts(performance["figures"], "columns", tuple(FIGURES))

    def document(self) -> Row:
        """Return the design as plain values, for JSON."""
        return {
            "plant": self.plant,
            "structure": self.performance[0].structure if self.performance else "",
            **_result_row(self.result),
            "points": [list(point) for point in self.result.points],
            "sample_time_s": self.sample_time,
            "method": self.method,
            "impact": {name: getattr(self.impact, name) for name in ("peak_n", "duration_s", "mass_kg")},
            "performance": [_performance_row(performance) for performance in self.performance],
            "pareto": [{"cap": cap, **_result_row(result)} for cap, result in self.front],
            "promises": [{**promise._asdict(), "holds": promise.holds} for promise in self.promises],
        }

    def tables(self) -> list[Table]:
        """Return the tables of the performance figures and of the tuning result."""
        named = {self.name: self}
        return [*assessment_tables(named), *design_tables(named)]


# ---- Tables of tuned designs: comparison, tuning results, and conditions.

_HOLDS: Mapping[Method, str] = {"tustin": "Tustin", "zoh": "zero-order hold"}
NO_IMPACT = "disc and stack under an impact left out: moving mass not known (machine: moving_mass_kg)"
_OF_RESULT = (
    *("value", "objective", "status", "success", "violation", "verified_on"),
    *("peak_sensitivity", "peak_control", "static_amplification"),
)
_EXCESS = (
    "excess: logarithm of value over limit (damping factors: limit minus value); at most 0 where the limit is kept"
)


def conditions_words(impact: HalfSine, sample_time: float, method: Method) -> str:
    """Return the impact and the sampling for which performance figures were computed, as text."""
    hit = NO_IMPACT
    if impact.mass_kg is not None:
        hit = f"disc and stack under a half-sine impact of {impact.peak_n:g} N, {1e3 * impact.duration_s:g} ms"
    return f"{hit}; {sampling_words(sample_time, method)} with one sample for computation"


def sampling_words(sample_time: float, method: Method) -> str:
    """Return the sampling of a controller as text."""
    return f"sampled at {1e3 * sample_time:g} ms ({_HOLDS[method]})"


def gains_words(gains: Mapping[str, float]) -> str:
    """Return the gains of a controller as text."""
    return ", ".join(f"{name} = {value:.5g}" for name, value in gains.items())


def _result_row(result: GainResult) -> Row:
    return {
        "gains": dict(result.gains),
        **{name: getattr(result, name) for name in _OF_RESULT},
        "worst": {name: getattr(result.worst, name) for name in ("where", "frequency_hz", "damping")},
        "active": list(result.active),
        "goals": [asdict(figure) for figure in result.goals],
        "notes": list(result.notes),
    }


def _performance_row(performance: DesignFigures) -> Row:
    return {
        "name": performance.name,
        "structure": performance.structure,
        "gains": dict(performance.gains),
        "worst": {
            figure: {"value": value, **dict(zip(performance.variables, point, strict=True))}
            for figure, (value, point) in performance.worst.items()
        },
        "points": [
            {**dict(zip(performance.variables, point, strict=True)), **performance.at(row)}
            for row, point in enumerate(performance.points.tolist())
        ],
    }


def assessed_alike(designs: Mapping[str, TunedDesign]) -> list[dict[str, TunedDesign]]:
    """Return the designs in groups with equal plant, operating points, impact and sampling."""
    groups: dict[tuple[object, ...], dict[str, TunedDesign]] = {}
    for name, design in designs.items():
        points = tuple(map(tuple, design.performance[0].points)) if design.performance else ()
        conditions = design.plant, points, design.impact, design.sample_time, design.method
        groups.setdefault(conditions, {})[name] = design
    return list(groups.values())


def assessment_tables(designs: Mapping[str, TunedDesign]) -> list[Table]:
    """Return a table of the worst performance figures for each group of designs with equal assessment conditions."""
    tables = []
    for group in assessed_alike(designs):
        first, *_ = group.values()
        shown = [design.performance[0] for design in group.values() if design.performance]
        shown += first.performance[1:]
        points = first.result.points
        where = shown[0].where(0) if shown and len(points) == 1 else f"{len(points)} operating points"
        title = f"{first.plant}, worst over {where}" if len(points) else first.plant
        conditions = conditions_words(first.impact, first.sample_time, first.method)
        tables += [comparison_table(title, shown, conditions)] if shown else []
    return tables


def comparison_table(title: str, performances: Sequence[DesignFigures], note: str) -> Table:
    """Return a table of the worst performance figures of designs with equal assessment, a row for each figure.

    Parameters
    ----------
    title : str
        Title of the table.
    performances : sequence of DesignFigures
        Performance of the designs.
    note : str
        Conditions, from `conditions_words`.
    """
    worst = [performance.worst for performance in performances]
    rows = [
        [shown.heading, *(formatted(shown.factor * figures[name][0], shown.format) for figures in worst)]
        for name, shown in FIGURES.items()
        if not all(np.isnan(figures[name][0]) for figures in worst)
    ]
    gains = [f"{q.name} ({q.structure}): {gains_words(q.gains)}" for q in performances]
    columns = [Column("figure"), *(Column(q.name, format=4) for q in performances)]
    return Table(title, columns, rows, [note, *gains])


def design_tables(designs: Mapping[str, TunedDesign]) -> list[Table]:
    """Return tables of objectives, goals, limits on the peak of S_o and robust performance, without empty tables."""
    tables = (_aims(designs), _goals(designs), _caps(designs), _promises(designs))
    return [table for table in tables if table.rows]


def _aims(designs: Mapping[str, TunedDesign]) -> Table:
    rows: list[list[Entry]] = []
    notes = []
    for name, design in designs.items():
        result = design.result
        worst, unit = result.worst, " 1/s" if result.objective == "decay" else ""
        mode = f"{worst.frequency_hz:.1f} Hz, damping {worst.damping:.4f}, {worst.where}"
        aim = f"{result.objective} {result.value:.4f}{unit}"
        rows.append([name, result.status, aim, mode, ", ".join(result.active) or None, result.verified_on])
        notes += [f"{name}: {note}" for note in result.notes]
    heads = ("design", "status", "aim reached", "worst mode", "limited by", "checked")
    return Table("What the tuning found", [Column(head, wrap=True) for head in heads], rows, notes)


def _goals(designs: Mapping[str, TunedDesign]) -> Table:
    rows = [
        (name, goal.name, "objective" if goal.soft else "limit", goal.excess, goal.where)
        for name, design in designs.items()
        for goal in design.result.goals
    ]
    columns = [Column("design"), Column("goal"), Column("kind"), Column("excess", format="+.4f"), Column("where")]
    return Table("Goals of the designs", columns, rows, [_EXCESS])


def _caps(designs: Mapping[str, TunedDesign]) -> Table:
    caps = sorted({cap for design in designs.values() for cap, _ in design.front})
    rows: list[list[Entry]] = []
    for name, design in designs.items():
        reached = {cap: q.value if q.success else Cell(None, q.status) for cap, q in design.front}
        if reached:
            structure = design.performance[0].structure if design.performance else ""
            rows.append([name, structure, *(reached.get(cap) for cap in caps)])
    columns = [Column("design"), Column("structure"), *(Column(f"peak {cap:g}", format=".4f") for cap in caps)]
    return Table("Aim reached under caps on the peak of S_o", columns, rows)


def _promises(designs: Mapping[str, TunedDesign]) -> Table:
    columns = {
        "design": Column("design"),
        "probability": Column("probability", format="g"),
        "promised": Column("promised", format=".4f"),
        "keeps_limits": Column("keeps limits", format=".3f"),
        "of_nominal": Column("nominal design", format=".4f"),
        "limits_of_nominal": Column("its limits", format=".3f"),
        "plants": Column("plants", format="d"),
        "fresh": Column("fresh", format="d"),
    }
    rows: list[dict[str, Any]] = [
        {"design": name, **promise._asdict()} for name, design in designs.items() for promise in design.promises
    ]
    confidences = sorted({row["confidence"] for row in rows})
    note = (
        f"promised: reached with the probability, at a confidence of {', '.join(f'{100 * c:g} %' for c in confidences)}"
        ", on fresh drawn plants that the design has not seen; keeps limits: lower bound of the probability; "
        "plants: drawn plants for which it was optimised"
    )
    return keyed_table("Robust designs", columns, rows, [note])
