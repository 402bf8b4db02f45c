"""Choice of the eigenvalues that may meet at a better design, and return to a point where they do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbid.arrays import ComplexArray, FloatArray
from gbid.control.tuning.search.nonsmooth.active import ActiveFunction, ActiveFunctions
from gbid.control.tuning.search.nonsmooth.cluster import Cluster, near_sums
from gbid.control.tuning.search.plane import true_rates
from gbid.control.tuning.search.problem import GainProblem

_NEAR = 0.5
"""Largest distance of a member from the centre, as a share of the centre's magnitude."""
_APART = 1.3
"""By how much the nearest eigenvalue outside is farther from the centre than the farthest inside."""
_WINDOW = 0.1
"""Largest distance of the objective of a member from the worst one."""
_CLOSE = 0.1
"""Radius of a cluster, as a share of its mean, up to which the objective of the mean bounds that of its members."""
_SEEDS = 8
"""Number of the worst functions around whose eigenvalues clusters are looked for."""
_CORRECTIONS = 10
"""Largest number of corrections of a move towards a meeting."""
_MET = 1e-14
"""Largest power sum of eigenvalues that have met."""
_PAIR_MET = 1e-11
"""Largest power sum of two eigenvalues that have met; it is the square of their distance."""
_ROUNDED = 1e-12
"""Power sum from which on corrections that no longer shrink it end: the rest is rounding."""
_ALONE, _TOGETHER = 4, 3
"""Number of clusters that are tried one by one, and largest number of clusters that meet in one step."""


@dataclass(frozen=True)
class Meeting:
    """Eigenvalues of a loop that may meet: mean as a function of the gains, cluster, and the radius around the mean."""

    mean: ActiveFunction
    cluster: Cluster
    radius: float

    @property
    def close(self) -> bool:
        """Whether the eigenvalues are so near to each other that their mean can take the place of each of them."""
        return bool(self.radius <= _CLOSE * abs(self.mean.place))

    def holds(self, piece: ActiveFunction) -> bool:
        """Return whether a function belongs to one of these eigenvalues."""
        same = (piece.family, piece.loop) == (self.mean.family, self.mean.loop)
        return same and abs(piece.place - self.mean.place) <= self.radius

    def apart_from(self, other: Meeting) -> bool:
        """Return whether two clusters have no eigenvalue in common, conjugates included."""
        if (self.mean.family, self.mean.loop) != (other.mean.family, other.mean.loop):
            return True
        both = self.radius + other.radius
        distance = abs(self.mean.place - other.mean.place), abs(self.mean.place - other.mean.place.conjugate())
        return min(distance) > both

    @property
    def rows(self) -> list[tuple[float, FloatArray]]:
        """Values and gradients of the power sums, which are zero where the eigenvalues meet."""
        found = list(zip(self.cluster.powers.real.tolist(), self.cluster.powers_slope.real, strict=True))
        if not self.cluster.real:
            found += zip(self.cluster.powers.imag.tolist(), self.cluster.powers_slope.imag, strict=True)
        return found


def meetings(problem: GainProblem, x: FloatArray, functions: ActiveFunctions) -> list[tuple[Meeting, ...]]:
    """Return groups of clusters that may meet at a better design, one by one and several at once."""
    places: dict[tuple[int, int, int, complex], tuple[float, complex, float]] = {}
    near = sorted(
        (piece for piece in functions.aim if piece.value < functions.score.value + _WINDOW),
        key=lambda piece: piece.value,
    )
    damping = problem.limits.objective == "damping"
    for piece in near[:_SEEDS]:
        f, spectrum = piece.family, functions.states[piece.family].system.values[piece.loop]
        for centre, size, radius in nearby(spectrum, piece.place, problem.scale, len(x) + 1, not damping):
            key = (f, piece.loop, size, complex(np.round(centre / problem.scale, 6)))
            places[key] = radius / max(abs(centre), 0.01 * problem.scale), centre, radius
    tightest = sorted(places, key=lambda key: places[key][0])
    largest = sorted(tightest[_ALONE:], key=lambda key: -key[2])[:1]
    subspaces = problem.subspaces(x, functions.states)
    groups: list[tuple[Meeting, ...]] = []
    joint: list[Meeting] = []
    for key in (*tightest[: 2 * _ALONE], *largest):
        alone = len(groups) < _ALONE or key in largest
        if not alone and len(joint) >= _TOGETHER:
            continue
        f, loop, size, _ = key
        _, centre, radius = places[key]
        cluster = subspaces.cluster(f, loop, centre, size)
        if cluster is None or (cluster.real and damping):
            continue
        value, slope = problem.mean_of(f, cluster)
        one = Meeting(ActiveFunction("cluster", f, loop, value, slope, cluster.mean, size), cluster, radius)
        if alone:
            groups.append((one,))
        if len(joint) < _TOGETHER and all(one.apart_from(other) for other in joint):
            joint.append(one)
    return [*groups, *(tuple(joint[:n]) for n in range(2, len(joint) + 1))]


def nearby(
    values: ComplexArray, worst: complex, scale: float, most: int, with_real: bool = True
) -> list[tuple[complex, int, float]]:
    """Return centres, sizes and radii of clusters of eigenvalues that a given one may belong to.

    Parameters
    ----------
    values : (n,) array
        Eigenvalues of a loop.
    worst : complex
        One of them.
    scale : float
        Typical magnitude of an eigenvalue [rad/s].
    most : int
        Largest number of members.
    with_real : bool
        Whether clusters around a place on the real axis are meant, too.
    """
    found: list[tuple[complex, int, float]] = []
    for real in (False, True) if with_real else (False,):
        members = np.array([worst])
        for size in range(2, min(most, len(values)) + 1):
            members = values[np.argsort(np.abs(values - _middle(members, real)), kind="stable")[:size]]
            centre = _middle(members, real)
            distance = np.sort(np.abs(values - centre))
            inside, outside = float(distance[size - 1]), distance[size] if size < len(values) else np.inf
            if inside > _NEAR * max(abs(centre), 0.01 * scale):
                break
            whole = not real or abs(members.imag.sum()) <= 1e-6 * np.abs(members).sum()
            if whole and outside > _APART * inside and (real or abs(centre.imag) > inside):
                found.append((centre, size, inside * (1 + 1e-6)))
    return found


def _middle(members: ComplexArray, real: bool) -> complex:
    middle = complex(members.sum()) / len(members)
    return complex(middle.real) if real else middle


def back_to_meeting(
    problem: GainProblem, x: FloatArray, move: FloatArray, means: tuple[ActiveFunction, ...], least: float = -np.inf
) -> FloatArray | None:
    """Return a move corrected so that its clusters of eigenvalues meet at its end.

    None when the objective of the means, or of other eigenvalues of their loops, is below `least` before the
    corrections, which hardly change it.

    The distance of k eigenvalues is a k-th root. So an error of second order in the move would change it by more than
    the first order. The derivatives of the power sums are computed once and then updated with their changes along the
    corrections (Broyden's method), as long as these shrink.
    """
    width = problem.upper - problem.lower
    met = _MET if max(mean.size for mean in means) > 2 else _PAIR_MET
    spectra, sums = _sums(problem, x + move, means, [mean.place for mean in means])
    if _reached(problem, spectra, means, sums) < least:
        return None
    smallest, inverse, last, nearest = np.inf, None, (np.zeros(0), np.zeros(0)), move
    for step in range(_CORRECTIONS):
        if step and inverse is not None:
            sums = _sums(problem, x + move, means, [place for place, _ in sums])[1]
        fresh = inverse is None
        if inverse is None:
            subspaces = problem.subspaces(x + move)
            clusters = [
                subspaces.cluster(mean.family, mean.loop, place, mean.size)
                for mean, (place, _) in zip(means, sums, strict=True)
            ]
            found = [cluster for cluster in clusters if cluster is not None]
            if len(found) < len(clusters):
                return move
            sums = [(cluster.mean, cluster.powers) for cluster in found]
            slopes = np.concatenate([cluster.powers_slope for cluster in found]) * width
            inverse = _pseudo_inverse(np.vstack([slopes.real, slopes.imag]))
        values = np.concatenate([powers for _, powers in sums])
        size = float(np.abs(values).max())
        if not size > met:
            return move
        if size > 0.5 * smallest:
            if fresh or smallest < _ROUNDED:
                return move if size < smallest else nearest
            inverse = None
            continue
        smallest, nearest = size, move
        reached = np.concatenate([values.real, values.imag])
        if not fresh:
            change, taken = reached - last[0], last[1] @ inverse
            product = float(taken @ change)
            if abs(product) > 1e-3 * float(last[1] @ last[1]):
                inverse = inverse + np.outer(last[1] - inverse @ change, taken) / product
        moved = np.clip(x + move - (inverse @ reached) * width, problem.lower, problem.upper) - x
        last = reached, (moved - move) / width
        move = moved
    return move


def _reached(
    problem: GainProblem,
    spectra: dict[tuple[int, int], ComplexArray],
    means: tuple[ActiveFunction, ...],
    sums: list[tuple[complex, ComplexArray]],
) -> float:
    """Return the smallest objective of the loops of some clusters, with the mean of each for its eigenvalues."""
    lowest = np.inf
    for loop, values in spectra.items():
        apart, centres = np.ones(len(values), bool), []
        for mean, (centre, _) in zip(means, sums, strict=True):
            if (mean.family, mean.loop) == loop:
                centres.append(centre)
                distances = np.abs(values - centre)
                radius = np.sort(distances)[mean.size - 1] * 1.01 + 1e-6 * abs(centre)
                apart &= (distances > radius) & (np.abs(values - centre.conjugate()) > radius)
        T = problem.families[loop[0]].sample_time
        lowest = min(lowest, float(problem.aim(true_rates(np.append(values[apart], centres), T), T).min()))
    return lowest


def _pseudo_inverse(rows: FloatArray) -> FloatArray:
    """Return the pseudo-inverse of a matrix whose rows have very different lengths."""
    length = np.maximum(np.linalg.norm(rows, axis=1), 1e-300)
    return np.asarray(np.linalg.pinv(rows / length[:, None], rcond=1e-12) / length)


def _sums(
    problem: GainProblem, x: FloatArray, means: tuple[ActiveFunction, ...], places: list[complex]
) -> tuple[dict[tuple[int, int], ComplexArray], list[tuple[complex, ComplexArray]]]:
    """Return the eigenvalues of the loops of some clusters at a design, and means and power sums of the clusters."""
    states = {mean.family: problem.families[mean.family].states(x) for mean in means}
    least, spectra = 0.01 * problem.scale, {}
    found: list[tuple[complex, ComplexArray]] = [(0j, np.zeros(0, complex))] * len(means)
    for f, loop in {(mean.family, mean.loop) for mean in means}:
        own = [i for i, mean in enumerate(means) if (mean.family, mean.loop) == (f, loop)]
        rows = [(places[i].real, places[i].imag, max(abs(places[i]), least), means[i].size) for i in own]
        spectra[f, loop], sums = near_sums(states[f][loop], np.array(rows))
        for i, one in zip(own, sums, strict=True):
            found[i] = one
    return spectra, found
