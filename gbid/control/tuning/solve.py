"""Solution of a design problem: search, exact checks, exchange of loops, independent searches, result."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from itertools import count
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from gbid.control.tuning.certificate import certify
from gbid.control.tuning.design_options import Objective
from gbid.control.tuning.local import LocalOptimum, LocalOptions, optimise_locally, repaired
from gbid.control.tuning.loops import families_of
from gbid.control.tuning.plants import FEW_LOOPS, Plants
from gbid.control.tuning.problem import FEASIBLE, Cut, Evaluations, GainProblem, Limits
from gbid.control.tuning.reach import with_unmoved
from gbid.control.tuning.result import (
    GainResult,
    GainStatus,
    GoalFigure,
    WorstMode,
    exact_norms,
    largest_norm,
    static_gains,
    worst_mode,
)
from gbid.control.tuning.search import (
    LEAST_REACH,
    GainSolution,
    Progress,
    SearchOptions,
    SearchTask,
    best_of,
    better,
    gain_units,
    on_grid,
    reach_of_bounds,
    search,
    typical_rate,
    usable_start,
)
from gbid.core.arrays import FloatArray
from gbid.core.errors import UsageError
from gbid.core.notes import ControlNote
from gbid.core.option_types import takes_options
from gbid.lpv import Domain

LEAST_ALIKE, ALIKE = 3, 1e-4
"""Number of independent searches with the same design that end the others, and relative difference of their values."""
_FAR = 1e9
"""Angular frequency that stands for infinity [rad/s]; of sampled loops, in units of 2 / T, for half the sample rate."""
_REPAIR = 60
"""Number of designs for repairs once the budget is used up: of a design that exceeds limits or is not stable."""
_PLATEAU = 200
"""Number of designs for a faster decay where the damping is 1."""
_CUTS = 10
"""Largest number of rounds in which peaks between the grid frequencies are added."""
_CERTIFICATES = 3
"""Largest number of certificates, each after a better design that the one before had found."""


def solve(problem: GainProblem, task: SearchTask) -> GainSolution:
    """Return the best design of a search, with exact peaks and certificate."""
    return _verified(search(problem, task), task)


def _improve(problem: GainProblem, known: GainSolution, task: SearchTask) -> GainSolution:
    """Return a local optimum near the design of a similar problem, with exact peaks and certificate."""
    best = optimise_locally(problem, known.best.x, LocalOptions(0.02, 300))
    return _verified(GainSolution(problem, best, known.history), task)


def _verified(solution: GainSolution, task: SearchTask) -> GainSolution:
    """Return a design with certificate, repaired so that peaks between grid frequencies satisfy the limits as well."""
    budget = solution.problem.evaluations
    checks = budget.of_checks()
    solution = replace(solution, problem=replace(solution.problem, evaluations=checks))
    for i in range(_CUTS):
        problem, best, spent = solution.problem, solution.best, budget.exhausted or checks.exhausted
        exceeds = spent and not i and best.score.violation > FEASIBLE
        problem = problem if checks.over else with_cuts(problem, best.x)
        if problem is solution.problem and not exceeds:
            break
        if spent:
            best = replace(repaired(_with_reserve(problem), best), converged=False)
        else:
            best = optimise_locally(problem, best.x, LocalOptions(0.02))
        solution = replace(solution, problem=problem, best=best).noted("cut", task.progress)
    problem, best = solution.problem, solution.best
    if not checks.over:
        best = _certified(problem, best)
        best = _fastest_on_plateau(problem, best)  # no design has more than the damping 1: the certificate stays true
        if not problem.stable(best.x):
            best = _stable_instead(problem, best, task)
    budget.count = checks.count
    solution = replace(solution, problem=replace(problem, evaluations=budget), best=best)
    return solution.noted("certificate", task.progress)


def _with_reserve(problem: GainProblem) -> GainProblem:
    """Return the problem with a small budget of evaluations for a repair, within the time of the checks."""
    return replace(problem, evaluations=problem.evaluations.of_checks(_REPAIR))


def _fastest_on_plateau(problem: GainProblem, design: LocalOptimum) -> LocalOptimum:
    """Return the design of fastest decay near a design whose objective has reached its largest value."""
    limits = problem.limits
    plateau = limits.weight * (1 - 1e-9)
    if limits.objective != "damping" or limits.soft or not limits.weight or design.score.value < plateau:
        return design
    checks = problem.evaluations.of_checks(_PLATEAU)
    decay = replace(problem, limits=replace(limits, objective="decay"), evaluations=checks)
    fast = optimise_locally(decay, design.x, LocalOptions(iterations=60))
    for share in (1.0, 0.999, 0.99, 0.95, 0.8, 0.5):
        x = design.x + share * (fast.x - design.x)
        score = problem.score(x)
        kept = score.value >= plateau and score.violation <= max(design.score.violation, FEASIBLE)
        if kept and decay.score(x).value > decay.score(design.x).value:
            return replace(design, x=x, score=score)
    return design


def _stable_instead(problem: GainProblem, unstable: LocalOptimum, task: SearchTask) -> LocalOptimum:
    """Return a stable design in place of an unstable one; the unstable design if no stable design is found.

    The response of an unstable loop can exceed limits that nothing keeps by less than those of the stable ones, and a
    pole that hardly grows costs less merit than the last of the damping is worth.
    """
    problem = _with_reserve(problem) if problem.evaluations.exhausted else problem
    plain = replace(problem, limits=Limits("decay"), cuts=(), linear=())
    safe = search(plain, replace(task, first=(unstable.x,), progress=None)).best.x
    if not problem.stable(safe):
        return unstable
    near = optimise_locally(problem, safe, LocalOptions(0.02, 100)).x
    way = [safe + share * (unstable.x - safe) for share in np.linspace(0.0, 1.0, 40, endpoint=False)]
    stable = [
        replace(unstable, x=x, score=problem.score(x), certificate=None) for x in [*way, near] if problem.stable(x)
    ]
    return best_of([design for design in stable if design.score.usable] or [unstable])


def _certified(problem: GainProblem, design: LocalOptimum) -> LocalOptimum:
    """Return a design with its certificate; a better nearby design if the certificate finds one."""
    unit = gain_units(problem, design.x)
    for _ in range(_CERTIFICATES):
        certificate, x = certify(problem, design.x, np.maximum(unit, np.abs(design.x)))
        if certificate.holds or x is design.x or problem.evaluations.exhausted:
            break
        nearby = optimise_locally(problem, x, LocalOptions(1e-3, 60))
        if not better(nearby.score, design.score) or with_cuts(problem, nearby.x) is not problem:
            break
        design = nearby
    # a local search that ended early has no less reached an optimum where this is certified
    return replace(design, certificate=certificate, converged=design.converged or certificate.holds)


def with_cuts(problem: GainProblem, x: FloatArray) -> GainProblem:
    """Return the problem with the frequencies at which exact norms exceed a limit between the grid points.

    Without such frequencies, the given problem object is returned.
    """
    if not problem.limits.has_responses or not problem.stable(x):
        return problem
    known = problem.score(x).violation
    cuts = list(problem.cuts)
    for kind, limit in (("sensitivity", problem.limits.peak_sensitivity), ("control", problem.limits.peak_control)):
        if limit is None:
            continue
        least = limit * float(np.exp(min(max(known, 0.0), 300.0) + 1e-7))
        for f, family in enumerate(problem.families):
            far = _FAR if family.sample_time is None else 2 * _FAR / family.sample_time
            for i, norm in enumerate(exact_norms(family, x, kind, least)):
                cut = Cut(kind, f, i, min(2 * np.pi * norm.frequency_hz, far))
                if norm.value > least and cut not in cuts:
                    cuts.append(cut)
    return replace(problem, cuts=tuple(cuts)) if len(cuts) > len(problem.cuts) else problem


# ---- Exchange of loops: design for some loops, find loops with a worse result, add them, design again.

_MANY_LOOPS = 30
"""Largest number of loops that are designed for at once, with up to three gains."""
TOLERANCE = 5e-5
"""By how much a design may be worse at a point of the rectangle than at its own points."""
_GRID = {1: 33, 2: 33, 3: 11}
"""Values of each scheduling variable at which a design over a domain is examined, by the number of variables."""
_COARSE = 5
"""As `_GRID`, for more variables."""
_ROUNDS = 20
"""Largest number of rounds in which worst points are added."""


def solve_over_points(plants: Plants, problem: GainProblem, task: SearchTask) -> GainSolution:
    """Return the best design over all loops of the plants; with many loops the search starts with a selection.

    A design that is optimal for some loops and no worse in the others is optimal for all. With few gains every round is
    a search, with many gains a local optimisation from the last design.
    """
    few_gains, every = len(task.neutral) <= 3, problem.families[0]
    if len(every) <= (_MANY_LOOPS if few_gains else FEW_LOOPS):
        return _verified(search(problem, task), task)
    chosen = plants.first(plants.points)
    solution = solve(replace(problem, families=(plants.family(plants.points, chosen),)), task)
    while True:
        measures = problem.by_loop(every, solution.best.x)
        measures[0] += solution.best.score.value
        measures[1:] -= solution.best.score.violation
        worst = {int(row.argmax()) for row in measures if row.max() > 1e-7} - set(chosen)
        if not worst:
            return _improve(problem, solution, task)
        chosen.extend(sorted(worst))
        larger = replace(problem, families=(plants.family(plants.points, chosen),))
        if few_gains:
            again = solve(larger, replace(task, first=(solution.best.x, *task.first)))
            solution = replace(again, history=solution.history + again.history)
        else:
            solution = _improve(larger, solution, task)


def add_worst_points(
    solution: GainSolution, plants: Plants, domain: Domain, task: SearchTask
) -> tuple[GainSolution, str]:
    """Return a design over a rectangle of operating points, and a text on its verification.

    Parameters
    ----------
    solution : GainSolution
        Design over the first points.
    plants : Plants
        Loops at any operating points.
    domain : Domain
        Rectangle of operating points.
    task : SearchTask
        Its `progress` is told of each round.
    """
    for i in count():
        worse, problem = _worse_points(solution, plants, domain), solution.problem
        if not len(worse):
            break
        if i == _ROUNDS:  # there are worse points still
            solution = replace(solution, best=replace(solution.best, converged=False))
            break
        known = problem.families[0].points
        assert known is not None
        points = np.vstack([np.unique(known, axis=0), worse])
        linear = plants.gain_limits(points, problem.lower, problem.upper)
        problem = replace(problem, families=(plants.family(points),), linear=linear, cuts=())
        improved = _improve(problem, solution, replace(task, progress=None))
        solution = replace(improved, history=solution.history).noted("points", task.progress)
    grid = " x ".join(str(_GRID.get(len(domain.bounds), _COARSE)) for _ in domain.bounds)
    return solution, (
        f"eigenvalues and exact H-infinity norms of {len(solution.problem.families[0])} loops; no point of the "
        f"rectangle worse by more than {TOLERANCE:g}, by a {grid} grid with a zoom into its worst places"
    )


def _worse_points(solution: GainSolution, plants: Plants, domain: Domain) -> FloatArray:
    """Return points (k, n_variables) at which the design is worse than at its points, each refined locally."""
    n, count = len(domain.bounds), _GRID.get(len(domain.bounds), _COARSE)
    axes = [np.linspace(low, high, count if low < high else 1) for low, high in domain.bounds]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    step = np.array([axis[1] - axis[0] if len(axis) > 1 else 0.0 for axis in axes])
    low, high = np.array(domain.bounds).T
    score, x = solution.best.score, solution.best.x

    def measured(points: FloatArray) -> FloatArray:
        return measure(solution.problem, x, plants, np.clip(points, low, high))

    offsets = np.stack(np.meshgrid(*[np.linspace(-1, 1, 7)] * n, indexing="ij"), axis=-1).reshape(-1, n)
    tables = measured(grid.reshape(-1, n)).reshape(-1, *grid.shape[:-1])
    worse: list[FloatArray] = []
    for which, table in enumerate(tables):
        allowed = -score.value if which == 0 else max(score.violation, 0.0)
        padded = np.pad(table, 1, constant_values=-np.inf)
        top = table > allowed - 0.02
        for near in np.ndindex(*[3] * n):
            top &= table >= padded[tuple(slice(a, a + size) for a, size in zip(near, table.shape, strict=True))]
        places = sorted(zip(*np.nonzero(top), strict=True), key=lambda place: -table[place])[:4]
        for place in places:
            point, value, reach = grid[place], -np.inf, step
            for _ in range(5):  # grids that shrink around the best point
                near = point + offsets * reach
                values = measured(near)[which]
                if values.max() > value:
                    point, value = near[values.argmax()], float(values.max())
                reach = reach / 3
            if value > allowed + TOLERANCE:
                worse.append(np.clip(point, low, high))
    return np.unique(np.array(worse), axis=0) if worse else np.zeros((0, n))


def measure(problem: GainProblem, x: FloatArray, plants: Plants, points: FloatArray) -> FloatArray:
    """Return minus objective and excesses of a design at points over all plants (n, m); larger is worse."""
    parts = []
    for block in np.array_split(points, max(1, len(points) // 128)):
        values = problem.by_loop(plants.family(block), x)
        parts.append(values.reshape(len(values), -1, len(block)).max(axis=1))
    return np.concatenate(parts, axis=1)


# ---- Independent searches with different seeds.


def independent_searches(
    design: Callable[[SearchTask], GainSolution], task: SearchTask, n: int, certified_is_enough: bool = False
) -> tuple[GainSolution, tuple[float, ...]]:
    """Return the best design of up to n searches with different seeds, and their values; no values for a grid.

    The searches end early when three have found equal designs, or when the budget is used up.

    Parameters
    ----------
    design : callable
        The search.
    task : SearchTask
        Its options have the first seed.
    n : int
        Number of searches.
    certified_is_enough : bool
        Whether a design with a certificate ends them, too.
    """
    if on_grid(len(task.neutral), task.options):
        return design(task), ()
    solutions: list[GainSolution] = []
    for seed in range(task.options.seed, task.options.seed + n):
        solutions.append(design(replace(task, options=replace(task.options, seed=seed))))
        best = max(solutions, key=lambda solution: solution.order)
        enough = _alike([solution.reached for solution in solutions], best.best.score.value) == LEAST_ALIKE
        if enough or (certified_is_enough and best.certified) or best.problem.evaluations.exhausted:
            break
    history = tuple(step for solution in solutions for step in solution.history)
    return replace(best, history=history), tuple(best.problem.in_units(solution.reached) for solution in solutions)


def _alike(values: Iterable[float], best: float) -> int:
    """Return how many values equal the best value within a tolerance."""
    return sum(value >= best - ALIKE * abs(best) for value in values)


# ---- Gains with the largest damping, for any closed-loop matrices that depend on gains.


@dataclass(frozen=True, eq=False)
class DampingOptions:
    """Options of `gbid.maximise_damping`.

    Attributes
    ----------
    lower, upper : float or (d,) array
        Finite bounds.
    objective : {"damping", "decay"}
        Quantity that is maximised.
    slowest_pole : float
        Smallest allowed decay rate of all eigenvalues [1/s]; 0 requires stability only.
    peak_sensitivity, peak_control, static_amplification : float, optional
        Limits on the peaks of S_o and K S_o over frequency, and on the gain of S_o at zero frequency.
    start : (d,) array, optional
        Gains as an additional start value. The zero vector (moved into the bounds) is always a start value.
    starts : int, optional
        Number of random starts of the global stage. By default a grid for up to three gains; for more gains with limits
        16, and 8 for more than eight gains; without limits 24, and 12 for more than twelve gains.
    seed : int
        Seed of the random starts. A search of more than three gains that ends without a certificate is repeated once
        with the next seed, and the better design is returned.
    evaluations : int, optional
        Number of designs after which the search ends, about; the status is then ``"iteration limit"``.
    progress : callable, optional
        Called with a `SearchStep` after each stage.
    """

    lower: npt.ArrayLike
    upper: npt.ArrayLike
    objective: Objective = "damping"
    _: KW_ONLY
    slowest_pole: float = 0.0
    peak_sensitivity: float | None = None
    peak_control: float | None = None
    static_amplification: float | None = None
    start: npt.ArrayLike | None = None
    starts: int | None = None
    seed: int = 0
    evaluations: int | None = None
    progress: Progress | None = None


@takes_options(DampingOptions)
def maximise_damping(
    A_of_gains: ca.Function | Sequence[ca.Function], gains: Sequence[str], options: DampingOptions
) -> GainResult:
    r"""Return the gains that maximise the smallest damping factor, or the slowest decay, over all given loops.

    .. math:: \max_{l \le g \le u} \; \min_{i,\,j} \; \zeta(\lambda_j(A_i(g))), \quad
              \zeta(\lambda) = -\mathrm{Re}\,\lambda / |\lambda|

    over all oscillatory eigenvalues (the real ones must be stable), or ``-Re`` over all eigenvalues.

    Parameters
    ----------
    A_of_gains : casadi.Function or sequence of these
        From the vector of gains (d, 1) to the closed-loop matrix (n, n) in continuous time [1/s]. For limits on
        frequency responses: to A, B, C, D from disturbances d of the q measured outputs to these outputs with their
        disturbances, ``S_o d``, and below to the control signals, ``K S_o d``.
    gains : sequence of str
        Names of the d gains.
    **options

    Returns
    -------
    GainResult
        Its `status` tells whether it is an optimum. When no gains within the bounds stabilise, the status is
        ``"no stabilising gains"``, and the notes name the unstable loop and its worst mode.

    Raises
    ------
    UsageError
        When a function does not take the gains or does not return fitting matrices, when bounds or limits do not fit,
        or when no gains within the bounds were found for which all matrices are finite.

    Notes
    -----
    A global stage finds regions of attraction of local optima, from starts that are first made stable. Local
    optimisation takes steps that use all eigenvalues near the worst one (see `gbid.control.tuning.local`). Eigenvalues
    that coalesce are represented by their mean and by power sums of their distances, because these have derivatives
    there and the eigenvalues have not. The result is a ``"local optimum"`` only when a convex combination of
    gradients certifies it, otherwise ``"stalled"``. With up to three gains, whose search begins with a grid over
    the whole box, it is ``"optimal"``.

    Examples
    --------
    A mass on a spring, ``x'' + g x' + x = 0``: any damping can be reached.

    >>> import casadi as ca
    >>> g = ca.SX.sym("g")
    >>> A = ca.Function("A", [g], [ca.blockcat([[0, 1], [-1, -g]])])
    >>> result = maximise_damping(A, ["g"], 0, 1)
    >>> round(result.gains["g"], 6), round(result.value, 6)
    (1.0, 0.5)
    """
    functions = [A_of_gains] if isinstance(A_of_gains, ca.Function) else _listed(A_of_gains)
    names = (gains,) if isinstance(gains, str) else tuple(gains or ())
    if not functions or not names:
        raise UsageError("maximise_damping: give at least one function and one gain")
    if len(set(names)) < len(names):
        raise UsageError(f"maximise_damping: gains {', '.join(map(str, names))}; give each gain a different name")
    low, high = as_bounds(options.lower, options.upper, names)
    families = families_of(functions, len(names))
    neutral = np.clip(np.zeros(len(names)), low, high)
    limits = Limits(
        options.objective,
        options.slowest_pole,
        options.peak_sensitivity,
        options.peak_control,
        options.static_amplification,
    )
    if limits.has_responses and not all(family.n_outputs for family in families):
        raise UsageError("limits on frequency responses need functions from the gains to A, B, C and D of every loop")
    given = [] if options.start is None else [np.clip(as_start(options.start, names), low, high)]
    neutral = usable_start(families, [neutral, *given], low, high, options.seed)
    scale, designs = typical_rate(families, neutral), Evaluations(most=options.evaluations)
    families = tuple(with_unmoved(family, low, high, limits, scale) for family in families)
    problem = GainProblem(families, limits, low, high, scale, evaluations=designs)
    task = SearchTask(
        neutral, tuple(given), SearchOptions(options.starts, options.seed, options.evaluations), options.progress
    )
    # a search without a certificate may have ended in a poor basin: half of them do on a chemical reactor
    solution, values = independent_searches(partial(solve, problem), task, 2, certified_is_enough=True)
    solution = with_idle_at(solution, neutral)
    n_loops = sum(len(family) for family in families)
    norms = " and exact H-infinity norms" if limits.has_responses else ""
    verified = f"eigenvalues{norms} of the {n_loops} closed-loop matrices"
    return summarise(solution, names, verified, seed_values=values)


def _listed(functions: Any) -> list[Any]:
    if not isinstance(functions, Iterable) or isinstance(functions, str):
        kind = type(functions).__name__
        raise UsageError(
            f"A_of_gains is a {kind}; give a casadi.Function from the gains to the matrix, or a list of these"
        )
    return list(functions)


def with_idle_at(solution: GainSolution, neutral: FloatArray) -> GainSolution:
    """Return a design with gains that move no mode at their neutral values, if the design is then no worse."""
    problem, best = solution.problem, solution.best
    found = [family.unmoved for family in problem.families if family.unmoved]
    idle = np.logical_and.reduce([each.idle for each in found]) if len(found) == len(problem.families) else None
    if idle is None or not idle.any() or problem.evaluations.late:
        return solution
    x = np.where(idle, neutral, best.x)
    score = problem.score(x)
    return solution if better(best.score, score) else replace(solution, best=replace(best, x=x, score=score))


def _unmoved(problem: GainProblem, names: tuple[str, ...], value: float) -> tuple[str, ...]:
    """Return notes on gains that move no mode, and on weakly damped modes that no gain moves."""
    every = [family for family in problem.families if family.unmoved]
    modes = [WorstMode.of(f.labels[i], rate) for f in every for i, rate in (f.unmoved.modes if f.unmoved else ())]
    modes = [mode for mode in modes if mode.value(problem.limits.objective) < value or mode.damping < _LIGHT]
    modes.sort(key=lambda mode: mode.value(problem.limits.objective))
    notes: tuple[str, ...] = ()
    if modes:
        listed = [f"{mode.frequency_hz:.4g} Hz, damping {mode.damping:.3g}, of {mode.where}" for mode in modes]
        more = f"; and {len(listed) - _PLACES} more" if len(listed) > _PLACES else ""
        text = f"no gain moves the modes with {'; '.join(listed[:_PLACES])}{more}: the design is for the other modes"
        notes = (ControlNote.UNMOVED_MODES(text if len(listed) > 1 else text.replace("modes with", "mode with")),)
    idle = [name for i, name in enumerate(names) if len(every) and all(f.unmoved and f.unmoved.idle[i] for f in every)]
    if idle and len(every) == len(problem.families):
        notes += (ControlNote.IDLE_GAINS(f"{', '.join(idle)}: no mode of any loop moves with these gains"),)
    return notes


def summarise(
    solution: GainSolution,
    names: tuple[str, ...],
    verified_on: str,
    notes: tuple[str, ...] = (),
    seed_values: tuple[float, ...] = (),
    **more: Any,
) -> GainResult:
    """Return the result of a search from eigenvalues and exact norms of the final design.

    Without values of independent searches the search began with a grid over the whole box.
    """
    problem, best = solution.problem, solution.best
    x = np.clip(best.x, problem.lower, problem.upper)
    late = problem.evaluations.late
    score, stable = best.score if late else problem.score(x), problem.stable(x)
    worst = worst_mode(problem, x)
    certificate = best.certificate
    status = GainStatus.STALLED
    if solution.certified:
        alike = _alike(seed_values, np.nanmax([*seed_values, -np.inf]))
        status = GainStatus.OPTIMAL if not seed_values or alike >= LEAST_ALIKE else GainStatus.LOCAL_OPTIMUM
    if not best.converged or (problem.evaluations.exhausted and status is GainStatus.STALLED):
        status = GainStatus.ITERATION_LIMIT
    ended = "; the budget ended the search" if problem.evaluations.exhausted else ""
    if not stable:
        status = GainStatus.NO_STABILISING_GAINS
        text = f"no gains within the bounds were found that stabilise {worst.where}: {_mode(worst)}{ended}"
        if reach_of_bounds(problem) < LEAST_REACH:
            text += "; gains within the bounds hardly move a pole: give bounds= in the units of the plant"
        notes = (*notes, ControlNote.NO_STABILISING_GAINS(text))
    elif score.violation > FEASIBLE:
        # an ended budget leaves open whether other gains keep the limits
        status = GainStatus.ITERATION_LIMIT if problem.evaluations.exhausted else GainStatus.LIMITS_CONTRADICT
        text = f"no design was found that keeps all limits; this one exceeds them by {score.violation:.2g}{ended}"
        notes = (*notes, ControlNote.LIMITS_EXCEEDED(text))
    if status is GainStatus.STALLED and certificate is not None:
        text = (
            "no certificate of optimality: to first order the objective would rise by "
            f"{100 * certificate.gain:.2g} % if the gains changed by their own size; sequential quadratic programmes, "
            "steps to coalescing eigenvalues, random moves and gradients from balls around it found no better one"
        )
        notes = (*notes, ControlNote.NO_CERTIFICATE(text))
    reached = problem.in_units(score.value) if stable else worst.value(problem.limits.objective)
    notes = (*notes, *_unmoved(problem, names, reached))
    if stable and problem.limits.objective == "damping" and reached > 1 - FEASIBLE and not problem.limits.soft:
        decay = worst_mode(replace(problem, limits=Limits("decay")), x).value("decay")
        text = f"no mode oscillates, which other gains may reach, too; the slowest mode decays with {decay:.3g} 1/s"
        notes = (*notes, ControlNote.NO_OSCILLATION(text))
    active, peaks = _active(problem, x, names, stable), _peaks(problem, x, stable)
    if stable and not peaks and late:
        verified_on += " at first, eigenvalues alone at the end: the time was over"
    if certificate is not None and np.isfinite(certificate.gain):
        peaks |= {f"certificate_{name}": getattr(certificate, name) for name in ("gain", "radius", "room")}
    more = {**peaks, **more}
    result = GainResult(
        dict(zip(names, map(float, x), strict=True)),
        reached,
        problem.limits.objective,
        status,
        score.violation,
        verified_on,
        worst,
        active,
        notes,
        history=solution.history,
        seed_values=seed_values,
        **more,
    )
    return _with_goals(result, problem, x)


def _with_goals(result: GainResult, problem: GainProblem, x: FloatArray) -> GainResult:
    """Return the result with the values that the design reached for its goals, and with its damping."""
    limits = problem.limits
    if not limits.measures or problem.evaluations.late:
        return result
    figures = []
    states = [problem.state(family, family.matrices(x), x) for family in problem.families]
    for measure in limits.measures:
        excess = [(float(e), name) for s in states for e, name in zip(measure.excess(s), s.family.labels, strict=True)]
        figures.append(GoalFigure(measure.name, measure in limits.soft, *max(excess)))
    result = replace(result, goals=tuple(figures))
    if not limits.soft:
        return result
    if not limits.weight:
        return replace(result, objective="goals")
    return replace(result, value=result.worst.value(limits.objective))


def _mode(worst: WorstMode) -> str:
    if np.isnan(worst.frequency_hz):
        return "its matrix is not finite"
    return f"its worst mode has {worst.frequency_hz:.4g} Hz and damping {worst.damping:.4g}"


def _peaks(problem: GainProblem, x: FloatArray, stable: bool) -> dict[str, float]:
    """Return the exact peaks over all loops with outputs."""
    families = [family for family in problem.families if family.n_outputs]
    if not families or not stable or problem.evaluations.late:
        return {}
    return {
        "peak_sensitivity": max(largest_norm(f, x, "sensitivity") for f in families),
        "peak_control": max(largest_norm(f, x, "control") for f in families),
        "static_amplification": max(float(static_gains(f, x).max()) for f in families),
    }


def _active(problem: GainProblem, x: FloatArray, names: tuple[str, ...], stable: bool) -> tuple[str, ...]:
    width = problem.upper - problem.lower
    bounds = [f"{n} at its lower bound" for n, at in zip(names, x - problem.lower < 1e-6 * width, strict=True) if at]
    bounds += [f"{n} at its upper bound" for n, at in zip(names, problem.upper - x < 1e-6 * width, strict=True) if at]
    if not stable or problem.evaluations.late:
        return tuple(bounds)
    reached: dict[str, dict[str, None]] = {}
    located = {*_TITLES, *(extra.name for extra in problem.limits.extra)}
    for piece in sorted(problem.functions(x).limits, key=lambda piece: -piece.value):
        if piece.value > -1e-4:
            places = reached.setdefault(_TITLES.get(piece.kind, piece.kind), {})
            if piece.kind in located:
                places[problem.families[piece.family].labels[piece.loop]] = None
    return tuple(dict.fromkeys([*(text for title in reached for text in _located(title, [*reached[title]])), *bounds]))


def _located(title: str, places: list[str]) -> list[str]:
    """Return texts of a limit and its points, worst point first; many points as a count."""
    if len(places) > _PLACES:
        return [f"{title} at {places[0]} and {len(places) - 1} more"]
    return [f"{title} at {place}" for place in places] or [title]


_LIGHT = 0.5
"""Damping factor below which a mode that no gain moves is named even if others are worse; filters have more."""
_PLACES = 4
"""Largest number of places of a limit that are named one by one."""
_TITLES = {
    "pole": "slowest pole",
    "sensitivity": "peak of S_o",
    "control": "peak of K S_o",
    "static": "static amplification",
}


def as_bounds(lower: npt.ArrayLike, upper: npt.ArrayLike, names: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
    """Return bounds as arrays with one number per gain.

    Raises
    ------
    UsageError
        When their number differs from that of the gains, when they are not finite, or when lower is not below upper.
    """
    try:
        low, high = (np.broadcast_to(np.asarray(b, float), len(names)).copy() for b in (lower, upper))
    except (TypeError, ValueError):
        raise UsageError(
            f"bounds {lower!r} and {upper!r}; give numbers, one for each of {len(names)} gains ({', '.join(names)})"
        ) from None
    for name, a, b in zip(names, low, high, strict=True):
        if not (np.isfinite(a) and np.isfinite(b) and a < b):
            raise UsageError(f"gain {name!r}: bounds [{a:g}, {b:g}]; give two finite numbers, lower first")
    return low, high


def as_start(start: npt.ArrayLike, names: tuple[str, ...]) -> FloatArray:
    """Return a start value as an array.

    Raises
    ------
    UsageError
        When it does not have one finite number per gain.
    """
    try:
        x = np.asarray(start, float)
    except (TypeError, ValueError):
        x = np.array([])
    if x.shape != (len(names),) or not np.isfinite(x).all():
        raise UsageError(f"start = {start!r}; give {len(names)} finite numbers ({', '.join(names)})")
    return x
