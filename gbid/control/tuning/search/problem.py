"""Design problem as smooth functions of the gains: the damping of each eigenvalue, each peak, and their derivatives.

The objective is the smallest of many functions of the gains, and each limit concerns the largest of many. Each function
is smooth where eigenvalues do not meet. A local method that uses all functions near the worst one can follow the edges
between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from gbid.arrays import BoolArray, ComplexArray, FloatArray
from gbid.control.loop.norm import largest_singular_values
from gbid.control.tuning.search.kernels.nearby_eigenvalues import NearbyEigenvalues
from gbid.control.tuning.search.limits import Limits
from gbid.control.tuning.search.loop_family import Derivatives, LoopFamily, Loops
from gbid.control.tuning.search.measure import LoopState
from gbid.control.tuning.search.nonsmooth.active import UNUSABLE, ActiveFunction, ActiveFunctions, Score, merit
from gbid.control.tuning.search.nonsmooth.cluster import Cluster
from gbid.control.tuning.search.nonsmooth.loop_subspaces import LoopSubspaces
from gbid.control.tuning.search.peaks import IntArray, Peaks, find_peaks, peak_slopes, respond
from gbid.control.tuning.search.plane import rate_slopes, true_rates
from gbid.control.tuning.search.spectrum import Eigensystem, damping_factors, damping_slopes, eigenvalues
from gbid.poles import REAL

_RESPONSES = ("sensitivity", "control", "static")
WINDOW = 0.3
"""Largest distance of an active function from the worst one (in damping, or in the logarithm of a limited gain)."""


@dataclass(eq=False)
class GainProblem:
    """Design problem: loops, limits and bounds. It evaluates designs and counts the evaluations.

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
    cuts : list
        Frequencies of peaks found by an exact norm, as (kind, family, loop, frequency).
    linear : tuple of (name, row, limit)
        Linear limits ``row x <= limit``.
    evaluations : int
        Number of designs evaluated so far.
    most_evaluations : int, optional
        Number of evaluations after which a search ends.
    """

    families: tuple[LoopFamily, ...]
    limits: Limits
    lower: FloatArray
    upper: FloatArray
    scale: float
    cuts: list[tuple[str, int, int, float]] = field(default_factory=list)
    linear: tuple[tuple[str, FloatArray, float], ...] = ()
    evaluations: int = 0
    most_evaluations: int | None = None

    @property
    def exhausted(self) -> bool:
        """Whether the allowed number of evaluations is used up."""
        return self.most_evaluations is not None and self.evaluations >= self.most_evaluations

    @property
    def slowest(self) -> float:
        """Rate that every eigenvalue must exceed [1/s]; slightly above zero, so that limit cases are stable."""
        return max(self.limits.slowest_pole, 1e-7 * self.scale)

    def score(self, x: FloatArray, worst: float = -np.inf, some: Sequence[IntArray] | None = None) -> Score:
        """Return the score of one design, without its peaks when its objective is below `worst`.

        By some loops of each family it is a bound, and counts for no evaluation.
        """
        self.evaluations += some is None
        value, violation = np.inf, 0.0
        every = [family.matrices(x) for family in self.families]
        if some is not None:
            every = [loops.of(own) for loops, own in zip(every, some, strict=True)]
        # eigenvectors with the eigenvalues take hardly longer than the eigenvalues alone
        systems = [Eigensystem.of(loops.A) for loops in every] if self.uses_responses else None
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
            violation = max(violation, _log_ratio(float(peaks.value.max(initial=0.0)), limit))
        for _, row, limit in self.linear:
            violation = max(violation, float(row @ x - limit))
        if self.limits.measures and some is None:
            assert systems is not None
            states = [self.state(*args) for args in zip(self.families, every, [x] * len(every), systems, strict=True)]
            violation = max([violation, *(float(e.excess(s).max()) for e in self.limits.extra for s in states)])
            value = min([value, *(-float(e.excess(s).max()) for e in self.limits.soft for s in states)])
        return Score(value, max(violation, 0.0)) if np.isfinite(violation + value) else UNUSABLE

    @property
    def uses_responses(self) -> bool:
        """Whether frequency responses, or other quantities besides the eigenvalues, are limited."""
        return self.limits.has_responses or bool(self.limits.measures)

    def state(self, family: LoopFamily, loops: Loops, x: FloatArray, system: Eigensystem | None = None) -> LoopState:
        """Return the loops of a family for given gains, as measures take them."""
        step = 1e-5 * (self.upper - self.lower)
        inwards = np.where(x + step > self.upper, -step, step)
        return LoopState(family, x, loops, Eigensystem.of(loops.A) if system is None else system, inwards)

    def stable(self, x: FloatArray) -> bool:
        """Return whether all loops are stable."""
        # NaN is not below zero
        return all(bool((eigenvalues(family.states(x)).real < 0).all()) for family in self.families)

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

    def functions(self, x: FloatArray, window: float = WINDOW) -> ActiveFunctions:
        """Return all functions within a window of the worst one at a design, with gradients.

        A window of zero leaves the worst one of the objective and the limits that do not hold.
        """
        self.evaluations += 1
        aims: list[ActiveFunction] = []
        limits: list[ActiveFunction] = []
        slopes_by = [family.derivatives(x) for family in self.families]
        systems = [Eigensystem.of(derivatives.A) for derivatives in slopes_by]
        unfit = self.uses_responses and not all(loops.finite for loops in slopes_by)
        if unfit or any(np.isnan(system.values).any() for system in systems):
            return ActiveFunctions(UNUSABLE, (), ())
        rates = [true_rates(s.values, family.sample_time) for s, family in zip(systems, self.families, strict=True)]
        values = [self.aim(r, family.sample_time) for r, family in zip(rates, self.families, strict=True)]
        states = [self.state(*args) for args in zip(self.families, slopes_by, [x] * len(systems), systems, strict=True)]
        softs = [(soft, f, state, soft.excess(state)) for soft in self.limits.soft for f, state in enumerate(states)]
        worst = min([*(float(v.min()) for v in values), *(-float(excess.max()) for *_, excess in softs)])
        for f, (derivatives, system, aim) in enumerate(zip(slopes_by, systems, values, strict=True)):
            upper = system.values.imag >= -REAL * np.abs(system.values)  # of conjugates one is enough
            top = self.limits.weight if self.limits.objective == "damping" else np.inf
            near = (aim <= worst + window) & upper & (aim < top)
            aims += self._of_eigenvalues("aim", f, system, derivatives, near)
            slow = (self.slowest + rates[f].real) / self.scale
            limits += self._of_eigenvalues("pole", f, system, derivatives, (slow > -window) & upper)
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
                found = zip(*extra.pieces(state, window), strict=True)
                limits += [ActiveFunction(extra.name, f, int(i), float(v), g, complex(p)) for i, v, g, p in found]
        for soft, f, state, _ in softs:
            found = zip(*soft.pieces(state, worst + window + 1e-12), strict=True)
            aims += [ActiveFunction(soft.name, f, int(i), -float(v), -g, complex(p)) for i, v, g, p in found]
        violation = max([0.0, *(piece.value for piece in limits)])
        if not np.isfinite(violation):
            return ActiveFunctions(UNUSABLE, (), ())
        sound = [[piece for piece in group if np.isfinite(piece.slope).all()] for group in (aims, limits)]
        return ActiveFunctions(Score(worst, violation), tuple(sound[0]), tuple(sound[1]), tuple(states))

    def merit_and_slope(self, x: FloatArray, penalty: float) -> tuple[float, FloatArray]:
        """Return objective minus a penalty on the largest violation, and the gradient of the worst functions."""
        found = self.functions(x, 0.0)
        slope = np.zeros_like(x)
        if not found.score.usable:
            return -np.inf, slope
        if found.aim:
            slope = slope + min(found.aim, key=lambda piece: piece.value).slope
        if found.score.violation > 0 and found.limits:
            slope = slope - penalty * max(found.limits, key=lambda piece: piece.value).slope
        return merit(found.score, penalty), slope

    def _of_eigenvalues(
        self, kind: str, f: int, system: Eigensystem, derivatives: Derivatives, chosen: BoolArray
    ) -> list[ActiveFunction]:
        loop, which = np.nonzero(chosen)
        values = system.values[loop, which]
        numbers, gradients = self._of_values(kind, f, values, system.slopes(loop, which, derivatives.dA))
        return [
            ActiveFunction(kind, f, int(i), float(number), gradient, complex(value))
            for i, number, gradient, value in zip(loop, numbers, gradients, values, strict=True)
        ]

    def _of_values(
        self, kind: str, f: int, values: ComplexArray, slopes: ComplexArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return objective or excess of the slowest pole for eigenvalues of a family (k,), and their gradients."""
        T, weight = self.families[f].sample_time, self.limits.weight
        rates, slopes = true_rates(values, T), slopes * rate_slopes(values, T)[:, None]
        if kind == "pole":
            return (self.slowest + rates.real) / self.scale, slopes.real / self.scale
        if self.limits.objective == "damping":
            return weight * damping_factors(rates, T), weight * damping_slopes(rates, slopes, T)
        return -weight * rates.real / self.scale, -weight * slopes.real / self.scale

    def mean_of(self, f: int, cluster: Cluster) -> tuple[float, FloatArray]:
        """Return the objective of the mean of a cluster of eigenvalues of a family, and its gradient."""
        numbers, gradients = self._of_values("aim", f, np.array([cluster.mean]), cluster.mean_slope[None])
        return float(numbers[0]), gradients[0]

    def subspaces(self, x: FloatArray, known: Sequence[LoopState] = ()) -> LoopSubspaces:
        """Return the invariant subspaces of all loops at a design."""
        return LoopSubspaces(self.families, x, 0.01 * self.scale, known)

    def slopes_at(self, functions: Sequence[ActiveFunction], designs: Sequence[FloatArray]) -> FloatArray:
        """Return the gradients of known functions at nearby designs (q, n, d), those of peaks at their old frequency.

        NaN where a gradient is not available: for two eigenvalues too close to each other, and for additional limits.
        """
        found = np.full((len(designs), len(functions), len(self.lower)), np.nan)
        for f, family in enumerate(self.families):
            own = [i for i, piece in enumerate(functions) if piece.family == f]
            if not own:
                continue
            used = np.unique([functions[i].loop for i in own])
            parts = [family.derivatives(x) for x in designs]
            if len(used) < len(family):
                parts = [part.of(used) for part in parts]
            loops = Derivatives.joined(parts)
            spectral = any(functions[i].kind in ("aim", "pole") for i in own)
            near = NearbyEigenvalues(loops, len(used)) if spectral else None
            for kind in {functions[i].kind for i in own}:
                same = [i for i in own if functions[i].kind == kind]
                # the loop of each piece in each design (n, q)
                first = np.searchsorted(used, [functions[i].loop for i in same])
                which = first[:, None] + len(used) * np.arange(len(designs))
                places = np.array([functions[i].place for i in same])
                found[:, same] = self._slopes_of(kind, places, f, loops, near, which).transpose(1, 0, 2)
        for i, piece in enumerate(functions):
            rows = [row for name, row, _ in self.linear if name == piece.kind]
            if rows:
                found[:, i] = rows[0]
        return found

    def _slopes_of(
        self,
        kind: str,
        places: ComplexArray,
        f: int,
        loops: Derivatives,
        near: NearbyEigenvalues | None,
        which: IntArray,
    ) -> FloatArray:
        """Return the gradients of n functions in the chosen loops (n, q, d), NaN where they are not available."""
        shape, flat = (*which.shape, len(self.lower)), which.ravel()
        if kind in _RESPONSES:
            peaks = Peaks(flat, np.repeat(places.imag, which.shape[1]), np.ones(len(flat)))
            by_gains, heights = peak_slopes(loops, rows_of(self.families[f], kind), peaks)
            return (by_gains / heights[:, None]).reshape(shape)
        if near is None or kind not in ("aim", "pole"):
            return np.full(shape, np.nan)
        values, slopes = near.slopes(which, places)
        return self._of_values(kind, f, values, slopes)[1].reshape(shape)

    def by_loop(self, family: LoopFamily, x: FloatArray) -> FloatArray:
        """Return measures of a design in each loop of a family, larger is worse (n, m).

        The first row is minus the objective. The others are the excess of the slowest pole and of each limited
        response over their limits. The family need not be one of the problem.
        """
        loops = family.matrices(x)
        system = Eigensystem.of(loops.A)
        rates = true_rates(system.values, family.sample_time)
        rows = [-self.aim(rates, family.sample_time).min(axis=1), (self.slowest + rates.real).max(axis=1) / self.scale]
        state = self.state(family, loops, x, system)
        rows[0] = np.max([rows[0], *(soft.excess(state) for soft in self.limits.soft)], axis=0)
        if self.limits.has_responses and family.n_outputs:
            for _, peaks, limit in self._peaks(family, loops, system, []):
                highest = np.zeros(len(family))
                np.maximum.at(highest, peaks.loop, peaks.value)
                rows.append(np.log(highest / limit))
        rows += [extra.excess(state) for extra in self.limits.extra]
        return np.array(rows)

    def _responses(
        self, every: Sequence[Loops], systems: Sequence[Eigensystem] | None = None, room: float = np.inf
    ) -> list[tuple[str, int, Peaks, float]]:
        """Return the peaks of all limited responses; those lower than their limit by `room`, as log, may be missing."""
        found: list[tuple[str, int, Peaks, float]] = []
        if not self.limits.has_responses:
            return found
        for f, (family, loops) in enumerate(zip(self.families, every, strict=True)):
            if family.n_outputs:
                system = Eigensystem.of(loops.A) if systems is None else systems[f]
                cuts = [cut for cut in self.cuts if cut[1] == f and len(loops.A) == len(family)]
                own = self._peaks(family, loops, system, cuts, room)
                found += [(kind, f, peaks, limit) for kind, peaks, limit in own]
        return found

    def _peaks(
        self,
        family: LoopFamily,
        loops: Loops,
        system: Eigensystem,
        cuts: list[tuple[str, int, int, float]],
        room: float = np.inf,
    ) -> list[tuple[str, Peaks, float]]:
        """Return the peaks of all limited responses of one family: kind, peaks, limit."""
        found = []
        for kind, limit in (("sensitivity", self.limits.peak_sensitivity), ("control", self.limits.peak_control)):
            if limit is not None:
                own = [cut for cut in cuts if cut[0] == kind]
                extra = (np.array([c[2] for c in own], int), np.array([c[3] for c in own])) if own else None
                peaks = find_peaks(loops, system, rows_of(family, kind), extra, least=limit * float(np.exp(-room)))
                found.append((kind, peaks, limit))
        if self.limits.static_amplification is not None:
            every, rest = np.arange(len(loops.A)), np.zeros((len(loops.A), 1))
            response = respond(loops, system, rows_of(family, "static"), every, rest)
            peaks = Peaks(every, rest[:, 0], largest_singular_values(response)[:, 0])
            found.append(("static", peaks, self.limits.static_amplification))
        return found


def _log_ratio(value: float, limit: float) -> float:
    """Return how far a gain exceeds its limit; infinite for a gain that is not finite."""
    return float(np.log(max(value, 1e-300) / limit)) if np.isfinite(value) else np.inf


def rows_of(family: LoopFamily, kind: str) -> slice:
    """Return the rows of the outputs that belong to a kind of response."""
    return slice(family.n_outputs, None) if kind == "control" else slice(0, family.n_outputs)
