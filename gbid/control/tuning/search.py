"""Search over gains: start values, local searches in rungs, basin hopping."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from heapq import heapify, heappop, heappush
from itertools import islice
from typing import Any

import numpy as np
import scipy

from gbid.control.tuning.certificate import certify
from gbid.control.tuning.local import LocalOptimum, LocalOptions, optimise_locally
from gbid.control.tuning.loops import LoopFamily
from gbid.control.tuning.plane import eigenvalues, true_rates
from gbid.control.tuning.problem import FEASIBLE, PENALTY, GainProblem, Limits, Score, SearchStep, merit
from gbid.core.arrays import ComplexArray, FloatArray, IntArray
from gbid.core.errors import UsageError
from gbid.core.option_types import Count, CountOrZero, check_options


def better(one: Score, other: Score) -> bool:
    """Return whether a design is better than another: feasibility first, objective second."""
    kept = one.violation <= FEASIBLE, other.violation <= FEASIBLE
    if kept[0] != kept[1]:
        return kept[0]
    return one.value > other.value if kept[0] else one.violation < other.violation


def rank(found: LocalOptimum) -> float:
    """Return the merit of a design, objective minus a penalty on the largest violation."""
    return merit(found.score)


def best_of(found: list[LocalOptimum]) -> LocalOptimum:
    """Return the best of several designs."""
    best = found[0]
    for one in found[1:]:
        best = one if better(one.score, best.score) else best
    return best


@dataclass(frozen=True)
class SearchOptions:
    """Effort of a search over gains; docs/decisions/0078-search-over-gains.md has the reasons for the default values.

    Parameters
    ----------
    starts : int, optional
        Number of random starts. By default a grid for up to three gains. For more gains 16, and 8 for more than eight;
        where only eigenvalues count 24, and 12 for more than twelve.
    seed : int
        Seed of the random starts and moves.
    evaluations : int, optional
        Approximate number of designs after which the search ends.
    finalists : int
        Number of the best designs that are fully optimised.
    short : int
        Iterations of a short local search: from each start, then again from the better two thirds. The nodes of a grid
        need none, because the grid shows how good they are. Where only eigenvalues count it is a full one.
    full : int
        Iterations of a full local search.
    hops : int
        Largest number of basin-hopping steps from a design: random moves, each followed by a local search. For more
        than three gains, because a local search may stop early where eigenvalues coalesce.
    patience : int
        Number of failed basin-hopping steps in a row that end them. One step of six leaves a lower local optimum. Half
        as many are enough where only eigenvalues count.
    returned : int
        Number of basin-hopping steps back to the same optimum that end them.
    hop_sizes : tuple of float
        Sizes of the basin-hopping steps in turn, as shares of the bounds; a basin may be a few % wide.
    free_hop_sizes : tuple of float
        Sizes where only eigenvalues count, in units or shares of the gains.
    hop_radius : float
        Trust region of the local search after a basin-hopping step, as a share of the bounds.
    sketch : bool
        Whether several different designs are wanted, as starts for similar loops: each finalist is moved a few times.
    sketch_hops : int
        Number of basin-hopping steps of each finalist with `sketch`.
    nodes : int
        Number of points of a grid from which a search begins.
    pace : float
        By what share of its goal a local search may be behind for each iteration that is left.
    certifying_radii : tuple of float
        Trust regions of further local searches from a design without a certificate, as shares of the bounds.
    neighbours : float
        Distance of designs, as a share of the bounds, within which they belong to one optimum; and of a gain from a
        bound at which a further local search begins.
    least_rise : float
        Relative rise below which a basin-hopping step counts as failed.
    different : float
        Relative difference of values from which on designs count as different optima.
    same, agreeing : float
        Relative difference of values that count as the same optimum: after random moves, and of full local searches.
    """

    starts: CountOrZero | None = None
    seed: CountOrZero = 0
    evaluations: Count | None = None
    finalists: int = 3
    short: int = 30
    full: int = 100
    hops: int = 48
    patience: int = 12
    returned: int = 8
    hop_sizes: tuple[float, ...] = (0.005, 0.01, 0.02, 0.05)
    free_hop_sizes: tuple[float, ...] = (1e-3, 1e-2, 0.1, 0.5)
    hop_radius: float = 0.01
    sketch: bool = False
    sketch_hops: int = 6
    nodes: int = 5
    pace: float = 4e-3
    certifying_radii: tuple[float, ...] = (1e-3, 5e-3)
    neighbours: float = 1e-3
    least_rise: float = 3e-4
    different: float = 1e-3
    same: float = 1e-4
    agreeing: float = 1e-5

    def __post_init__(self) -> None:
        check_options(self)


Progress = Callable[[SearchStep], None]


@dataclass(frozen=True)
class SearchTask:
    """Task of a search: neutral gains, additional start values, effort, and progress callback.

    Parameters
    ----------
    neutral : (d,) array
        Gains near which the loops are probably stable. Random starts are moved towards it until they are stable.
    first : tuple of (d,) arrays
        Additional start values.
    options : SearchOptions
        Effort.
    progress : callable, optional
        Called with a `SearchStep` after each stage.
    """

    neutral: FloatArray
    first: tuple[FloatArray, ...] = ()
    options: SearchOptions = SearchOptions()
    progress: Progress | None = None


GRID = {1: 61, 2: 25, 3: 9}
"""Number of grid points per gain, for up to three gains."""
NORM_GRID = {1: 25, 2: 9, 3: 5}
"""The same where only peaks of responses count: their nodes cost more, and eigenvalues bound none of them."""


def on_grid(n_gains: int, options: SearchOptions) -> bool:
    """Return whether the search starts with a grid over the whole box, which does not depend on the seed."""
    return n_gains in GRID and options.starts is None


@dataclass(frozen=True, eq=False)
class LocalSearch:
    """Local search of a problem: SQP over all active functions.

    Where nothing but eigenvalues counts, more of them coalesce, and the way along the surface on which they coalesce
    is longer. An evaluation then takes less time, and every start has a full local search.

    Parameters
    ----------
    problem : GainProblem
        The design problem.
    unit : (d,) array
        Units of the gains.
    options : SearchOptions
        Numbers of iterations, sizes of moves.
    """

    problem: GainProblem
    unit: FloatArray
    options: SearchOptions
    _certified: dict[bytes, bool] = field(default_factory=dict, init=False, repr=False)

    @property
    def free(self) -> bool:
        """Whether only eigenvalues are limited and the gains are too many for a grid."""
        limits = self.problem.limits
        limited = limits.has_responses or limits.measures or self.problem.linear
        return len(self.unit) not in GRID and not limited

    @property
    def norms(self) -> bool:
        """Whether the objective is made of peaks of responses, with stability as the only limit."""
        limits = self.problem.limits
        limited = limits.has_responses or limits.extra or limits.slowest_pole or self.problem.linear
        return not (limited or limits.weight) and all(soft.stable_only for soft in limits.soft)

    @property
    def step_unit(self) -> FloatArray | None:
        """Units of the first steps of a local search; None for the width of the bounds."""
        return self.unit if self.norms else None

    def short(self, start: FloatArray, target: float, again: bool = False) -> LocalOptimum:
        """Improve a start by a short local search; by a full search if only eigenvalues are limited.

        A repeated search (`again`) starts with shorter steps, and uses curvature and coalescence.
        """
        if self.free:
            return self.full(start)
        if self.norms:  # curved valleys need their curvature, and the first steps a length that fits the gains
            effort = LocalOptions(1.0, 2 * self.options.short, unit=self.unit, repair=False)
            return self._stable_end(start, start, effort)
        effort = LocalOptions(0.02 if again else 0.1, self.options.short, not again, repair=False)
        return self._stable_end(start, start, replace(effort, target=target, pace=self.options.pace))

    def full(self, start: FloatArray, target: float = -np.inf, known: tuple[LocalOptimum, ...] = ()) -> LocalOptimum:
        """Return a local optimum, or the known optimum to which the search leads back; stop early below a target."""
        if self.free:  # coalesced eigenvalues creep along a curved surface; no target tells how far
            return self._stable_end(start, start, LocalOptions(iterations=2 * self.options.full))
        effort = LocalOptions(iterations=self.options.full, target=target, pace=self.options.pace, known=known)
        effort = replace(effort, unit=self.step_unit)
        return self._stable_end(start, start, replace(effort, near=self.options.neighbours * self.unit))

    def hop(self, best: LocalOptimum, size: float, rng: np.random.Generator) -> LocalOptimum:
        """Return the local optimum after a random step of a given size; stop early if it cannot be better."""
        near = np.maximum(self.unit, np.abs(best.x))
        width = near if self.free or self.norms else self.problem.upper - self.problem.lower
        start = best.x + size * rng.standard_normal(len(best.x)) * width
        effort = LocalOptions(self.options.hop_radius, 60, unit=self.step_unit)
        if not self.free:
            near = self.options.neighbours * self.unit
            effort = replace(effort, target=rank(best), pace=self.options.pace, known=(best,), near=near)
        return self._stable_end(start, best.x, effort)

    def _stable_end(self, start: FloatArray, stable: FloatArray, effort: LocalOptions) -> LocalOptimum:
        """Return the end of a local search; if its loops are unstable, a design with stable loops.

        The violation of an unstable loop is that of its slowest pole, and may be smaller than that of a peak.
        """
        end = optimise_locally(self.problem, start, effort)
        if end.score.violation <= FEASIBLE or self.problem.stable(end.x) or not self.problem.stable(stable):
            return end
        return LocalOptimum(stable, self.problem.score(stable), end.iterations, False)

    def with_certificate(self, best: LocalOptimum) -> LocalOptimum:
        """Return a certified design by local searches with short steps; without success the best design found.

        A local search along a narrow ridge may creep and end early: those with other first steps do not. One of them
        begins with the gains at the bounds that they are next to.
        """
        low, high = self.problem.lower, self.problem.upper
        near = self.options.neighbours * (high - low)
        at_bounds = np.where(best.x - low < near, low, np.where(high - best.x < near, high, best.x))
        for start in [best.x, at_bounds] if (at_bounds != best.x).any() else [best.x]:
            for radius in self.options.certifying_radii:
                if self.problem.evaluations.exhausted or self.certified(best):
                    return best
                again = optimise_locally(self.problem, start, LocalOptions(radius, 60, unit=self.step_unit))
                best = again if better(again.score, best.score) else best
        return best

    def certified(self, best: LocalOptimum) -> bool:
        """Return whether a design is optimal to first order."""
        key = best.x.tobytes()
        if key not in self._certified:  # that there is no certificate takes a hundred times as long as to find one
            self._certified[key] = certify(self.problem, best.x, np.maximum(self.unit, np.abs(best.x)))[0].holds
        return self._certified[key]

    def settled(self, finals: list[LocalOptimum]) -> bool:
        """Return whether three of the best designs have equal values and the best design is certified."""
        best = best_of(finals)
        return sum(_same(one.score, best.score, self.options.agreeing) for one in finals) > 2 and self.certified(best)


Note = Callable[[str, LocalOptimum], None]


def hop(local: LocalSearch, finals: list[LocalOptimum], rng: np.random.Generator, note: Note) -> LocalOptimum:
    """Basin hopping from the best design, then from other designs while the best one has no certificate.

    If no step from the best design improves it, the steps also start from one other design.
    """
    start = best_of(finals)
    others = [
        one
        for one in sorted(finals, key=rank, reverse=True)
        if not _same(one.score, start.score, local.options.different)
    ]
    less = replace(local, options=replace(local.options, patience=local.options.patience // 2))
    best = local.with_certificate(hop_line(less if local.free else local, start, rng, note))
    doubted = int(_same(best.score, start.score, local.options.different))
    for i, other in enumerate(others):
        if local.problem.evaluations.exhausted or (i >= doubted and local.certified(best)):
            break
        line = hop_line(less, other, rng, note)
        best = local.with_certificate(line) if better(line.score, best.score) else best
    return best


def hop_line(local: LocalSearch, best: LocalOptimum, rng: np.random.Generator, note: Note) -> LocalOptimum:
    """Basin-hopping steps from one design, until several steps in a row fail or return to known optima."""
    options, failed_steps, returned = local.options, 0, 0
    sizes = options.free_hop_sizes if local.free or local.norms else options.hop_sizes
    for i in range(options.hops):
        if failed_steps >= options.patience or returned >= options.returned or local.problem.evaluations.exhausted:
            break
        size = sizes[i % len(sizes)]
        again = local.hop(best, size, rng)
        improved = better(again.score, best.score)
        progress = again.score.value - best.score.value > options.least_rise * abs(best.score.value)
        repaired = again.score.violation <= FEASIBLE < best.score.violation
        if improved and (progress or repaired):
            failed_steps = returned = 0
        else:
            failed_steps += 1
            returned += _same(again.score, best.score, options.same) and size > sizes[0] and not local.free
        best = again if improved else best
        note("basin hopping", best)
    return best


def _same(score: Score, other: Score, share: float) -> bool:
    return score.violation <= FEASIBLE and abs(score.value - other.value) <= share * abs(other.value)


def spread_points(n: int, d: int, seed: int) -> FloatArray:
    """Return n points (n, d) that fill the unit cube evenly, with a random shift.

    The points are multiples of the square roots of primes (R. D. Richtmyer, "The evaluation of definite integrals, and
    a quasi-Monte-Carlo method based on the properties of algebraic numbers", Los Alamos report LA-1342, 1951). The
    package for such points in scipy takes a second to load.
    """
    primes = [k for k in range(2, 12 * (d + 1)) if all(k % i for i in range(2, int(k**0.5) + 1))]
    shift = np.random.default_rng(seed).random(d)
    return np.asarray((shift + np.arange(n)[:, None] * np.sqrt(primes[:d])) % 1.0)


_SHARES = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)
_UNIFORM = 64
"""Points of the whole box that are tried before an ascent: together they take less time."""
_MARGIN = 0.02
"""Decay beyond the slowest allowed one at which a pole no longer counts in this ascent, in typical rates."""
_UNUSABLE = 1e30
"""Growth where a matrix is not finite: more than any."""
_NEARBY = 1.0, 0.3
"""Spread of the starts for the peak of a response: far from the neutral gains most local optima are poor."""
WIDE = 8.0
"""Width of the bounds, in units of the gain, from which on a grid and random starts are denser near the middle."""


def random_starts(
    problem: GainProblem,
    neutral: FloatArray,
    unit: FloatArray,
    n: int,
    seed: int,
    spread: tuple[float, float] = (WIDE, 1.0),
) -> list[FloatArray]:
    """Return random starts around the neutral gains, each moved to gains with stable loops if possible.

    The distances from the neutral gains lie between the units of the gains and the widths of the bounds, with a
    logarithmic distribution. So bounds that are far too wide still leave starts where loops can be stable.

    Parameters
    ----------
    problem : GainProblem
        The design problem.
    neutral : (d,) array
        Gains near which the loops are probably stable.
    unit : (d,) array
        Units of the gains.
    n : int
        Number of starts.
    seed : int
        Seed of the random numbers.
    spread : (float, float)
        Smallest distance in units, and the share of the decades from it to the bounds in which the distances lie.
    """
    d, low, high = len(neutral), problem.lower, problem.upper
    rows = spread_points(n, d + 1, seed)
    # with positive bounds over more than a decade, starts have a logarithmic distribution
    decades = (low > 0) & (high > 10 * low)
    first, last = np.where(decades, low, 1.0), np.where(decades, high, 1.0)
    uniform = (low + u * (high - low) for u in spread_points(_UNIFORM * n, d, seed))
    starts = []
    for u, far in zip(rows[:, :d], rows[:, d], strict=True):
        if problem.evaluations.exhausted:
            break
        x = np.where(decades, first * (last / first) ** u, low + u * (high - low))
        reach = np.where(decades, 1.0, np.minimum(spread[0] * unit / (high - low), 1.0) ** (1.0 - spread[1] * far))
        x = neutral + reach * (x - neutral)
        nearer = (neutral + np.where(decades, 1.0, share) * (x - neutral) for share in _SHARES)
        stable = next((y for y in nearer if problem.stable(y)), None)
        tried = [x, *islice(uniform, _UNIFORM)] if stable is None else [stable]
        starts.append(_stabilised(problem, tried, unit))
    return starts


def _stabilised(problem: GainProblem, points: list[FloatArray], unit: FloatArray) -> FloatArray:
    """Return the first point with stable loops; else the end of an ascent from the point of slowest growth.

    The ascent minimises the sum of squares of the rates of all poles that do not decay fast enough. Unlike the largest
    rate, it is smooth where poles change places and moves all unstable poles at once.
    """
    slowest = np.inf
    for x in points:
        growth = problem.growth(x)
        if growth < problem.edge:
            return x
        if growth <= slowest:
            slowest, start = growth, x
    decay = replace(problem, limits=Limits("decay", problem.limits.slowest_pole), linear=(), cuts=())

    def evaluate(u: FloatArray) -> tuple[float, FloatArray]:
        functions = decay.functions(u * unit, _MARGIN)
        if not functions.score.usable:
            return _UNUSABLE, np.zeros_like(u)
        excess = np.array([piece.value + _MARGIN for piece in functions.limits])
        slopes = np.array([piece.slope for piece in functions.limits]).reshape(-1, len(u))
        return float(excess @ excess), 2 * excess @ slopes * unit

    def ended(intermediate_result: Any) -> None:
        if intermediate_result.fun <= _MARGIN**2 / 2 or problem.evaluations.exhausted:
            raise StopIteration

    bounds, most = zip(problem.lower / unit, problem.upper / unit, strict=True), 60 + 15 * len(unit)
    effort: Any = {"bounds": list(bounds), "callback": ended, "options": {"maxfun": most}}
    result = scipy.optimize.minimize(evaluate, start / unit, jac=True, method="L-BFGS-B", **effort)
    return np.asarray(np.clip(result.x * unit, problem.lower, problem.upper))


_BOUNDING = 4
"""Largest number of loops of a family in a bound: a few far apart give nearly the bound of all."""
_ANY = 1e6
"""Bound of a merit that eigenvalues do not bound."""
_BEHIND_GAIN_GRID = 0.1
"""How far behind the best merit of the grid a bound may be for all loops to be computed."""


def grid_starts(problem: GainProblem, neutral: FloatArray, unit: FloatArray, n: int, most: int) -> list[FloatArray]:
    """Return the best points of a grid that are not neighbours, sorted by merit.

    The result has more points than the local maxima of the grid, because along a limit the grid would miss optima. The
    merit in one loop, without peaks, is an upper bound and cheap; the merit in some loops is a tighter one. All loops
    are computed only where both are high enough.
    """
    d = len(problem.lower)
    axes = [_axis(*row, n) for row in zip(problem.lower, neutral, problem.upper, unit, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, d)
    places = np.stack(np.meshgrid(*[np.arange(n)] * d, indexing="ij"), axis=-1).reshape(-1, d)
    some = [np.linspace(0, len(f) - 1, min(len(f), _BOUNDING)).astype(np.intp) for f in problem.families]
    tighter = any(len(family) > len(own) for family, own in zip(problem.families, some, strict=True))
    # the node of highest bound comes next: its bound is made tighter, or its merit is computed
    queue = [(-bound, i, False) for i, bound in enumerate(_bounds_of_one(problem, grid, neutral, some))]
    heapify(queue)
    merits = np.full(len(grid), -np.inf)
    best = -np.inf
    while queue and -queue[0][0] > best - _BEHIND_GAIN_GRID and not problem.evaluations.exhausted:
        _, i, tight = heappop(queue)
        if tighter and not tight:
            heappush(queue, (-merit(problem.score(grid[i], best - _BEHIND_GAIN_GRID, some)), i, True))
            continue
        score = problem.score(grid[i], worst=best - _BEHIND_GAIN_GRID)
        if score.value > best - _BEHIND_GAIN_GRID:
            merits[i] = merit(score)
            best = max(best, merits[i])
    chosen: list[int] = []
    for i in np.argsort(-merits, kind="stable"):
        if len(chosen) == most or not np.isfinite(merits[i]):
            break
        if all(np.abs(places[i] - places[other]).max() > 1 for other in chosen):
            chosen.append(int(i))
    return [grid[i] for i in chosen]


def _bounds_of_one(problem: GainProblem, designs: FloatArray, neutral: FloatArray, some: list[IntArray]) -> FloatArray:
    """Return upper bounds of the merits (q,) without peaks, from one loop of each family.

    The loop is the worst of some loops at the neutral gains.
    """
    value, slow = np.full(len(designs), np.inf), np.full(len(designs), -np.inf)
    for family, own in zip(problem.families, some, strict=True):
        T = family.sample_time
        aims = problem.aim(true_rates(eigenvalues(family.states(neutral)[own]), T), T)
        one = own[int(np.nan_to_num(aims).min(axis=1).argmin())]
        rates = true_rates(eigenvalues(np.concatenate([family.states(x, slice(one, one + 1)) for x in designs])), T)
        value = np.minimum(value, problem.aim(rates, T).min(axis=1))
        slow = np.maximum(slow, rates.real.max(axis=1))
    if not problem.limits.weight:  # eigenvalues are no bound: fast designs first, unstable ones where none is stable
        value = np.where(slow < problem.edge, _ANY, -_ANY) - slow / problem.scale
    merit = value - PENALTY * np.maximum(0.0, (problem.slowest + slow) / problem.scale)
    return np.asarray(np.where(np.isnan(merit), -np.inf, merit))


def _axis(low: float, middle: float, high: float, unit: float, n: int) -> FloatArray:
    """Return n grid values between bounds; between wide bounds they are denser near the middle."""
    if high - low <= WIDE * unit:
        return np.linspace(low, high, n)
    ends = np.arcsinh((low - middle) / unit), np.arcsinh((high - middle) / unit)
    nodes = middle + unit * np.sinh(np.linspace(*ends, n))
    nodes[0], nodes[-1] = low, high
    return np.asarray(nodes)


_TRIED = 64


def usable_start(
    families: Sequence[LoopFamily], given: Sequence[FloatArray], lower: FloatArray, upper: FloatArray, seed: int
) -> FloatArray:
    """Return the first gains with finite eigenvalues of all loops: among given gains, then among random gains.

    Raises
    ------
    UsageError
        When there are none.
    """
    random = spread_points(_TRIED, len(lower), seed)
    for x in (*given, *(lower + random * (upper - lower))):
        if all(np.isfinite(eigenvalues(family.states(x))).all() for family in families):
            return np.asarray(x)
    raise UsageError(
        f"the closed-loop matrices are not finite at the start nor at {_TRIED} random gains within the bounds; check "
        "the function and its bounds"
    )


def typical_rate(families: Sequence[LoopFamily], x: FloatArray) -> float:
    """Return the geometric mean of the magnitudes of the eigenvalues, the unit of rates.

    Raises
    ------
    UsageError
        When a matrix is not finite.
    """
    every = [np.abs(eigenvalues(family.states(x))) for family in families]
    for family, sizes in zip(families, every, strict=True):
        for label, finite in zip(family.labels, np.isfinite(sizes.max(axis=1)).tolist(), strict=True):
            if not finite:
                raise UsageError(
                    f"{label}: the closed-loop matrix is not finite at the start; check the plant, also those drawn "
                    "from its uncertainty, or the function and its bounds"
                )
    sizes = np.concatenate([sizes.ravel() for sizes in every])
    sizes = sizes[sizes > 1e-9 * sizes.max()] if sizes.any() else np.ones(1)
    return float(np.exp(np.log(sizes).mean()))


_MOVED = 0.5
"""Movement of an eigenvalue, in units of the typical rate, that a change of one unit causes."""
_DECADES = 9
_HALVINGS = 6


def gain_units(problem: GainProblem, x: FloatArray) -> FloatArray:
    """Return the change of each gain that moves an eigenvalue by about the typical rate.

    The change is at most the width of the bounds. So bounds that are far too wide do not change where the search
    begins, or how long its first steps are. A gain that moves nothing by itself, as those in a product with a zero, is
    given the median of the others.

    Parameters
    ----------
    problem : GainProblem
        The design problem.
    x : (d,) array
        Gains from which the changes are counted.
    """
    width = problem.upper - problem.lower
    reach = np.full(len(x), np.nan)
    places = [eigenvalues(family.states(x)) for family in problem.families]
    if any(np.isnan(values).any() for values in places):
        return width
    for i in range(len(x)):
        sign = 1.0 if problem.upper[i] - x[i] >= x[i] - problem.lower[i] else -1.0
        room = float(max(problem.upper[i] - x[i], x[i] - problem.lower[i]))

        def moved(change: float, i: int = i, sign: float = sign) -> float:
            y = x.copy()
            y[i] += sign * change
            return max(
                _movement(values, eigenvalues(family.states(y)), problem.scale)
                for values, family in zip(places, problem.families, strict=True)
            )

        if problem.evaluations.over:
            break
        if moved(room) < _MOVED:
            reach[i] = width[i] if moved(room) > LEAST_REACH else np.nan
            continue
        low, high = np.log(room) - _DECADES * np.log(10), np.log(room)
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            low, high = (low, middle) if moved(float(np.exp(middle))) >= _MOVED else (middle, high)
        reach[i] = np.exp(high)
    known = reach[np.isfinite(reach)]
    reach = np.where(np.isfinite(reach), reach, np.median(known) if len(known) else np.inf)
    return np.asarray(np.minimum(reach, width))


def reach_of_bounds(problem: GainProblem) -> float:
    """Return the largest eigenvalue movement, in typical rates, by one gain from the middle of its range to a bound."""
    middle, reach = (problem.lower + problem.upper) / 2, 0.0
    for family in problem.families:
        before = eigenvalues(family.states(middle))
        for i, step in enumerate((problem.upper - problem.lower) / 2):
            after = eigenvalues(family.states(middle + step * np.eye(len(middle))[i]))
            reach = max(reach, _movement(before, after, problem.scale))
    return reach


LEAST_REACH = 1e-3 * _MOVED
"""Movement below which a gain has no effect."""


def _movement(before: ComplexArray, after: ComplexArray, scale: float) -> float:
    """Return the largest distance of a new eigenvalue from its nearest old eigenvalue; infinite if not finite."""
    if np.isnan(after).any():
        return np.inf
    distance = np.abs(after[:, :, None] - before[:, None, :]).min(axis=2)
    return float(distance.max()) / scale


@dataclass(frozen=True)
class GainSolution:
    """Best design of a problem, the problem with its final cuts, and the history of the search.

    Of a search also the different designs with which it ended.
    """

    problem: GainProblem
    best: LocalOptimum
    history: tuple[SearchStep, ...] = ()
    ends: tuple[LocalOptimum, ...] = ()

    @property
    def stable(self) -> bool:
        """Whether all loops are stable."""
        return self.problem.stable(self.best.x)

    @property
    def certified(self) -> bool:
        """Whether the best design is a certified local optimum."""
        return self.best.certificate is not None and self.best.certificate.holds

    @property
    def reached(self) -> float:
        """Value of a feasible design; NaN for an infeasible design."""
        return self.best.score.value if self.stable and self.best.score.violation <= FEASIBLE else np.nan

    @property
    def order(self) -> tuple[bool, bool, float]:
        """Ranking of the solutions of one problem: stability, limits, merit."""
        return self.stable, self.best.score.violation <= FEASIBLE, rank(self.best)

    def noted(self, stage: str, progress: Progress | None) -> GainSolution:
        """Return this solution with one more step in its history; the callback `progress` receives the step."""
        step = self.problem.step(stage, self.best.score)
        if progress is not None:
            progress(step)
        return replace(self, history=(*self.history, step))


def search(problem: GainProblem, task: SearchTask) -> GainSolution:
    """Return the best design within the bounds.

    The starts (the best points of a grid for up to three gains, else evenly spread ones, and those that are given) go
    through short local searches, the better two thirds of them once more, and the best few through full ones. The best
    of these is moved at random.
    """
    options, d = task.options, len(task.neutral)
    history: list[SearchStep] = []
    top = LocalOptimum(np.asarray(task.neutral), Score(-np.inf, np.inf), 0, False)

    def by_stability(design: LocalOptimum) -> tuple[bool, float]:
        return problem.stable(design.x), rank(design)

    def note(stage: str, design: LocalOptimum) -> None:
        nonlocal top
        top = best_of([top, design])
        history.append(problem.step(stage, top.score))
        if task.progress is not None:
            task.progress(history[-1])

    given = [np.clip(np.asarray(x, float), problem.lower, problem.upper) for x in (task.neutral, *task.first)]
    local = LocalSearch(problem, gain_units(problem, given[0]), options)
    gridded = on_grid(d, options)
    if gridded:
        starts = grid_starts(problem, given[0], local.unit, (NORM_GRID if local.norms else GRID)[d], options.nodes)
    else:
        by_default = (24 if d <= 12 else 12) if local.free else (16 if d <= 8 else 8)
        n_starts = by_default if options.starts is None else options.starts
        spread = _NEARBY if local.norms else (WIDE, 1.0)
        starts = random_starts(problem, given[0], local.unit, n_starts, options.seed, spread)
    many = not (gridded or local.free or local.norms) and len(given) + len(starts) > 2 * options.finalists
    designs: list[LocalOptimum] = []
    for i, start in enumerate((*given, *starts)):
        designs.append(LocalOptimum(start, problem.score(start), 0, False))
        note("global", designs[-1])
        # given designs count also where the budget is used up
        if problem.evaluations.exhausted and i + 1 >= len(given) and problem.stable(best_of(designs).x):
            break
    for i, design in enumerate(() if gridded else tuple(designs)):  # a grid shows already how good its nodes are
        if problem.evaluations.exhausted:
            break
        designs[i] = local.short(design.x, max(map(rank, designs[:i]), default=-np.inf))
        note("global", designs[i])
    designs.sort(key=by_stability, reverse=True)
    if many:
        better_ones, designs = designs[: -(-2 * len(designs) // 3)], []
        for one in better_ones:
            if not problem.evaluations.over:
                one = local.short(one.x, max(map(rank, designs), default=rank(one)), again=True)
            designs.append(one)
        designs.sort(key=by_stability, reverse=True)
        note("global", designs[0])
    finals: list[LocalOptimum] = []
    same = options.neighbours * (problem.upper - problem.lower)
    for design in designs:
        if (len(finals) == options.finalists and not gridded) or (finals and local.settled(finals)):
            break
        if any((np.abs(design.x - other.x) <= same).all() for other in finals):
            continue
        goal = max(map(rank, finals), default=-np.inf) if many else -np.inf  # of few, each may be a curved valley
        finals.append(design if problem.evaluations.exhausted else local.full(design.x, goal, tuple(finals)))
        note("local", best_of(finals))
    if d in GRID or local.settled(finals):
        ends = [best_of(finals)]
    else:
        rng = np.random.default_rng(options.seed)
        if options.sketch:
            few = replace(local, options=replace(options, hops=options.sketch_hops))
            ends = [hop_line(few, one, rng, note) for one in finals]
        else:
            ends = [hop(local, finals, rng, note)]
    # a design that keeps its limits is never lost
    best = best_of([*ends, top]) if top.score.violation <= FEASIBLE else best_of(ends)
    if not options.sketch and not problem.evaluations.exhausted:
        best = local.with_certificate(best)
        note("local", best)
    return GainSolution(problem, best, tuple(history), tuple(ends))
