"""Tuning of a controller of fixed structure, over the operating points of an LPV model or over any plants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.controllers.scheduled import Scheduled, with_schedule
from gbid.control.controllers.structures import controller_structure
from gbid.control.impact.half_sine import HalfSine
from gbid.control.loop.sampling import Method
from gbid.control.tuning.design_notes import goal_figures, notes_of
from gbid.control.tuning.gain_result import GainResult
from gbid.control.tuning.goals.goal import DesignContext, Goal, limits_of
from gbid.control.tuning.goals.short_form import ShortForm
from gbid.control.tuning.maximise import as_bounds, as_start, check_counts, summarise
from gbid.control.tuning.over_points import sketch_over_points, solve_over_points
from gbid.control.tuning.plants.loops_at_points import LoopsAtPoints
from gbid.control.tuning.plants.plant_set import PlantSet
from gbid.control.tuning.plants.plants_of import DesignPlants, PlantLike, Point, plants_of
from gbid.control.tuning.plants.sampled_loops import Sampling
from gbid.control.tuning.plants.uncertainty import Uncertainty
from gbid.control.tuning.search.global_search import Effort, Progress
from gbid.control.tuning.search.limits import Limits, Objective
from gbid.control.tuning.search.loop_delay import loop_delay
from gbid.control.tuning.search.loop_family import loop_equations
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.sqp import LocalOptimum
from gbid.control.tuning.search.starts.neutral import typical_rate
from gbid.control.tuning.search.step import SearchStep
from gbid.control.tuning.worst_points import add_worst_points
from gbid.errors import UsageError
from gbid.structure.linear import Structure


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
    effort = Effort(starts, seed)
    if isinstance(structure, Scheduled) and structure.terms != ("1",):
        first.append(_constant_gains(design, structure, limits, effort))
    problem, optimum, history = _search(design, limits, (low, high, start_gains), effort, first, progress)
    verified = f"eigenvalues and exact H-infinity norms of {len(problem.families[0])} loops"
    if design.domain is not None:
        plants = design.sampled or design.continuous
        optimum, problem, more, verified = add_worst_points(problem, optimum, plants, design.domain, progress)
        history += more
    used = problem.families[0].points
    points = () if used is None else tuple(dict.fromkeys((float(P), float(Omega)) for P, Omega in used))
    notes = notes_of(design, problem, optimum, names, structure, points, sampling)
    result = summarise(
        problem,
        optimum,
        names,
        history,
        verified,
        notes,
        points=points,
        controller=structure,
        sample_time=sample_time,
    )
    return goal_figures(problem, optimum, result)


def _search(
    design: DesignPlants,
    limits: Limits,
    box: tuple[FloatArray, FloatArray, FloatArray],
    effort: Effort,
    first: list[FloatArray],
    progress: Progress | None,
) -> tuple[GainProblem, LocalOptimum, tuple[SearchStep, ...]]:
    """Return problem, optimum and history: of the continuous loops, or of the sampled ones with starts from these."""
    low, high, neutral = box

    def posed(plants: PlantSet) -> GainProblem:
        family = plants.family(design.points)
        problem = GainProblem((family,), limits, low, high, typical_rate((family,), neutral))
        problem.linear = plants.gain_limits(design.points)
        return problem

    history: tuple[SearchStep, ...] = ()
    plants, of_others = design.continuous, False
    if design.sampled is not None:
        known = sketch_over_points(posed(plants), plants, design.points, neutral, effort, first, progress)
        plants, history, first = design.sampled, known.history, [*(one.x for one in known.ends), *first]
        # few gains: a search of the whole box again, because it costs little; else from the continuous designs
        of_others = len(neutral) > 3
    problem = posed(plants)
    found, more = solve_over_points(problem, plants, design.points, neutral, effort, first, progress, of_others)
    return problem, found, history + more


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


def _constant_gains(design: DesignPlants, structure: Scheduled, limits: Limits, effort: Effort) -> FloatArray:
    """Return the best constant gains as coefficients, a start value with which a schedule cannot become worse."""
    known, constant = design.continuous, replace(structure, terms=("1",))
    assert isinstance(known, LoopsAtPoints)
    assert known.lpv is not None
    equations = loop_equations(known.lpv, constant, delay_s=known.delay_s)
    plants = LoopsAtPoints(constant, equations, design.points, known.uncertainty, known.lpv, known.delay_s)
    low, high, start = _gain_bounds(constant, None)
    family = plants.family(design.points)
    problem = GainProblem((family,), limits, low, high, typical_rate((family,), start))
    best, _ = solve_over_points(problem, plants, design.points, start, effort, [], None)
    values = dict(zip((p.name for p in constant.parameters), best.x, strict=True))
    return np.array([values.get(p.name, 0.0) for p in structure.parameters])
