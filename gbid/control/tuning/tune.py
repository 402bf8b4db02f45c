"""Tuning of a controller of fixed structure, over the operating points of an LPV model or over any plants."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from math import pi
from typing import Any, Literal

import numpy as np

from gbid.control.controllers.scheduled import Scheduled, with_schedule
from gbid.control.controllers.structures import controller_structure
from gbid.control.impact.half_sine import HalfSine
from gbid.control.loop.close import Method, force_entry
from gbid.control.tuning.goals import (
    DesignContext,
    Goal,
    MaxDamping,
    MaxDecay,
    SlowestPole,
    Wanted,
    limits_of,
    positive,
)
from gbid.control.tuning.loops import LoopFamily, loop_delay, loop_equations, smallest_sampled_damping
from gbid.control.tuning.plane import Eigensystem
from gbid.control.tuning.plants import (
    DesignPlants,
    LoopsAtPoints,
    PlantLike,
    PlantSet,
    Point,
    Sampling,
    Uncertainty,
    plants_of,
)
from gbid.control.tuning.problem import ExtraLimit, GainProblem, Limits, Objective
from gbid.control.tuning.response_goals import PeakControl, PeakSensitivity, StaticAmplification
from gbid.control.tuning.result import GainResult, GoalFigure, distance_to_edge
from gbid.control.tuning.search import Progress, SearchOptions, SearchTask, typical_rate
from gbid.control.tuning.solve import (
    GainSolution,
    add_worst_points,
    as_bounds,
    as_start,
    check_counts,
    sketch_over_points,
    solve_over_points,
    summarise,
)
from gbid.core.arrays import ComplexArray, FloatArray, point_label
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import UsageError
from gbid.core.extras import data_frame
from gbid.core.notes import ControlNote
from gbid.lpv import LPVModel
from gbid.structure import LinearModel
from gbid.structure.linear import Structure

# ---- Piezo travel after an impact, as a limit of a design.

UNSTABLE = 1e3
"""Travel that is assigned to an unstable loop, over the limit."""
_AFTER_S = 0.05
_STEP_S = 1e-4
_ZOOM = np.linspace(-1.0, 1.0, 17)


def travel_limit(plant: LinearModel, impact: HalfSine, piezo_travel_m: float) -> ExtraLimit:
    """Return the limit of the motion of every stack to half its travel, for an impact in x and in y, in every loop.

    Parameters
    ----------
    plant : LinearModel
        One of the plants; the entry of a force is the same for all.
    impact : HalfSine
        The impact.
    piezo_travel_m : float
        Whole travel of a stack [m].
    """
    entry = force_entry(plant) * (impact.peak_n / impact.mass_kg)
    limit = piezo_travel_m / 2

    def largest(family: LoopFamily, gains: FloatArray) -> FloatArray:
        # of sampled loops the continuous ones with the delay of sampling
        loops = (getattr(family, "companion", None) or family).matrices(gains)
        # the states of the plant come first in every loop; the force does not act on the controller
        E = np.vstack([entry, np.zeros((loops.A.shape[1] - len(entry), entry.shape[1]))])
        system = Eigensystem.of(loops.A)
        stable = (system.values.real < 0).all(axis=1)
        found = np.full(len(family), UNSTABLE * limit)
        if stable.any():
            to_r = loops.C[stable, family.n_outputs :] @ system.right[stable]
            peaks = _peaks(system.values[stable], to_r, system.left[stable] @ E, impact.duration_s)
            found[stable] = np.minimum(peaks, UNSTABLE * limit)
        return np.asarray(np.maximum(found, 1e-12))

    return ExtraLimit("piezo travel", largest, limit)


def _peaks(values: ComplexArray, outputs: ComplexArray, inputs: ComplexArray, length: float) -> FloatArray:
    """Return the largest ``|r|`` of each loop over both stacks and directions: (m,)."""
    m, n = values.shape
    weights = (outputs[:, None] * inputs.transpose(0, 2, 1)[:, :, None]).reshape(m, -1, n)  # (m, direction x stack, n)
    n_during = max(20, int(np.ceil(length / _STEP_S)))
    after = np.arange(_STEP_S, _AFTER_S, _STEP_S)
    time = np.concatenate([np.linspace(0.0, length, n_during + 1), length + after])
    r = np.abs((weights @ _modes(values[:, :, None], time, length)).real)
    best, place = r.max(axis=2), time[r.argmax(axis=2)]
    step = max(_STEP_S, length / n_during)
    for _ in range(3):
        at = np.clip(place[:, :, None] + step * _ZOOM, 0.0, time[-1])
        found = np.abs((weights[:, :, None] @ _modes(values[:, None, :, None], at[:, :, None], length)).real[:, :, 0])
        best, top = np.maximum(best, found.max(axis=2)), found.argmax(axis=2)
        place, step = np.take_along_axis(at, top[:, :, None], axis=2)[:, :, 0], step / 8
    return np.asarray(best.max(axis=1))


def _modes(values: ComplexArray, time: FloatArray, length: float) -> ComplexArray:
    r"""Return the solution of :math:`\dot z = \lambda z + \sin(\pi t / T)` up to T, then of the free motion."""
    w = pi / length
    during, later = np.minimum(time, length), np.maximum(time - length, 0.0)
    forced = w * (np.exp(values * during) - np.cos(w * during)) - values * np.sin(w * during)
    return np.asarray(np.exp(values * later) * forced / (values**2 + w**2))


# ---- Goal on the travel of the piezo stacks after an impact.


@dataclass(frozen=True)
class PiezoTravel(Wanted):
    """Motion of every stack after an impact in x and in y: at most half its travel to each side.

    Parameters
    ----------
    impact : HalfSine
        The impact.
    travel_m : float
        Whole travel of a stack [m].
    soft, weight
        See `Wanted`.
    """

    impact: HalfSine = field(default_factory=HalfSine)
    travel_m: float = 45e-6

    def __post_init__(self) -> None:
        super().__post_init__()
        positive(self, travel_m=self.travel_m)
        if not isinstance(self.impact, HalfSine):
            raise UsageError(f"PiezoTravel: impact = {self.impact!r}; give a HalfSine")

    def measure(self, context: DesignContext) -> ExtraLimit:
        """Return the measure of this goal."""
        found = travel_limit(context.plant, self.impact, self.travel_m)
        return replace(found, limit=found.limit / self.weight)


# ---- Goals from the arguments of `gbid.tune` by name: its short form.


@dataclass(frozen=True)
class ShortForm:
    """Goals by name, as `gbid.tune` takes them; its arguments of the same names say what they mean."""

    objective: Objective = "damping"
    peak_sensitivity: float | None = 2.6
    peak_control: float | None = None
    static_amplification: float | None = None
    slowest_pole: float | None = None
    impact: HalfSine | None = None
    piezo_travel_m: float = 45e-6

    def goals(self, given: Sequence[Goal] | None, slowest_mode: float) -> list[Goal]:
        """Return the goals of a design.

        Parameters
        ----------
        given : sequence of Goal, optional
            Goals as values, which exclude the short form.
        slowest_mode : float
            Slowest decay of the oscillatory modes of the open loop [1/s], the default of `slowest_pole`.

        Raises
        ------
        UsageError
            When both forms are used, or when a number is not allowed.
        """
        if given is not None:
            if not isinstance(given, Iterable):
                raise UsageError(f"goals = {given!r}; give a list such as [MaxDamping(), PeakSensitivity(2.0)]")
            used = [f.name for f in fields(self) if getattr(self, f.name) != f.default]
            if used:
                raise UsageError(f"tune: {', '.join(used)} beside goals; write them as goals, too")
            return list(given)
        slowest = self.slowest_pole
        if slowest is None:
            slowest = 0.0 if self.peak_sensitivity is None else max(slowest_mode, 0.0)
        # raises errors that name the arguments
        Limits(self.objective, slowest, self.peak_sensitivity, self.peak_control, self.static_amplification)
        goals: list[Goal] = [MaxDamping() if self.objective == "damping" else MaxDecay(), SlowestPole(rate=slowest)]
        for kind, limit in (
            (PeakSensitivity, self.peak_sensitivity),
            (PeakControl, self.peak_control),
        ):
            if limit is not None:
                goals.append(kind(limit))
        if self.static_amplification is not None:
            goals.append(StaticAmplification(limit=self.static_amplification))
        if self.impact is not None:
            goals.append(PiezoTravel(impact=self.impact, travel_m=self.piezo_travel_m))
        return goals


# ---- Remarks and figures of a finished design.


def notes_of(
    design: DesignPlants,
    solution: GainSolution,
    names: tuple[str, ...],
    structure: Structure | Scheduled,
    points: tuple[tuple[float, float], ...],
    sampling: Sampling | None,
) -> tuple[str, ...]:
    """Return the remarks on a design: unfinished fits, unstable open loops, distance to the edge, the sampled loop."""
    labels = [point_label(P, Omega) for P, Omega in design.points]
    if design.lpv is None:
        labels = list(solution.problem.families[0].labels)
    unstable = [label for label, rate in zip(labels, design.slowest, strict=True) if rate < 0]
    notes = tuple(
        ControlNote.FIT_NOT_CONVERGED(f"the plant {fit.model.name!r} is a fit that did not converge")
        for fit in design.unfinished
    )
    if unstable:
        notes += (ControlNote.UNSTABLE_OPEN_LOOP(f"the open loop is not stable at {'; '.join(unstable)}"),)
    notes += _edge_notes(solution, names)
    if sampling is not None and design.lpv is not None:
        gains = dict(zip(names, map(float, solution.best.x), strict=True))
        truly, (P, Omega) = smallest_sampled_damping(
            design.lpv, structure, gains, sorted(points), sampling.sample_time, sampling.computation_s, sampling.method
        )
        text = (
            f"designed for sampling at {1e3 * sampling.sample_time:g} ms with {1e3 * sampling.computation_s:g} ms to "
            f"compute; the sampled loop has a smallest damping factor of {truly:.3f}, at {point_label(P, Omega)}"
        )
        notes += (ControlNote.SAMPLED_LOOP(text),)
    return notes


def goal_figures(solution: GainSolution, result: GainResult) -> GainResult:
    """Return the result with the figures of goals beside those that have a field, and with the damping it reached."""
    problem, x = solution.problem, solution.best.x
    limits = problem.limits
    if not limits.measures:
        return result
    figures = []
    states = [problem.state(family, family.matrices(x), x) for family in problem.families]
    for measure in limits.measures:
        found = [(float(e), name) for s in states for e, name in zip(measure.excess(s), s.family.labels, strict=True)]
        figures.append(GoalFigure(measure.name, measure in limits.soft, *max(found)))
    result = replace(result, goals=tuple(figures))
    if not limits.soft:
        return result
    if not limits.weight:
        return replace(result, objective="goals")
    worst = result.worst
    decay = 2 * np.pi * worst.frequency_hz * worst.damping
    return replace(result, value=worst.damping if limits.objective == "damping" else decay)


def _edge_notes(solution: GainSolution, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return a note on the distance to instability of a design without a limit on a response."""
    problem, x = solution.problem, solution.best.x
    if problem.limits.peak_sensitivity is not None or problem.limits.measures or not problem.stable(x):
        return ()
    edge = distance_to_edge(problem, x, names)
    note = "damping alone was maximised: the peak of S_o is not limited"
    if np.isfinite(edge.change):
        note += f"; a change of {edge.gain} by {edge.change:+.2g} makes a loop unstable"
    return (ControlNote.PEAK_NOT_LIMITED(note),)


def tune(
    model: PlantLike | Sequence[PlantLike],
    controller: str | Structure | Scheduled = "P",
    *,
    goals: Sequence[Goal] | None = None,
    operating_points: Sequence[Point] | Literal["domain"] | None = None,
    actuator: Mapping[str, float] | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    peak_sensitivity: float | None = 2.6,
    peak_control: float | None = None,
    static_amplification: float | None = None,
    slowest_pole: float | None = None,
    impact: HalfSine | None = None,
    piezo_travel_m: float = 45e-6,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    uncertainty: Uncertainty | None = None,
    objective: Objective = "damping",
    sample_time: float | None = None,
    computation_s: float | None = None,
    method: Method = "tustin",
    start: Mapping[str, float] | None = None,
    starts: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> GainResult:
    r"""Return the gains of a controller that maximise the damping of an LPV plant within limits.

    .. math:: \max_g \; \min_{P, \Omega} \min_j \zeta_j(g; P, \Omega) \quad\text{with}\quad
              \max_\omega \bar\sigma(S_o(j\omega; g; P, \Omega)) \le M

    over the oscillatory modes of the closed loop (Eqs. 20 to 22) at all operating points, with every pole faster than
    `slowest_pole`.

    Parameters
    ----------
    model : LPVModel, LinearModel, LPVFit, FitResult, or sequence of these
        The plant. An LPV model has actuators. Of a list the design holds for all models: fits of several recordings,
        draws, or worst cases. Linear models are continuous; their delays may be exact.
    controller : str, Structure or Scheduled
        See `gbid.controller_structure`; by default P with a first-order low-pass of 1000 Hz. To tune the corner
        frequency as well, use ``controller_structure("P", tune_corner=True)``. For gains that depend on pressure and
        speed, use `gbid.control.scheduled`.
    goals : sequence of Goal, optional
        Objectives and limits as values from `gbid.control`, such as ``[MaxDamping(), PeakSensitivity(2.0)]``. They
        replace `objective`, `peak_sensitivity`, `peak_control`, `static_amplification`, `slowest_pole`, `impact`
        and `piezo_travel_m`, which are their short form.
    operating_points : sequence of (pressure_bar, speed_rpm), or "domain", optional
        Operating points; by default those of the model. ``"domain"``: the whole rectangle. The worst points are then
        found and added until none is worse by more than 1e-4.
    actuator : dict of str to float, optional
        Parameters of Eq. 12 [rad/s, m/m]; by default those of the model.
    inputs, outputs : sequence of str, optional
        Channels of linear models that the controller drives and measures, in the order of its outputs and inputs.
    peak_sensitivity : float, optional
        Limit M on the peak of the output sensitivity; None maximises damping without this limit, see Notes.
    peak_control, static_amplification : float, optional
        Limits on the peak of K S_o [m/m] and on the gain of S_o at zero frequency.
    slowest_pole : float, optional
        Smallest allowed decay rate of every pole, real ones included [1/s]. By default that of the slowest oscillatory
        mode of the open loop at these points, or 0 (stability only) without a limit on the sensitivity.
    impact : HalfSine, optional
        Impact after which no piezo stack may exceed its travel, in x and in y, at any operating point.
    piezo_travel_m : float
        Whole travel of a stack [m].
    bounds : dict of str to (lower, upper), optional
        Bounds of gains in place of those of the structure.
    uncertainty : Uncertainty, optional
        Drawn plants for which the design must also hold.
    objective : {"damping", "decay"}
        Smallest damping factor of the oscillatory modes, or slowest decay ``-Re`` of all poles [1/s].
    sample_time : float, optional
        Sample time of the target [s]. The design is then that of the sampled controller itself: the plant is
        discretised exactly with held references and its own delays, and the objective is the damping of the sampled
        loop. Continuous designs with Padé delays of order 3 are the starts. Without `sample_time` the loop is
        continuous and has more damping than the sampled one.
    computation_s : float, optional
        Time from the sample of p to the change of r [s]; one sample when not given.
    method : {"tustin", "zoh"}
        Discretisation of a sampled controller, see `gbid.control.sample_controller`.
    start : dict of str to float, optional
        Gains as an additional start value.
    starts, seed
        As for `gbid.maximise_damping`.
    progress : callable, optional
        Called with a `gbid.control.SearchStep` after each stage.

    Returns
    -------
    GainResult
        Gains with exact peaks, active limits, and notes on the distance to instability.

    Raises
    ------
    UsageError
        When a point lies outside the domain of the model, when goals, limits or bounds are not allowed, when a gain is
        unknown, or when the channels of the plant do not fit the controller.

    Notes
    -----
    Damping alone is not a suitable objective. Positive feedback reduces the stiffness, and a damping factor does not
    show the slow real pole that results. The optimum over all points without a limit on S_o is at the boundary of
    static instability. For such a design the notes of the result give the distance to it.

    Examples
    --------
    >>> import gbid
    >>> model = gbid.load_model("theisen2016")
    >>> result = gbid.tune(model, operating_points=[(6, 0)], peak_sensitivity=2.2832)
    >>> round(result.value, 3)
    0.318
    """
    structure = controller if isinstance(controller, Scheduled) else controller_structure(controller)
    structure = with_schedule(structure, getattr(model, "domain", None))
    short = ShortForm(
        objective, peak_sensitivity, peak_control, static_amplification, slowest_pole, impact, piezo_travel_m
    )
    loop_delay(sample_time, computation_s)  # raises the errors of the two
    check_counts(seed, starts)
    sampling = None
    if sample_time is not None:
        sampling = Sampling(sample_time, sample_time if computation_s is None else computation_s, method)
    design = plants_of(model, structure, operating_points, actuator, uncertainty, sampling, (inputs, outputs))
    limits = limits_of(short.goals(goals, min(design.slowest)), DesignContext(design.plant))
    low, high, start_gains = _gain_bounds(structure, bounds)
    names = tuple(parameter.name for parameter in structure.parameters)
    given = _by_gain("start", start, names)
    first = [as_start([given.get(n, v) for n, v in zip(names, start_gains, strict=True)], names)] if given else []
    options = SearchOptions(starts, seed)
    if isinstance(structure, Scheduled) and structure.terms != ("1",):
        first.append(_constant_gains(design, structure, limits, options))
    task = SearchTask(start_gains, tuple(first), options, progress)
    solution = _search(design, limits, low, high, task)
    verified = f"eigenvalues and exact H-infinity norms of {len(solution.problem.families[0])} loops"
    if design.domain is not None:
        solution, verified = add_worst_points(solution, design.sampled or design.continuous, design.domain, task)
    used = solution.problem.families[0].points
    points = () if used is None else tuple(dict.fromkeys((float(P), float(Omega)) for P, Omega in used))
    notes = notes_of(design, solution, names, structure, points, sampling)
    more = {"points": points, "controller": structure, "sample_time": sample_time}
    return goal_figures(solution, summarise(solution, names, verified, notes, **more))


def _search(design: DesignPlants, limits: Limits, low: FloatArray, high: FloatArray, task: SearchTask) -> GainSolution:
    """Return the best design: of the continuous loops, or of the sampled ones with starts from these."""

    def problem_of(plants: PlantSet) -> GainProblem:
        families = (plants.family(design.points),)
        scale = typical_rate(families, task.neutral)
        return GainProblem(families, limits, low, high, scale, plants.gain_limits(design.points))

    plants = design.continuous
    if design.sampled is None:
        return solve_over_points(problem_of(plants), plants, design.points, task)
    sketch = sketch_over_points(problem_of(plants), plants, design.points, task)
    first = (*(end.x for end in sketch.ends), *task.first)
    # few gains: a search of the whole box again, because it costs little; else from the continuous designs
    options = task.options if len(task.neutral) <= 3 else replace(task.options, starts=0)
    task, plants = replace(task, first=first, options=options), design.sampled
    solution = solve_over_points(problem_of(plants), plants, design.points, task)
    return replace(solution, history=sketch.history + solution.history)


def _gain_bounds(
    structure: Structure | Scheduled, bounds: Mapping[str, tuple[float, float]] | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    names = tuple(parameter.name for parameter in structure.parameters)
    given = _by_gain("bounds", bounds, names)
    for name, pair in given.items():
        if not isinstance(pair, Sequence) or isinstance(pair, str) or len(pair) != 2:
            raise UsageError(f"bounds of gain {name!r}: {pair!r}; give (lower, upper)")
    pairs = [given.get(p.name, (p.lower, p.upper)) for p in structure.parameters]
    low, high = as_bounds([pair[0] for pair in pairs], [pair[1] for pair in pairs], names)
    start = np.clip([p.start if p.start is not None else 0.0 for p in structure.parameters], low, high)
    return low, high, start


def _by_gain(what: str, given: Mapping[str, Any] | None, names: tuple[str, ...]) -> dict[str, Any]:
    """Return what is given for gains by name."""
    if given is not None and not isinstance(given, Mapping):
        raise UsageError(f"{what} = {given!r}; give a dict by the names of the gains: {', '.join(names)}")
    unknown = [str(name) for name in given or {} if name not in names]
    if unknown:
        raise UsageError(f"{what}: no gain {', '.join(unknown)}; there are {', '.join(names)}")
    return dict(given or {})


def _constant_gains(design: DesignPlants, structure: Scheduled, limits: Limits, options: SearchOptions) -> FloatArray:
    """Return the best constant gains as coefficients, a start value with which a schedule cannot become worse."""
    known, constant = design.continuous, replace(structure, terms=("1",))
    assert isinstance(known, LoopsAtPoints)
    assert known.lpv is not None
    equations = loop_equations(known.lpv, constant, delay_s=known.delay_s)
    plants = LoopsAtPoints(constant, equations, design.points, known.uncertainty, known.lpv, known.delay_s)
    low, high, start = _gain_bounds(constant, None)
    family = plants.family(design.points)
    problem = GainProblem((family,), limits, low, high, typical_rate((family,), start))
    solution = solve_over_points(problem, plants, design.points, SearchTask(start, options=options))
    values = dict(zip((p.name for p in constant.parameters), solution.best.x, strict=True))
    return np.array([values.get(p.name, 0.0) for p in structure.parameters])


# ---- Pareto front of damping and peak sensitivity.


@dataclass(frozen=True)
class ParetoFront(Brief):
    """Best designs under rising limits on the peak of S_o.

    Attributes
    ----------
    caps : tuple of float
        Limits on the peak of S_o, rising.
    designs : tuple of GainResult
        One for each limit.
    """

    caps: tuple[float, ...]
    designs: tuple[GainResult, ...]

    def _brief(self) -> Description:
        designs = {
            f"cap {cap:g}": f"{d.objective} {d.value:.6g}, {d.status}"
            for cap, d in zip(self.caps, self.designs, strict=True)
        }
        return brief(self, f"{len(self.caps)} designs", **designs)

    def to_frame(self) -> Any:
        """Return limit, damping (or decay rate) and gains of each design as a data frame.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        gains = {name: [design.gains[name] for design in self.designs] for name in self.designs[0].gains}
        status = [str(design.status) for design in self.designs]
        return data_frame({"cap": self.caps, "value": self.values, "status": status, **gains})

    @property
    def values(self) -> tuple[float, ...]:
        """Damping factor (or decay rate [1/s]) for each limit; NaN when no design satisfies it."""
        return tuple(design.value if design.success else float("nan") for design in self.designs)


def pareto(lpv: LPVModel, caps: Sequence[float], **options: Any) -> ParetoFront:
    """Return the best designs under several limits on the peak of S_o.

    Parameters
    ----------
    lpv : LPVModel
        Model with actuators.
    caps : sequence of float
        Limits on the peak of S_o, in any order; each above 1.
    **options
        Options of `gbid.tune`, without ``peak_sensitivity``; of ``goals`` those besides it.

    Returns
    -------
    ParetoFront
        The design of the next lower limit is a start value of each search, because it also satisfies the higher
        limit. So a higher limit never gives a worse design.

    Raises
    ------
    UsageError
        When `caps` are not numbers above 1, and as for `gbid.tune`.
    """
    if "peak_sensitivity" in options:
        raise UsageError("pareto: peak_sensitivity is set by caps; leave it out")
    try:
        rising = sorted({float(cap) for cap in caps})
    except (TypeError, ValueError):
        rising = []
    if not rising or not all(np.isfinite(cap) and cap > 1 for cap in rising):
        raise UsageError(f"pareto: caps = {caps!r}; give numbers above 1 (S_o is 1 at high frequencies)")
    designs: list[GainResult] = []
    given, goals = options.pop("start", None), options.pop("goals", None)
    for cap in rising:
        start = designs[-1].gains if designs and designs[-1].success else given
        limit = {"peak_sensitivity": cap} if goals is None else {"goals": [*goals, PeakSensitivity(cap)]}
        designs.append(tune(lpv, start=start, **limit, **options))
    return ParetoFront(tuple(rising), tuple(designs))
