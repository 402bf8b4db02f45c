"""Tuning of a fixed-structure controller for an LPV model or other plants, and the Pareto front."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from gbid.control.controllers.built_in import PDStructure
from gbid.control.controllers.structures import Scheduled, controller_structure, with_schedule
from gbid.control.tuning.goals import limits_of
from gbid.control.tuning.plants import (
    LpvPlants,
    ModelPlants,
    Plants,
    PlantsLike,
    TuneOptions,
    plants_of,
)
from gbid.control.tuning.problem import Evaluations, GainProblem, Limits
from gbid.control.tuning.response_goals import PeakSensitivity
from gbid.control.tuning.result import GainResult, distance_to_edge, worst_mode
from gbid.control.tuning.search import GainSolution, Progress, SearchOptions, SearchTask, search
from gbid.control.tuning.solve import (
    add_worst_points,
    as_bounds,
    as_start,
    independent_searches,
    solve_over_points,
    summarise,
    with_idle_at,
)
from gbid.core.arrays import FloatArray
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import UsageError
from gbid.core.extras import data_frame
from gbid.core.notes import ControlNote
from gbid.core.option_types import options_of_call
from gbid.lpv import Domain
from gbid.structure.linear import Structure


def notes_of(plants: LpvPlants | ModelPlants, solution: GainSolution) -> tuple[str, ...]:
    """Return notes on a design: unfinished fits, unstable open loops, distance to instability, the sampled loop."""
    labels = solution.problem.families[0].labels
    if isinstance(plants, LpvPlants):
        labels = tuple(map(plants.lpv.domain.label, *plants.points.T))
    unstable = [label for label, rate in zip(labels, plants.slowest, strict=False) if rate < 0]
    notes = tuple(
        ControlNote.FIT_NOT_CONVERGED(f"the plant {fit.model.name!r} comes from a fit that did not converge")
        for fit in (plants.unfinished if isinstance(plants, ModelPlants) else ())
    )
    if unstable:
        notes += (ControlNote.UNSTABLE_OPEN_LOOP(f"the open loop is not stable at {'; '.join(unstable)}"),)
    problem, x = solution.problem, solution.best.x
    if problem.limits.peak_sensitivity is None and not problem.limits.measures and problem.stable(x):
        text, names = "damping alone was maximised: the peak of S_o is not limited", plants.structure.parameters
        edge = None if problem.evaluations.exhausted else distance_to_edge(problem, x, tuple(p.name for p in names))
        if edge and np.isfinite(edge.change):
            text += f"; a change of {edge.gain} by {edge.change:+.2g} makes a loop unstable"
        notes += (ControlNote.PEAK_NOT_LIMITED(text),)
    sampling = plants.sampling
    if sampling is not None and isinstance(plants, LpvPlants):
        worst = worst_mode(replace(problem, limits=Limits()), x)
        text = (
            f"designed for sampling at {1e3 * sampling.sample_time:g} ms with {1e3 * sampling.computation_s:g} ms to "
            f"compute; the sampled loop has a smallest damping factor of {worst.damping:.3f}, at {worst.where}"
        )
        notes += (ControlNote.SAMPLED_LOOP(text),)
    return notes


def tune(
    model: PlantsLike,
    controller: str | Structure | Scheduled = "P",
    *,
    progress: Progress | None = None,
    **options: Any,
) -> GainResult:
    r"""Return the gains of a controller that maximise the damping of an LPV plant within limits.

    .. math:: \max_g \; \min_{P, \Omega} \min_j \zeta_j(g; P, \Omega) \quad\text{with}\quad
              \max_\omega \bar\sigma(S_o(j\omega; g; P, \Omega)) \le M

    over the oscillatory modes of the closed loop (Eqs. 20 to 22) at all operating points. With the limit on S_o no
    pole, real ones included, may be slower than the slowest oscillatory mode of the open loop at these points.

    Parameters
    ----------
    model : LPVModel, LinearModel, LPVFit, FitResult, sequence of these, or dict of str to them
        The plant. An LPV model has actuators. Of several the design holds for all models: fits of several recordings,
        draws, or worst cases; a dict gives their names. Linear models are continuous; their delays may be exact.
    controller : str, Structure or Scheduled
        See `gbid.controller_structure`; by default P with a first-order low-pass of 1000 Hz. To tune the corner
        frequency as well, use ``controller_structure("P", tune_corner=True)``. For gains that depend on pressure and
        speed, use `gbid.control.scheduled`.
    progress : callable, optional
        Called with a `SearchStep` after each stage; True shows them on one line of standard error.
    **options
        Fields of `gbid.control.TuneOptions`: goals, or the short forms ``objective="damping"`` and
        ``peak_sensitivity=2.6``; ``operating_points``, ``actuator``, ``inputs``, ``outputs`` and ``uncertainty`` of the
        plant; ``bounds``, ``start``, ``starts``, ``seed`` and ``seeds`` of the search; ``sample_time``,
        ``computation_s`` and ``method`` for a sampled loop.

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
    return tuned(model, controller, options_of_call(TuneOptions, "tune", options), progress)


def tuned(
    model: PlantsLike,
    controller: str | Structure | Scheduled,
    options: TuneOptions,
    progress: Progress | None = None,
) -> GainResult:
    """Return the gains of a controller: `tune` with its options as one value."""
    structure = controller if isinstance(controller, Scheduled) else controller_structure(controller)
    speeds = options.speeds_rpm
    over = getattr(model, "domain", None) if not speeds else Domain((0.0, 0.0), (min(speeds), max(speeds)))
    structure = with_schedule(structure, over)
    plants = plants_of(model, structure, options)
    if isinstance(plants, ModelPlants) and isinstance(structure, PDStructure):
        structure = structure.at_rate(plants.rate)
    box = _gain_bounds(structure, options.bounds)
    if options.goals is None:
        plants = plants.within(*box[:2], Limits(options.objective), box[2])
    goals = options.default_goals(min(plants.slowest)) if options.goals is None else options.goals
    limits = limits_of(goals, plants.plant, plants.lpv.machine if isinstance(plants, LpvPlants) else None)
    if options.goals is not None:
        plants = plants.within(*box[:2], limits, box[2])
    names = tuple(parameter.name for parameter in structure.parameters)
    given = _by_gain("start", options.start, names)
    first = [as_start([given.get(n, v) for n, v in zip(names, box[2], strict=True)], names)] if given else []
    effort = SearchOptions(options.starts, options.seed, options.evaluations)
    budget = Evaluations.of(options.evaluations, options.seconds)
    if isinstance(structure, Scheduled) and structure.terms != ("1",) and isinstance(plants, LpvPlants):
        first.append(_constant_gains(plants, structure, limits, box, effort, budget))
    task = SearchTask(box[2], tuple(first), effort, progress)
    problem, design = plants.problem(limits, *box, budget), partial(solve_over_points, plants)
    if plants.sampling is not None:
        design = partial(_for_sampling, plants, limits, box)
    solution, values = independent_searches(partial(design, problem), task, options.seeds)
    verified = f"eigenvalues and exact H-infinity norms of {len(solution.problem.families[0])} loops"
    if isinstance(plants, LpvPlants) and plants.domain is not None:
        solution, verified = add_worst_points(solution, plants, plants.domain, task)
    solution = with_idle_at(solution, box[2])
    used = solution.problem.families[0].points if isinstance(plants, LpvPlants) else None
    points = () if used is None else tuple(dict.fromkeys(map(tuple, used.tolist())))
    if isinstance(plants, ModelPlants) and isinstance(structure, Scheduled):
        points = tuple(map(tuple, plants.points[:, :-1].tolist()))
    notes = notes_of(plants, solution)
    if isinstance(plants, ModelPlants) and isinstance(options.operating_points, str):
        text = (
            f"the design holds for {len(plants.models)} models at corners and middles; no worst points between them, "
            "because their actuators, delays or domains differ"
        )
        notes += (ControlNote.WORST_POINTS_NOT_SEARCHED(text),)
    more = {"points": points, "controller": structure, **({} if plants.sampling is None else vars(plants.sampling))}
    return summarise(solution, names, verified, notes, seed_values=values, **more)


Box = tuple[FloatArray, FloatArray, FloatArray]
"""Lower bounds, upper bounds and start values of the gains."""


def _for_sampling(plants: Plants, limits: Limits, box: Box, problem: GainProblem, task: SearchTask) -> GainSolution:
    """Return the best design of the sampled loops, with starts from designs of the continuous loops."""
    budget, continuous = problem.evaluations, plants.continuous
    half = budget.half()
    sketch = search(
        continuous.problem(limits, *box, half, few=True), replace(task, options=replace(task.options, sketch=True))
    )
    budget.count = half.count
    first = (*(end.x for end in sketch.ends), *task.first)
    # few gains: a search of the whole box again, because it costs little; else from the continuous designs
    options = task.options if len(task.neutral) <= 3 else replace(task.options, starts=0)
    solution = solve_over_points(plants, problem, replace(task, first=first, options=options))
    return replace(solution, history=sketch.history + solution.history)


def _gain_bounds(structure: Structure | Scheduled, bounds: Mapping[str, tuple[float, float]] | None) -> Box:
    names = tuple(parameter.name for parameter in structure.parameters)
    given = _by_gain("bounds", bounds, names)
    pairs = [given.get(p.name, (p.lower, p.upper)) for p in structure.parameters]
    low, high = as_bounds([pair[0] for pair in pairs], [pair[1] for pair in pairs], names)
    start = np.clip([p.start if p.start is not None else 0.0 for p in structure.parameters], low, high)
    return low, high, start


def _by_gain(what: str, given: Mapping[str, Any] | None, names: tuple[str, ...]) -> dict[str, Any]:
    """Return values given by name of a gain as a dict; refuse unknown names."""
    unknown = [str(name) for name in given or {} if name not in names]
    if unknown:
        raise UsageError(f"{what}: no gain {', '.join(unknown)}; choose from {', '.join(names)}")
    return dict(given or {})


def _constant_gains(
    plants: LpvPlants, structure: Scheduled, limits: Limits, box: Box, effort: SearchOptions, budget: Evaluations
) -> FloatArray:
    """Return the best constant gains as coefficients of a schedule; from this start a schedule cannot become worse."""
    names = {f"{gain.name}_1" for gain in structure.base.parameters}
    constant = np.array([parameter.name in names for parameter in structure.parameters])
    low, high, start = (values[constant] for values in box)
    others = replace(plants.continuous, structure=replace(structure, terms=("1",)), box=None)
    others = others.within(low, high, limits, start)
    problem = others.problem(limits, low, high, start, budget)
    solution = solve_over_points(others, problem, SearchTask(start, options=effort))
    coefficients = np.zeros(len(constant))
    coefficients[constant] = solution.best.x
    return coefficients


# ---- Pareto front of damping and peak sensitivity.


@dataclass(frozen=True)
class ParetoFront(Brief):
    """Best designs for rising limits on the peak of S_o.

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
        """Damping factor (or decay rate [1/s]) for each limit; NaN if no design satisfies the limit."""
        return tuple(design.value if design.keeps_limits else float("nan") for design in self.designs)


def pareto(model: PlantsLike, caps: Sequence[float], **options: Any) -> ParetoFront:
    """Return the best designs under several limits on the peak of S_o.

    Parameters
    ----------
    model : LPVModel, LinearModel, LPVFit, FitResult, sequence of these, or dict of str to them
        The plant, as for `gbid.tune`.
    caps : sequence of float
        Limits on the peak of S_o, in any order; each above 1.
    **options
        Options of `gbid.tune`, without ``peak_sensitivity``; of ``goals`` those besides it.

    Returns
    -------
    ParetoFront
        The design of the next lower limit is a start value of each search, because it also satisfies the higher
        limit. So a higher limit never gives a worse design. Then each limit is searched once more, from the design of
        the next higher one alone, which may lead to a better optimum.

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

    def design(cap: float, start: Mapping[str, float] | None, **more: Any) -> GainResult:
        limit = {"peak_sensitivity": cap} if goals is None else {"goals": [*goals, PeakSensitivity(cap)]}
        return tune(model, start=start, **limit, **(options | more))

    for cap in rising:
        designs.append(design(cap, designs[-1].gains if designs and designs[-1].keeps_limits else given))
    for i in reversed(range(len(rising) - 1)):
        if not designs[i + 1].keeps_limits:
            continue
        again = design(rising[i], designs[i + 1].gains, starts=0, seeds=1)
        if again.keeps_limits and not designs[i].value >= again.value:
            designs[i] = again
        if designs[i].keeps_limits and designs[i].value > designs[i + 1].value:
            designs[i + 1] = design(rising[i + 1], designs[i].gains, starts=0, seeds=1)
    return ParetoFront(tuple(rising), tuple(designs))
