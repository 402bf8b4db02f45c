"""Design problem as smooth functions of the gains: the damping of each eigenvalue, each peak, and their derivatives.

The objective is the smallest of many functions of the gains, and each limit concerns the largest of many. Each function
is smooth where eigenvalues do not coalesce. A local method that uses all functions near the worst one can follow the
edges between them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import inf
from time import monotonic
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np

from gbid.control.loop.norm import largest_singular_values
from gbid.control.tuning.design_options import Objective
from gbid.control.tuning.loops import Derivatives, LoopFamily, Loops
from gbid.control.tuning.peaks import HIGHEST, ModalResponse, Peaks, find_peaks, peak_curvature, peak_slopes
from gbid.control.tuning.plane import (
    Cluster,
    Eigensystem,
    InvariantSubspaces,
    damping_factors,
    damping_slopes,
    eigenvalues,
    rate_slopes,
    true_rates,
)
from gbid.core.arrays import REAL, BoolArray, ComplexArray, FloatArray, IntArray
from gbid.core.hdf5 import Stored
from gbid.core.option_types import Allowed, NotNegative, Positive, check_options


@dataclass(frozen=True, eq=False)
class LoopState:
    """Loops of a family for given gains.

    Attributes
    ----------
    family : LoopFamily
        The loops.
    gains : (d,) array
        The gains.
    loops : Loops or Derivatives
        Matrices; with their derivatives where these are known.
    steps : (d,) array
        Changes of each gain for differences, towards the inside of the bounds.
    known_system : Eigensystem, optional
        Eigenvalues and eigenvectors, where they are known.
    enough : float
        Excess of a measure beyond which a lower bound of it is as good as the excess.
    """

    family: LoopFamily
    gains: FloatArray
    loops: Loops
    steps: FloatArray
    known_system: Eigensystem | None = None
    enough: float = inf
    _subspaces: dict[int, InvariantSubspaces] = field(default_factory=dict, init=False, repr=False)
    computed: dict[Any, Any] = field(default_factory=dict, init=False, repr=False)
    """What measures have computed of these loops, by a key of theirs."""

    @cached_property
    def system(self) -> Eigensystem:
        """Eigenvalues and eigenvectors."""
        return self.known_system or Eigensystem.of(self.loops.A)

    @cached_property
    def derivatives(self) -> Derivatives:
        """Matrices with their derivatives."""
        return self.loops if isinstance(self.loops, Derivatives) else self.family.derivatives(self.gains)

    def cluster(self, loop: int, place: complex, size: int, least_rate: float) -> Cluster | None:
        """Return the cluster of a loop's eigenvalues nearest to a complex number; None if they are not separate.

        The Schur form of each loop is computed once. The unit of distances is the magnitude of the place, and no less
        than `least_rate` [rad/s].
        """
        if loop not in self._subspaces:
            self._subspaces[loop] = InvariantSubspaces(self.derivatives, loop)
        return self._subspaces[loop].cluster(place, size, max(abs(place), least_rate))


class Pieces(NamedTuple):
    """Smooth pieces of a measure: loop (k,), excess (k,), gradient (k, d), position in the complex plane (k,)."""

    loop: IntArray
    excess: FloatArray
    slope: FloatArray
    place: ComplexArray


class Measure(ABC):
    """Quantity of each loop for a goal: its excess is at most 0 within the limit, and positive beyond."""

    name: str
    stable_only: ClassVar[bool] = False
    """Whether it has a meaning for stable loops only; as an objective it is then `_UNSTABLE` for others."""

    @abstractmethod
    def excess(self, state: LoopState) -> FloatArray:
        """Return the excess of each loop (m,)."""

    @abstractmethod
    def pieces(self, state: LoopState, window: float) -> Pieces:
        """Return the smooth pieces whose excess is above ``-window``, with gradients."""

    def curvature(self, state: LoopState, loop: IntArray, place: ComplexArray) -> FloatArray:
        """Return second derivatives (k, d, d) of pieces with given loops and places; 0 where they are not known."""
        return np.zeros((*np.broadcast_shapes(loop.shape, place.shape), len(state.gains), len(state.gains)))


@dataclass(frozen=True)
class ExtraLimit(Measure):
    """Measure ``log(function(family, gains) / limit)`` of every loop, with gradients by differences.

    Parameters
    ----------
    name : str
        Name of the limit.
    function : callable
        From a family of m loops and gains (d,) to positive numbers (m,).
    limit : float
        Largest allowed number.
    """

    name: str
    function: Callable[[LoopFamily, FloatArray], FloatArray]
    limit: float

    def excess(self, state: LoopState) -> FloatArray:
        """Return the logarithm of each loop's value over the limit (m,)."""
        return self._of(state.family, state.gains)

    def pieces(self, state: LoopState, window: float) -> Pieces:
        """Return one piece for each loop near the limit."""
        base = self.excess(state)
        near = np.flatnonzero(base > -window)
        slope = np.zeros((len(base), len(state.gains)))
        for i, step in enumerate(state.steps if len(near) else ()):
            moved = state.gains.copy()
            moved[i] += step
            slope[:, i] = (self._of(state.family, moved) - base) / step
        return Pieces(near, base[near], slope[near], np.zeros(len(near), complex))

    def _of(self, family: LoopFamily, gains: FloatArray) -> FloatArray:
        return np.asarray(np.log(self.function(family, gains) / self.limit))


@dataclass(frozen=True)
class Limits:
    """Objective and limits of a design; None means no limit.

    Parameters
    ----------
    objective : {"damping", "decay"}
        Smallest damping factor of the oscillatory modes, or slowest decay ``-Re`` [1/s] of all modes.
    slowest_pole : float
        Smallest allowed decay rate of every eigenvalue [1/s]; 0 (strictly) requires stability only.
    peak_sensitivity, peak_control, static_amplification : float, optional
        Limits on the peaks of S_o and K S_o, and on the gain of S_o at zero frequency.
    extra : tuple of Measure
        Additional limits: the excess of each must be at most 0.
    soft : tuple of Measure
        Additional objectives. The search maximises the smallest of the objective and of minus their excesses.
    weight : float
        Factor on the objective of the eigenvalues beside the additional objectives; 0 leaves it out.
    """

    objective: Objective = "damping"
    slowest_pole: Annotated[NotNegative, Allowed("a rate of at least 0 in 1/s")] = 0.0
    peak_sensitivity: Positive | None = None
    peak_control: Positive | None = None
    static_amplification: Positive | None = None
    extra: tuple[Measure, ...] = ()
    soft: tuple[Measure, ...] = ()
    weight: float = 1.0

    def __post_init__(self) -> None:
        check_options(self)

    @property
    def measures(self) -> tuple[Measure, ...]:
        """Measures that are limits or objectives in addition to the fields."""
        return (*self.extra, *self.soft)

    @property
    def has_responses(self) -> bool:
        """Whether a frequency response is limited."""
        return not self.peak_sensitivity is self.peak_control is self.static_amplification is None


@dataclass(frozen=True)
class Score:
    """Quality of a design: the objective, and the largest relative violation of a limit (0 when all limits hold)."""

    value: float
    violation: float

    @property
    def usable(self) -> bool:
        """Whether the loops have finite matrices and eigenvalues at this design."""
        return bool(np.isfinite(self.value) and np.isfinite(self.violation))


UNUSABLE = Score(-np.inf, np.inf)
"""Score where a matrix or response of a loop is not finite: worse than any other."""


@dataclass(frozen=True)
class ActiveFunction:
    """Active function of a design: name (kind, family, loop), value, gradient, position in the complex plane.

    For ``"cluster"`` it is the objective of the mean of `size` eigenvalues.
    """

    kind: str
    family: int
    loop: int
    value: float
    slope: FloatArray
    place: complex
    size: int = 1


@dataclass(frozen=True)
class ActiveFunctions:
    """Active functions of the objective (maximised) and of the limits (at most 0) at one design, with its loops."""

    score: Score
    aim: tuple[ActiveFunction, ...]
    limits: tuple[ActiveFunction, ...]
    states: tuple[LoopState, ...] = ()


FEASIBLE = 1e-6
"""Largest relative violation of a limit that is tolerated."""
STABLE = 1e-8
"""Slowest decay of a stable loop in typical rates: poles at zero are computed with an error below it."""
PENALTY = 10.0
"""Weight of the largest violation of a limit beside the objective."""


def merit(score: Score, penalty: float = PENALTY) -> float:
    """Return the merit that the search maximises: objective minus a penalty on the largest violation."""
    return score.value - penalty * score.violation if score.usable else -np.inf


_UNSTABLE = 300.0
"""Excess of an objective that has no value because a loop is unstable."""
_EIGENVALUES, _RESPONSES = ("aim", "pole"), ("sensitivity", "control", "static")
DIFFERENCE = 1e-6
"""Step of differences of gradients, as a share of the bounds."""
WINDOW = 0.3
"""Largest distance of an active function from the worst one (in damping, or in the logarithm of a limited gain)."""


class Cut(NamedTuple):
    """Frequency [rad/s] of a peak between the grid frequencies, located by an exact norm."""

    kind: str
    family: int
    loop: int
    frequency: float


@dataclass(eq=False)
class Evaluations:
    """Number of designs evaluated so far, and the number and time at which the search ends (None: no limit).

    The times are those of `time.monotonic`: that of the search, and that of the checks of its design.
    """

    count: int = 0
    most: int | None = None
    until: float = inf
    last: float = inf

    @classmethod
    def of(cls, most: int | None, seconds: float | None) -> Evaluations:
        """Return a new budget; a fifth of the time, and at least the rest of one second, is reserved for checks."""
        now, time = monotonic(), seconds or inf
        return cls(0, most, now + 0.8 * time, now + max(time, 1.0))

    def of_checks(self, most: int | None = None) -> Evaluations:
        """Return the budget for the checks of a design."""
        return Evaluations(self.count, self.most if most is None else self.count + most, self.last, self.last)

    @property
    def over(self) -> bool:
        """Whether the time of the search has passed."""
        return self.until < inf and monotonic() >= self.until

    @property
    def late(self) -> bool:
        """Whether the time reserved for the checks has passed."""
        return self.last < inf and monotonic() >= self.last

    def half(self) -> Evaluations:
        """Return a budget with half of the remaining effort."""
        most = None if self.most is None else (self.count + self.most) // 2
        return Evaluations(self.count, most, (monotonic() + self.until) / 2)

    @property
    def exhausted(self) -> bool:
        """Whether the budget is used up."""
        return (self.most is not None and self.count >= self.most) or self.over


@dataclass(frozen=True, eq=False)
class GainProblem:
    """Design problem: loops, limits and bounds. Copies made by `replace` count evaluations in common.

    Parameters
    ----------
    families : tuple of LoopFamily
        Loops of the design.
    limits : Limits
        Objective and limits.
    lower, upper : (d,) array
        Bounds of the gains.
    scale : float
        Typical magnitude of an eigenvalue [rad/s], the unit of rates.
    linear : tuple of (name, row, limit)
        Linear limits ``row x <= limit``.
    cuts : tuple of Cut
        Peaks between the frequencies of the grid.
    evaluations : Evaluations
        State of the search: it counts the designs.
    """

    families: tuple[LoopFamily, ...]
    limits: Limits
    lower: FloatArray
    upper: FloatArray
    scale: float
    linear: tuple[tuple[str, FloatArray, float], ...] = ()
    cuts: tuple[Cut, ...] = ()
    evaluations: Evaluations = field(default_factory=Evaluations)
    _recent: dict[bytes, list[LoopState]] = field(default_factory=dict, init=False, repr=False)
    """Loops of the last design with a score, whose peaks its gradients need, too."""

    @property
    def slowest(self) -> float:
        """Decay rate that every eigenvalue must exceed [1/s], so that a tolerated violation leaves a stable loop."""
        return max(self.limits.slowest_pole, (STABLE + FEASIBLE) * self.scale)

    def score(self, x: FloatArray, worst: float = -np.inf, some: Sequence[IntArray] | None = None) -> Score:
        """Return the score of one design; peaks are skipped if its objective is below `worst`.

        By some loops of each family it is a bound, and counts for no evaluation.
        """
        self.evaluations.count += some is None
        value, violation = np.inf, 0.0
        every = [family.matrices(x) for family in self.families]
        if some is not None:
            every = [loops.of(own) for loops, own in zip(every, some, strict=True)]
        # eigenvectors with the eigenvalues take hardly longer than the eigenvalues alone
        systems = [Eigensystem.of(loops.A) for loops in every] if self.uses_responses else []
        for f, (family, loops) in enumerate(zip(self.families, every, strict=True)):
            values = true_rates(systems[f].values if systems else eigenvalues(loops.A), family.sample_time)
            if np.isnan(values).any():
                return UNUSABLE
            value = min(value, float(self.aim(values, family.sample_time).min()))
            violation = max(violation, float((self.slowest + values.real).max()) / self.scale)
        if value < worst:
            return Score(value, max(violation, 0.0))
        if self.uses_responses and not all(loops.finite for loops in every):
            return UNUSABLE
        for _, _, peaks, limit in self._responses(every, systems, room=0.0):
            highest = float(peaks.value.max(initial=0.0))
            violation = max(violation, float(np.log(max(highest, 1e-300) / limit)) if np.isfinite(highest) else np.inf)
        for _, row, limit in self.linear:
            violation = max(violation, float(row @ x - limit))
        if self.limits.measures and some is None:
            states = [self.state(*args) for args in zip(self.families, every, [x] * len(every), systems, strict=True)]
            if not self.limits.extra:
                states = [replace(state, enough=-worst) for state in states]
            violation = max([violation, *(float(e.excess(s).max()) for e in self.limits.extra for s in states)])
            value = min([value, *(-float(self._objective(e, s).max()) for e in self.limits.soft for s in states)])
            if value >= worst:  # else some peaks are lower bounds
                self._recent.clear()
                self._recent[x.tobytes()] = states
        return Score(value, max(violation, 0.0)) if np.isfinite(violation + value) else UNUSABLE

    @property
    def uses_responses(self) -> bool:
        """Whether the design limits frequency responses or other quantities besides eigenvalues."""
        return self.limits.has_responses or bool(self.limits.measures)

    def state(self, family: LoopFamily, loops: Loops, x: FloatArray, system: Eigensystem | None = None) -> LoopState:
        """Return the loops of a family for given gains, in the form that measures take."""
        step = 1e-5 * (self.upper - self.lower)
        inwards = np.where(x + step > self.upper, -step, step)
        return LoopState(family, x, loops, inwards, system)

    def states(self, x: FloatArray) -> list[LoopState]:
        """Return the loops of all families for given gains, with derivatives."""
        recent = self._recent.get(x.tobytes())
        return recent or [self.state(family, family.derivatives(x), x) for family in self.families]

    @property
    def edge(self) -> float:
        """Growth rate above which a pole counts as unstable [1/s].

        Half of the tolerance is for rounding: a design at the limit is computed again by another method.
        """
        return -(STABLE / 2) * self.scale

    def growth(self, x: FloatArray) -> float:
        """Return the largest growth rate over the poles of all loops [1/s]; infinite if a pole is not finite."""
        rates = [true_rates(eigenvalues(family.states(x)), family.sample_time).real for family in self.families]
        return max(float(np.where(np.isfinite(rate), rate, np.inf).max()) for rate in rates)

    def stable(self, x: FloatArray) -> bool:
        """Return whether all loops are stable."""
        return self.growth(x) < self.edge

    def aim(self, rates: ComplexArray, sample_time: float | None = None) -> FloatArray:
        """Return the objective of each mode from its rate: damping factor, or decay in units of the scale."""
        if not self.limits.weight:
            return np.full(rates.shape, np.inf)
        if self.limits.objective == "damping":
            return self.limits.weight * damping_factors(rates, sample_time)
        return -self.limits.weight * rates.real / self.scale

    def in_units(self, aim: float) -> float:
        """Return the objective in reported units: damping factor, or decay [1/s]."""
        unit = 1.0 if self.limits.objective == "damping" or not self.limits.weight else self.scale
        return aim * unit / (self.limits.weight or 1.0)

    def step(self, stage: str, score: Score) -> SearchStep:
        """Return the progress of a search after one stage."""
        return SearchStep(stage, self.evaluations.count, self.in_units(score.value), score.violation)

    def functions(self, x: FloatArray, window: float = WINDOW) -> ActiveFunctions:
        """Return all functions within a window of the worst function at a design, with gradients.

        A window of zero leaves the worst one of the objective and the limits that do not hold.
        """
        self.evaluations.count += 1
        aims: list[ActiveFunction] = []
        limits: list[ActiveFunction] = []
        states = self.states(x)
        slopes_by, systems = [state.derivatives for state in states], [state.system for state in states]
        unfit = self.uses_responses and not all(loops.finite for loops in slopes_by)
        if unfit or any(np.isnan(system.values).any() for system in systems):
            return ActiveFunctions(UNUSABLE, (), ())
        rates = [true_rates(s.values, family.sample_time) for s, family in zip(systems, self.families, strict=True)]
        values = [self.aim(r, family.sample_time) for r, family in zip(rates, self.families, strict=True)]
        pairs = [(soft, f, state) for soft in self.limits.soft for f, state in enumerate(states)]
        softs = [(soft, f, state, self._objective(soft, state)) for soft, f, state in pairs]
        worst = min([*(float(v.min()) for v in values), *(-float(excess.max()) for *_, excess in softs)])
        for f, (derivatives, system, aim) in enumerate(zip(slopes_by, systems, values, strict=True)):
            upper = system.values.imag >= -REAL * np.abs(system.values)  # of conjugates one is enough
            top = self.limits.weight if self.limits.objective == "damping" else np.inf
            near = (aim <= worst + window) & (aim < top)
            slow = (self.slowest + rates[f].real) / self.scale > -window
            loop, which = np.nonzero((near | slow) & upper)
            eigen = loop, system.values[loop, which], system.slopes(loop, which, derivatives)
            aims += self._of_eigenvalues("aim", f, *eigen, near[loop, which])
            limits += self._of_eigenvalues("pole", f, *eigen, slow[loop, which])
        for kind, f, peaks, limit in self._responses(slopes_by, systems, window):
            keep = np.flatnonzero(peaks.value > limit * np.exp(-window))
            chosen = Peaks(peaks.loop[keep], peaks.frequency[keep], peaks.value[keep])
            slopes, _ = peak_slopes(slopes_by[f], rows_of(self.families[f], kind), chosen)
            for loop, w, value, slope in zip(chosen.loop, chosen.frequency, chosen.value, slopes, strict=True):
                limits.append(
                    ActiveFunction(kind, f, int(loop), float(np.log(value / limit)), slope / value, complex(0, w))
                )
        for name, row, limit in self.linear:
            if (excess := float(row @ x - limit)) > -window:
                limits.append(ActiveFunction(name, 0, 0, excess, row, 0j))
        for extra in self.limits.extra:
            for f, state in enumerate(states):
                pieces = zip(*extra.pieces(state, window), strict=True)
                limits += [ActiveFunction(extra.name, f, int(i), float(v), g, complex(p)) for i, v, g, p in pieces]
        for soft, f, state, by_loop in softs:
            if by_loop.max() == _UNSTABLE:
                continue
            pieces = zip(*soft.pieces(state, worst + window + 1e-12), strict=True)
            aims += [ActiveFunction(soft.name, f, int(i), -float(v), -g, complex(p)) for i, v, g, p in pieces]
        violation = max([0.0, *(piece.value for piece in limits)])
        if not np.isfinite(violation):
            return ActiveFunctions(UNUSABLE, (), ())
        sound = [[piece for piece in group if np.isfinite(piece.slope).all()] for group in (aims, limits)]
        return ActiveFunctions(Score(worst, violation), tuple(sound[0]), tuple(sound[1]), tuple(states))

    def _objective(self, soft: Measure, state: LoopState) -> FloatArray:
        """Return the excess of a soft measure of each loop."""
        if soft.stable_only and not (true_rates(state.system.values, state.family.sample_time).real < self.edge).all():
            return np.full(len(state.family), _UNSTABLE)
        return soft.excess(state)

    def _of_eigenvalues(
        self, kind: str, f: int, loop: IntArray, values: ComplexArray, slopes: ComplexArray, chosen: BoolArray
    ) -> list[ActiveFunction]:
        loop, values = loop[chosen], values[chosen]
        numbers, gradients = self._of_values(kind, f, values, slopes[chosen])
        return [
            ActiveFunction(kind, f, int(i), float(number), gradient, complex(value))
            for i, number, gradient, value in zip(loop, numbers, gradients, values, strict=True)
        ]

    def _of_values(
        self, kind: str, f: int, values: ComplexArray, slopes: ComplexArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the objective, or the excess of the slowest pole, of eigenvalues of a family (k,), with gradients."""
        T, weight = self.families[f].sample_time, self.limits.weight
        rates, slopes = true_rates(values, T), slopes * rate_slopes(values, T)[:, None]
        if kind == "pole":
            return (self.slowest + rates.real) / self.scale, slopes.real / self.scale
        if self.limits.objective == "damping":
            return weight * damping_factors(rates, T), weight * damping_slopes(rates, slopes, T)
        return -weight * rates.real / self.scale, -weight * slopes.real / self.scale

    def mean_of(self, f: int, cluster: Cluster) -> tuple[float, FloatArray]:
        """Return the objective at the mean of a cluster of eigenvalues, and its gradient."""
        numbers, gradients = self._of_values("aim", f, np.array([cluster.mean]), cluster.mean_slope[None])
        return float(numbers[0]), gradients[0]

    def cluster(self, states: Sequence[LoopState], family: int, loop: int, place: complex, size: int) -> Cluster | None:
        """Return the eigenvalues of a loop nearest to a point of the complex plane; see `LoopState.cluster`."""
        return states[family].cluster(loop, place, size, 0.01 * self.scale)

    def curvature(
        self, x: FloatArray, states: Sequence[LoopState], weighted: Sequence[tuple[ActiveFunction, float]]
    ) -> FloatArray:
        """Return the second derivative (d, d) of a weighted sum of functions that were active at a nearby design.

        Derivatives of peaks are taken at the old frequency. Other limits, means of clusters (which need a Schur form
        for each gain), and functions without a second derivative are left out.

        Parameters
        ----------
        x : (d,) array
            The design.
        states : sequence of LoopState
            Its loops.
        weighted : sequence of (ActiveFunction, float)
            Functions with their weights.
        """
        step = DIFFERENCE * (self.upper - self.lower)
        step = np.where(x + step > self.upper, -step, step)
        total = np.zeros((len(x), len(x)))
        for f, state in enumerate(states):
            for measure in self.limits.measures:
                same = [(q, weight) for q, weight in weighted if (q.family, q.kind) == (f, measure.name)]
                if same:
                    loops, places = (np.array([getattr(q, name) for q, _ in same]) for name in ("loop", "place"))
                    total += _weighted(measure.curvature(state, loops, places), same)
            kinds = (*_EIGENVALUES, *_RESPONSES)
            known = [(piece, weight) for piece, weight in weighted if piece.family == f and piece.kind in kinds]
            if not known:
                continue
            bend = state.family.bend(x, step)
            for kind in kinds:
                same = [(piece, weight) for piece, weight in known if piece.kind == kind]
                if not same:
                    continue
                loops, places = (np.array([getattr(q, name) for q, _ in same]) for name in ("loop", "place"))
                if kind in _RESPONSES:
                    rows = rows_of(state.family, kind)
                    second = peak_curvature(state.derivatives, rows, loops, places.imag, bend)
                else:
                    nearest = np.abs(state.system.values[loops] - places[:, None]).argmin(axis=1)
                    values, first, change = state.system.curvature(loops, nearest, state.derivatives, bend)
                    moved = (values[:, None] + step * first).ravel(), first[:, None] + step[:, None] * change
                    here = self._of_values(kind, f, values, first)[1][:, None]
                    near = self._of_values(kind, f, moved[0], moved[1].reshape(-1, len(x)))[1]
                    second = (near.reshape(change.shape) - here) / step[:, None]
                total += _weighted(second, same)
        return total

    def by_loop(self, family: LoopFamily, x: FloatArray) -> FloatArray:
        """Return objective and excesses of a design for each loop of a family (n, m); larger is worse.

        The first row is minus the objective. The others are the excess of the slowest pole and of each limited
        response over their limits. The family need not be one of the problem.
        """
        loops = family.matrices(x)
        system = Eigensystem.of(loops.A)
        rates = true_rates(system.values, family.sample_time)
        rows = [-self.aim(rates, family.sample_time).min(axis=1), (self.slowest + rates.real).max(axis=1) / self.scale]
        state = self.state(family, loops, x, system)
        rows[0] = np.max([rows[0], *(soft.excess(state) for soft in self.limits.soft)], axis=0)
        for _, _, peaks, limit in replace(self, families=(family,), cuts=())._responses([loops], [system]):
            highest = np.zeros(len(family))
            np.maximum.at(highest, peaks.loop, peaks.value)
            rows.append(np.log(highest / limit))
        rows += [extra.excess(state) for extra in self.limits.extra]
        return np.array(rows)

    def _responses(
        self, every: Sequence[Loops], systems: Sequence[Eigensystem], room: float = np.inf
    ) -> list[tuple[str, int, Peaks, float]]:
        """Return the peaks of all limited responses: kind, family, peaks, limit.

        Peaks below their limit by more than `room` (as a logarithm) may be missing.
        """
        limits, limited = self.limits, []
        for f, (family, loops) in enumerate(zip(self.families, every, strict=True)):
            if not (limits.has_responses and family.n_outputs):
                continue
            for kind, limit in (("sensitivity", limits.peak_sensitivity), ("control", limits.peak_control)):
                if limit is None:
                    continue
                cuts = [c for c in self.cuts if (c.family, c.kind) == (f, kind) and len(loops.A) == len(family)]
                extra = (np.array([c.loop for c in cuts]), np.array([c.frequency for c in cuts])) if cuts else None
                least = limit * float(np.exp(-room))
                peaks = find_peaks(loops, systems[f], rows_of(family, kind), extra, least=least)
                limited.append((kind, f, peaks, limit))
            if (limit := limits.static_amplification) is not None:
                rest = np.zeros((len(loops.A), 1))
                response = ModalResponse(loops, systems[f], rows_of(family, "static"))(rest)
                heights = np.minimum(largest_singular_values(response)[:, 0], HIGHEST)
                limited.append(("static", f, Peaks(np.arange(len(rest)), rest[:, 0], heights), limit))
        return limited


def _weighted(second: FloatArray, weighted: Sequence[tuple[ActiveFunction, float]]) -> FloatArray:
    """Return the weighted sum of the finite ones of second derivatives (k, d, d)."""
    sound = np.isfinite(second).all(axis=(1, 2))
    return np.asarray(np.einsum("n,nqd->qd", np.array([weight for _, weight in weighted])[sound], second[sound]))


def rows_of(family: LoopFamily, kind: str) -> slice:
    """Return the rows of the loop outputs for one kind of response."""
    return slice(family.n_outputs, None) if kind == "control" else slice(0, family.n_outputs)


@dataclass(frozen=True)
class SearchStep:
    """Progress of a search after one stage.

    Attributes
    ----------
    stage : str
        ``"global"``, ``"local"``, ``"basin hopping"``, ``"cut"`` (a limit is kept between grid frequencies, too),
        ``"certificate"`` (the design was certified or improved) or ``"points"`` (worst points were added).
    count : int
        Number of designs evaluated so far.
    value : float
        Best objective so far, damping factor or decay rate [1/s].
    violation : float
        Largest relative violation of a limit by this design; 0 when all limits hold.
    """

    stage: str
    count: Annotated[int, Stored("1", "designs evaluated so far")]
    value: Annotated[float, Stored("", "best aim so far, damping factor or decay rate [1/s]")]
    violation: Annotated[float, Stored("1", "by how much its worst limit is exceeded")]
