"""Climbs to local optima, as many iterations as their stage is worth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush

import numpy as np

from gbid.control.tuning.certificate import certify
from gbid.control.tuning.local import LocalOptimum, ascend, optimise_locally
from gbid.control.tuning.loops import LoopFamily
from gbid.control.tuning.peaks import IntArray
from gbid.control.tuning.plane import eigenvalues, true_rates
from gbid.control.tuning.problem import GainProblem, Limits, Score, SearchStep, merit
from gbid.core.arrays import ComplexArray, FloatArray
from gbid.core.errors import UsageError

# ---- Order of designs: first by their limits, then by the objective.

PENALTY = 10.0
FEASIBLE = 1e-6
"""Largest relative violation of a limit that is tolerated."""


def better(one: Score, other: Score) -> bool:
    """Return whether a design is better than another: first by the limits, then by the objective."""
    kept = one.violation <= FEASIBLE, other.violation <= FEASIBLE
    if kept[0] != kept[1]:
        return kept[0]
    return one.value > other.value if kept[0] else one.violation < other.violation


def rank(found: LocalOptimum) -> float:
    """Return the merit of a design, objective minus a penalty on the largest violation."""
    return merit(found.score, PENALTY)


def best_of(found: list[LocalOptimum]) -> LocalOptimum:
    """Return the best of several designs."""
    best = found[0]
    for one in found[1:]:
        best = one if better(one.score, best.score) else best
    return best


GRID = {1: 61, 2: 25, 3: 9}
"""Number of grid points per gain, for up to three gains."""
_HOP_SIZES = (0.005, 0.01, 0.02, 0.05)
"""Sizes of random moves with limits on responses, as shares of the bounds; the way out of a basin may be a few %."""
_FINE_HOPS = (0.0015, 0.005, 0.015, 0.05)
"""The same on the way to a design for sampled loops, whose eigenvalues meet in narrower regions."""
_HOP_RADIUS, _FINE_RADIUS = 0.01, 0.02
"""Trust regions after random moves, and after those."""
_FREE_HOPS = (1e-3, 1e-2, 0.1, 0.5)
"""Sizes of random moves without limits on responses, in units or shares of the gains."""
_ROUGH = 30
"""Number of iterations from each start where more than eigenvalues counts; the better two thirds get as many again."""
LATER_RADIUS = 0.02
"""Trust region with which these go on, as a share of the bounds."""
_SMALL = 8
"""Largest number of gains for which twice as many starts with limits take about a second."""
_FEW = 6
"""Largest number of gains whose first climbs are not plain: they are cheap, and end in the lower basin less often."""
_NEXT = 1e-3
"""Distance from a bound, as a share of the bounds, of a gain that is next to it."""
_SHORT = (1e-3, 5e-3)
"""Trust regions of the short climbs from a design without a certificate."""
_BEHIND = 4e-3
"""By what share of its goal a climb may be behind for each iteration that is left to reach it."""
_RACED = 100
"""Largest number of iterations of a full optimisation in a race: one that creeps gets on faster by a random move."""


@dataclass(frozen=True, eq=False)
class Climber:
    """Local optimisation of a problem: steps over all active functions, and BFGS where nothing but damping counts.

    Limits make a ridge of every design on them, along which BFGS is slow. Without limits it is the faster one: its
    evaluations need one gradient only.

    Parameters
    ----------
    problem : GainProblem
        The design problem.
    unit : (d,) array
        Units of the gains.
    fine : bool
        Whether some random moves are shorter, as a design for a sampled loop needs them.
    """

    problem: GainProblem
    unit: FloatArray
    fine: bool = False
    _certified: dict[bytes, bool] = field(default_factory=dict, init=False, repr=False)

    @property
    def free(self) -> bool:
        """Whether only eigenvalues count."""
        limits = self.problem.limits
        return not (limits.has_responses or limits.measures or self.problem.linear)

    @property
    def starts(self) -> int:
        """Number of random starts."""
        if not self.free:
            return 8 if len(self.unit) > _SMALL else 16
        return 24 if len(self.unit) <= 12 else 12

    @property
    def hop_sizes(self) -> tuple[float, ...]:
        """Sizes of random moves."""
        if self.free:
            return _FREE_HOPS
        return _FINE_HOPS if self.fine else _HOP_SIZES

    def rough(self, start: FloatArray, goal: float, radius: float = 0.1) -> LocalOptimum:
        """Return a design near a start that is better, with few evaluations; fewer where the goal is out of reach."""
        if self.free:
            return self._ascent(start, 100 + 20 * len(start))
        plain = radius > LATER_RADIUS and len(start) > _FEW
        return optimise_locally(
            self.problem,
            start,
            radius=radius,
            max_iterations=_ROUGH,
            tolerance=1e-5,
            goal=goal,
            behind=self._behind,
            rough=plain,
            repair=False,
        )

    def full(self, start: FloatArray, goal: float | None = None) -> LocalOptimum:
        """Return a local optimum; with a goal, as in a race of many starts, only one that soon reaches it."""
        if goal is not None:
            return optimise_locally(self.problem, start, max_iterations=_RACED, goal=goal, behind=self._behind)
        if not self.free:
            return optimise_locally(self.problem, start, max_iterations=300)
        if len(start) in GRID:
            found = optimise_locally(self.problem, start, max_iterations=_RACED)
            if found.converged and self.certified(found):
                return found
        return optimise_locally(self.problem, self._ascent(start, 200 + 60 * len(start)).x, max_iterations=300)

    def hop(self, best: LocalOptimum, size: float, rng: np.random.Generator) -> LocalOptimum:
        """Return the local optimum after a random move of some size; less good where it will not be better."""
        x = best.x
        step = size * rng.standard_normal(len(x))
        if not self.free:
            moved = x + step * (self.problem.upper - self.problem.lower)
            radius, goal = _FINE_RADIUS if self.fine else _HOP_RADIUS, rank(best)
            return optimise_locally(self.problem, moved, max_iterations=60, radius=radius, goal=goal, behind=_BEHIND)
        found = self._ascent(x + step * np.maximum(self.unit, np.abs(x)), 100 + 40 * len(x))
        return optimise_locally(self.problem, found.x, max_iterations=20, radius=1e-3)

    def with_certificate(self, best: LocalOptimum) -> LocalOptimum:
        """Return a certified design by short climbs from a design without a certificate, or else the best one of them.

        A climb along a narrow ridge may creep and end early: others with other first steps do not. One of them begins
        with the gains at the bounds that they are next to.
        """
        low, high = self.problem.lower, self.problem.upper
        near = _NEXT * (high - low)
        at_bounds = np.where(best.x - low < near, low, np.where(high - best.x < near, high, best.x))
        for start in [best.x, at_bounds] if (at_bounds != best.x).any() else [best.x]:
            for radius in _SHORT:
                if self.certified(best) or self.problem.exhausted:
                    return best
                found = optimise_locally(self.problem, start, max_iterations=60, radius=radius)
                best = found if better(found.score, best.score) else best
        return best

    def certified(self, best: LocalOptimum) -> bool:
        """Return whether a design is optimal to first order."""
        key = best.x.tobytes()
        if key not in self._certified:  # to find no certificate takes a hundred times as long as to find one
            self._certified[key] = certify(self.problem, best.x, certificate_units(self.unit, best.x))[0].holds
        return self._certified[key]

    @property
    def _behind(self) -> float:
        """How far climbs from starts may be behind; without an end for few gains, whose starts are cheap."""
        return _BEHIND if len(self.unit) > _SMALL else np.inf

    @property
    def _left(self) -> int:
        return max((self.problem.most_evaluations or 0) - self.problem.evaluations, 1)

    def _ascent(self, start: FloatArray, most: int) -> LocalOptimum:
        problem = self.problem
        x = np.clip(start, problem.lower, problem.upper)
        found = ascend(
            lambda y: problem.merit_and_slope(y, PENALTY),
            x,
            problem.lower,
            problem.upper,
            self.unit,
            max_evaluations=most if problem.most_evaluations is None else min(most, self._left),
        )
        return LocalOptimum(found.x, problem.score(found.x), found.evaluations, True)


def certificate_units(unit: FloatArray, x: FloatArray) -> FloatArray:
    """Return the units of a certificate: a gain's own magnitude, or its unit where it is small."""
    return np.maximum(unit, np.abs(x))


# ---- Basin hopping: random moves of a design, each with a new local optimisation.

Note = Callable[[str, Score], None]
_HOPPED = 2
"""Number of different designs for basin hopping; the best one before it need not be the best one after it."""
_FIRST, _LATER = 12, 4
"""Number of random moves of each size with limits until the first improvement, and after an improvement."""
_PROGRESS = 3e-4
"""Relative gain of a random move below which it counts as in vain."""
_OTHER = 1e-3
"""Relative difference of values from which on designs count as different optima."""
_STALLED = 0.03
"""Relative gain by random moves from which on the first climbs are taken for stalled ones."""
_KNOWN = 3e-4
"""Relative difference of values of two lines of random moves that count as the same optimum."""
_SAME = 1e-4
"""Relative difference of values after random moves that count as the same optimum."""
_WIDE, _RETURNED = 3, 8
"""Number of random moves to the same optimum, the shortest moves not counted, from which on its basin counts as wide,
and after which no more moves are made."""


@dataclass(frozen=True)
class HoppedLine:
    """Best design of a line of random moves, how many longer moves came back to it, and the optima on the way."""

    best: LocalOptimum
    returned: int
    optima: tuple[Score, ...]


def hop_freely(
    climber: Climber, finals: list[LocalOptimum], rng: np.random.Generator, most: int, note: Note
) -> LocalOptimum:
    """Move the best different designs at random, then the best one that was found."""
    kinds = len(climber.hop_sizes)
    apart = _apart(finals, 0.1 * (climber.problem.upper - climber.problem.lower))[:_HOPPED]
    lines = [hop_basins(climber, start, rng, most, kinds, note).best for start in apart]
    return hop_basins(climber, best_of(lines), rng, most, 2 * kinds, note).best


def hop_with_limits(
    climber: Climber, finals: list[LocalOptimum], rng: np.random.Generator, most: int, note: Note
) -> LocalOptimum:
    """Move the best design at random, then other ones where the best one cannot be trusted.

    All others where it has no certificate, or where the moves made it much better: the first climbs had stalled, so
    their order says little. One other where the moves came back or led nowhere: a better one may lie far off.
    """
    kinds = len(climber.hop_sizes)
    start = best_of(finals)
    others = [one for one in finals if abs(one.score.value - start.score.value) > _OTHER * abs(start.score.value)]
    line = hop_basins(climber, start, rng, most, _LATER * kinds, note, first=_FIRST * kinds)
    known = line.optima
    best = climber.with_certificate(line.best)
    much_better = best.score.value - start.score.value > _STALLED * abs(start.score.value)
    stuck = line.returned >= _WIDE or _same(best.score, start.score, _OTHER)
    doubted = len(others) if much_better else int(stuck)
    for moved, other in enumerate(sorted(others, key=rank, reverse=True)):
        if climber.problem.exhausted or (moved >= doubted and climber.certified(best)):
            break
        line = hop_basins(climber, other, rng, most, 2 * kinds, note, known)
        known += line.optima
        if better(line.best.score, best.score):
            line = hop_basins(climber, line.best, rng, most, 3 * kinds, note, known)
            known += line.optima
            best = climber.with_certificate(line.best)
    return best


def hop_basins(
    climber: Climber,
    best: LocalOptimum,
    rng: np.random.Generator,
    most: int,
    in_vain: int,
    note: Note,
    known: tuple[Score, ...] = (),
    first: int = 0,
) -> HoppedLine:
    """Move a design at random and optimise again, until a number of moves in a row gave no improvement.

    Before any improvement `first` moves may be in vain, if that is more: where one move of five leads to a better
    design, ten in a row miss it once in ten times. With limits, fewer moves are enough when several of them come back
    to the same optimum, or when one leads to an optimum that is known from another line.
    """
    vain = returned = 0
    optima: list[Score] = []
    for i in range(most):
        enough = vain >= (in_vain if vain < i else max(first, in_vain))
        if enough or returned == _RETURNED or climber.problem.exhausted:
            break
        size = climber.hop_sizes[i % len(climber.hop_sizes)]
        again = climber.hop(best, size, rng)
        progress = again.score.value - best.score.value > _PROGRESS * abs(best.score.value)
        repaired = again.score.violation <= FEASIBLE < best.score.violation
        improved = better(again.score, best.score)
        vain = 0 if improved and (progress or repaired) else vain + 1
        counts = _same(again.score, best.score) and size > climber.hop_sizes[0] and not climber.free
        returned = returned + counts if vain else 0
        best = again if improved else best
        note("basin hopping", best.score)
        if improved and any(_same(best.score, one, _KNOWN) for one in known):
            break
        if improved:
            optima.append(best.score)
    return HoppedLine(best, returned, tuple(optima))


def _same(one: Score, other: Score, share: float = _SAME) -> bool:
    return one.violation <= FEASIBLE and abs(one.value - other.value) <= share * abs(other.value)


def _apart(found: list[LocalOptimum], distance: FloatArray) -> list[LocalOptimum]:
    """Return designs that differ by more than a distance in some gain, best first."""
    chosen: list[LocalOptimum] = []
    for one in sorted(found, key=rank, reverse=True):
        if all((np.abs(one.x - other.x) > distance).any() for other in chosen):
            chosen.append(one)
    return chosen


# ---- Random points that fill a box evenly.


def spread_points(n: int, d: int, seed: int) -> FloatArray:
    """Return n points (n, d) that fill the unit cube evenly, with a random shift.

    They are multiples of the square roots of primes (R. D. Richtmyer, "The evaluation of definite integrals, and a
    quasi-Monte-Carlo method based on the properties of algebraic numbers", Los Alamos report LA-1342, 1951). The
    package for such points in scipy takes a second to load.
    """
    primes = [k for k in range(2, 12 * (d + 1)) if all(k % i for i in range(2, int(k**0.5) + 1))]
    shift = np.random.default_rng(seed).random(d)
    return np.asarray((shift + np.arange(n)[:, None] * np.sqrt(primes[:d])) % 1.0)


# ---- Random start values of the search.

_SHARES = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)
WIDE = 8.0
"""Width of the bounds, in units of the gain, from which on a grid and random starts are denser near the middle."""


def random_starts(problem: GainProblem, neutral: FloatArray, unit: FloatArray, n: int, seed: int) -> list[FloatArray]:
    """Return random starts around the neutral gains, each moved or climbed to where its loops are stable.

    Their distances from the neutral gains lie between the units of the gains and the widths of the bounds, with a
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
    """
    d, low, high = len(neutral), problem.lower, problem.upper
    rows = spread_points(n, d + 1, seed)
    # with positive bounds over more than a decade, starts have a logarithmic distribution
    decades = (low > 0) & (high > 10 * low)
    first, last = np.where(decades, low, 1.0), np.where(decades, high, 1.0)
    starts = []
    for u, far in zip(rows[:, :d], rows[:, d], strict=True):
        x = np.where(decades, first * (last / first) ** u, low + u * (high - low))
        reach = np.where(decades, 1.0, np.minimum(WIDE * unit / (high - low), 1.0) ** (1.0 - far))
        x = neutral + reach * (x - neutral)
        for share in _SHARES:
            start = neutral + np.where(decades, 1.0, share) * (x - neutral)
            if problem.stable(start):
                break
        else:
            start = stabilised(problem, x, unit)
        starts.append(start)
    return starts


def stabilised(problem: GainProblem, x: FloatArray, unit: FloatArray) -> FloatArray:
    """Return gains whose loops are stable, by an ascent of the slowest decay; or where that ascent ends."""
    decay = GainProblem(problem.families, Limits("decay"), problem.lower, problem.upper, problem.scale)
    enough = 1.1 * problem.slowest / problem.scale + 1e-3
    found = ascend(
        lambda y: decay.merit_and_slope(y, 0.0),
        x,
        problem.lower,
        problem.upper,
        unit,
        max_evaluations=60 + 15 * len(x),
        enough=enough,
    )
    problem.evaluations += decay.evaluations
    return found.x


# ---- Start values on a grid, for few gains.

_PENALTY = 10.0
_BOUNDING = 4
"""Largest number of loops of a family in a bound: a few far apart give nearly the bound of all."""
_BEHIND_GAIN_GRID = 0.1
"""How far behind the best merit of the grid a bound may be for all loops to be computed."""


def grid_starts(problem: GainProblem, neutral: FloatArray, unit: FloatArray, n: int, most: int) -> list[FloatArray]:
    """Return the best points of a grid that are not neighbours, best first.

    They are more than the local maxima of the grid, because along a limit the grid would miss optima. The merit in one
    loop, without peaks, is an upper bound and cheap; the merit in some loops is a tighter one. All loops are computed
    only where both are high enough.
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
    while queue and -queue[0][0] > best - _BEHIND_GAIN_GRID:
        _, i, tight = heappop(queue)
        if tighter and not tight:
            heappush(queue, (-merit(problem.score(grid[i], best - _BEHIND_GAIN_GRID, some), _PENALTY), i, True))
            continue
        score = problem.score(grid[i], worst=best - _BEHIND_GAIN_GRID)
        if score.value > best - _BEHIND_GAIN_GRID:
            merits[i] = merit(score, _PENALTY)
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

    It is the worst one of some loops at the neutral gains.
    """
    value, slow = np.full(len(designs), np.inf), np.full(len(designs), -np.inf)
    for family, own in zip(problem.families, some, strict=True):
        T = family.sample_time
        aims = problem.aim(true_rates(eigenvalues(family.states(neutral)[own]), T), T)
        one = own[int(np.nan_to_num(aims).min(axis=1).argmin())]
        rates = true_rates(eigenvalues(np.stack([family.states(x)[one] for x in designs])), T)
        value = np.minimum(value, problem.aim(rates, T).min(axis=1))
        slow = np.maximum(slow, rates.real.max(axis=1))
    found = value - _PENALTY * np.maximum(0.0, (problem.slowest + slow) / problem.scale)
    return np.asarray(np.where(np.isnan(found), -np.inf, found))


def _axis(low: float, middle: float, high: float, unit: float, n: int) -> FloatArray:
    """Return n nodes over the bounds; between wide bounds they are denser near the middle."""
    if high - low <= WIDE * unit:
        return np.linspace(low, high, n)
    ends = np.arcsinh((low - middle) / unit), np.arcsinh((high - middle) / unit)
    nodes = middle + unit * np.sinh(np.linspace(*ends, n))
    nodes[0], nodes[-1] = low, high
    return np.asarray(nodes)


# ---- Gains from which a search can begin, and the typical rate of the loops there.

_TRIED = 64


def usable_start(
    families: Sequence[LoopFamily], given: Sequence[FloatArray], lower: FloatArray, upper: FloatArray, seed: int
) -> FloatArray:
    """Return the first of given gains, or else of random ones, for which all loops have finite eigenvalues.

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
    """Return the geometric mean of the magnitudes of the eigenvalues, which is the unit of rates.

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


# ---- Units of the gains: by how much each gain must change to move the eigenvalues of the loops.

_MOVED = 0.5
"""Movement of an eigenvalue, in units of the typical rate, that a change of one unit causes."""
_DECADES = 9
_HALVINGS = 6


def gain_units(problem: GainProblem, x: FloatArray) -> FloatArray:
    """Return the change of each gain that moves an eigenvalue by about the typical rate.

    It is at most the width of the bounds. So bounds that are far too wide do not change where the search begins, or how
    long its first steps are. A gain that moves nothing by itself, as those in a product with a zero, is given the
    median of the others.

    Parameters
    ----------
    problem : GainProblem
        The design problem.
    x : (d,) array
        Gains from which the changes are counted.
    """
    width = problem.upper - problem.lower
    found = np.full(len(x), np.nan)
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

        if moved(room) < _MOVED:
            found[i] = width[i] if moved(room) > 1e-3 * _MOVED else np.nan
            continue
        low, high = np.log(room) - _DECADES * np.log(10), np.log(room)
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            low, high = (low, middle) if moved(float(np.exp(middle))) >= _MOVED else (middle, high)
        found[i] = np.exp(high)
    known = found[np.isfinite(found)]
    found = np.where(np.isfinite(found), found, np.median(known) if len(known) else np.inf)
    return np.asarray(np.minimum(found, width))


def _movement(before: ComplexArray, after: ComplexArray, scale: float) -> float:
    """Return the largest distance of a new eigenvalue from the nearest old one; infinite when it is not finite."""
    if np.isnan(after).any():
        return np.inf
    distance = np.abs(after[:, :, None] - before[:, None, :]).min(axis=2)
    return float(distance.max()) / scale


# ---- Global search: choice of start values, and the best of the local optima.

Progress = Callable[[SearchStep], None]
_FINALISTS = 3
"""Number of the best designs that are then fully optimised."""
_SKETCHED = 6
"""Number of random moves of each of them in a search for other loops."""
_OTHER_RADII = (0.2, 0.02)
"""Trust regions of further climbs from the most promising design of other loops, as shares of the bounds."""
_SAME_GLOBAL_SEARCH = 1e-3
"""Distance of rough designs of few gains, as a share of the bounds, within which they belong to one optimum."""
_AGREE = 1e-5
"""Relative difference of local optima that count as one."""


@dataclass(frozen=True)
class Effort:
    """Computational effort of the search.

    Parameters
    ----------
    starts : int, optional
        Number of random starts. By default a grid for up to three gains; for more gains 24 for up to twelve, else
        12, but 8 where more than eigenvalues counts.
    seed : int
        Seed of the random starts.
    finalists : int
        Number of the best designs that are fully optimised.
    hops : int
        Largest number of basin hops of each of the best designs, with more than three gains. A hop is a random move
        and a new local optimisation. It is needed because a local optimisation may stop early where eigenvalues meet.
        Hopping ends after several hops without improvement.
    sketch : bool
        Whether the search, for more than three gains, ends with several different designs: each of the best after a few
        hops, as starts for other loops.
    """

    starts: int | None = None
    seed: int = 0
    finalists: int = 5
    hops: int = 48
    sketch: bool = False


@dataclass(frozen=True)
class SearchOutcome:
    """Best design of a search, its history, and the different designs with which it ended."""

    best: LocalOptimum
    history: tuple[SearchStep, ...]
    ends: tuple[LocalOptimum, ...]


def search(
    problem: GainProblem,
    neutral: FloatArray,
    effort: Effort,
    first: Iterable[FloatArray] = (),
    progress: Progress | None = None,
) -> SearchOutcome:
    """Return the best design within the bounds.

    Parameters
    ----------
    problem : GainProblem
        The design problem.
    neutral : (d,) array
        Gains near which the loops are probably stable. Random starts are moved towards it until they are stable.
    effort : Effort
        Computational effort.
    first : iterable of (d,) arrays
        Additional start values.
    progress : callable, optional
        Called with a `SearchStep` after each stage.

    Returns
    -------
    SearchOutcome

    Notes
    -----
    For up to three gains: a grid, whose best points that are not neighbours are optimised. For more gains: evenly
    spread points, with some steps of local optimisation from each start. Then the best designs are fully optimised.
    """
    history: list[SearchStep] = []

    top: list[Score] = []

    def note(stage: str, score: Score) -> None:
        if not top or better(score, top[0]):
            top[:] = [score]
        history.append(SearchStep(stage, problem.evaluations, problem.in_units(top[0].value), top[0].violation))
        if progress is not None:
            progress(history[-1])

    d = len(neutral)
    given = [np.clip(np.asarray(x, float), problem.lower, problem.upper) for x in (neutral, *first)]
    climber = Climber(problem, gain_units(problem, given[0]), fine=effort.sketch)
    rough: list[LocalOptimum] = []
    if d in GRID and effort.starts is None:
        for x in (*given, *grid_starts(problem, given[0], climber.unit, GRID[d], effort.finalists)):
            rough.append(optimise_locally(problem, x, max_iterations=10, tolerance=1e-4, rough=True, repair=False))
        note("global", best_of(rough).score)
    else:
        n = effort.starts if effort.starts is not None else climber.starts
        for start in (*given, *random_starts(problem, given[0], climber.unit, n, effort.seed)):
            rough.append(climber.rough(start, max(map(rank, rough), default=-np.inf)))
            note("global", best_of(rough).score)
            if problem.exhausted:
                break
    rough.sort(key=rank, reverse=True)
    raced = not climber.free and d not in GRID and len(rough) > _FINALISTS
    if raced:
        lead, further = rank(rough[0]), []
        for one in rough[: -(-2 * len(rough) // 3)]:
            further.append(climber.rough(one.x, lead, LATER_RADIUS))
            lead = lead if effort.sketch else max(lead, rank(further[-1]))
        note("global", best_of(further).score)
        rough = sorted(further, key=rank, reverse=True)[:_FINALISTS]
    finals: list[LocalOptimum] = []
    for start in rough[: effort.finalists]:
        same = (problem.upper - problem.lower) * (_SAME_GLOBAL_SEARCH if d in GRID else 1e-6)
        if any((np.abs(start.x - other.x) <= same).all() for other in finals):
            continue
        goal = max(map(rank, finals), default=-np.inf) if raced else None
        finals.append(start if problem.exhausted else climber.full(start.x, goal))
        note("local", best_of(finals).score)
        if d in GRID and _settled(climber, finals):
            break
    if d not in GRID and effort.sketch:
        rng = np.random.default_rng(effort.seed)
        if _settled(climber, finals):
            return SearchOutcome(best_of(finals), tuple(history), (best_of(finals),))
        best_ones = sorted(finals, key=rank, reverse=True)[:_FINALISTS]
        ends = [hop_basins(climber, one, rng, _SKETCHED, _SKETCHED, note).best for one in best_ones]
        return SearchOutcome(best_of(ends), tuple(history), tuple(ends))
    best = best_of(finals)
    if d not in GRID and effort.hops and not _settled(climber, finals):
        rng = np.random.default_rng(effort.seed)
        hop = hop_freely if climber.free else hop_with_limits
        best = hop(climber, finals, rng, effort.hops, note)
    if d in GRID and not climber.free and not problem.exhausted:
        # a climb along a flat limit may have stopped early; a fresh one with short steps costs little
        again = optimise_locally(problem, best.x, max_iterations=60, radius=1e-3)
        best = again if better(again.score, best.score) else best
    if not best.converged and not problem.exhausted:
        best = optimise_locally(problem, best.x, max_iterations=600, radius=0.005)
        note("local", best.score)
    return SearchOutcome(best, tuple(history), (best,))


def refine(
    problem: GainProblem, starts: Sequence[FloatArray], effort: Effort, progress: Progress | None = None
) -> SearchOutcome:
    """Return the best design near some that were found for other loops, such as those in continuous time.

    The best design of the other loops need not lie near the best one of these. So all of them are climbed. From the one
    that leads highest further climbs begin with longer and shorter steps, and the best end is moved at random: a local
    optimum of the other loops often lies beside the narrow region in which eigenvalues of these loops meet.
    """
    history: list[SearchStep] = []
    found: list[LocalOptimum] = []

    def note(stage: str, score: Score) -> None:
        history.append(SearchStep(stage, problem.evaluations, problem.in_units(score.value), score.violation))
        if progress is not None:
            progress(history[-1])

    climber = Climber(problem, gain_units(problem, starts[0]), fine=True)
    same = _SAME_GLOBAL_SEARCH * (problem.upper - problem.lower)
    apart = [x for i, x in enumerate(starts) if not any((np.abs(x - y) <= same).all() for y in starts[:i])]
    for x in apart:
        found.append(climber.full(x, None if climber.free else max(map(rank, found), default=-np.inf)))
        note("local", best_of(found).score)
    best = best_of(found)
    leader = next(x for x, one in zip(apart, found, strict=True) if one is best)
    for radius in () if climber.free else _OTHER_RADII:
        best = best_of([best, optimise_locally(problem, leader, max_iterations=100, radius=radius)])
        note("local", best.score)
    if effort.hops:
        rng = np.random.default_rng(effort.seed)
        best = hop_basins(climber, best, rng, effort.hops, 2 * len(climber.hop_sizes), note).best
        best = climber.with_certificate(best)
        note("local", best.score)
    if not best.converged and not climber.certified(best):
        best = optimise_locally(problem, best.x, max_iterations=600, radius=0.005)
        note("local", best.score)
    return SearchOutcome(best, tuple(history), (best,))


def _settled(climber: Climber, finals: list[LocalOptimum]) -> bool:
    """Return whether three of the best designs have the same value and the best one is certified."""
    best = best_of(finals)
    close = [
        one
        for one in finals
        if abs(one.score.value - best.score.value) <= _AGREE * abs(best.score.value) and one.score.violation <= FEASIBLE
    ]
    return len(close) > 2 and climber.certified(best)
