"""Choice of the eigenvalues that may meet at a better design, and return to a point where they do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbid.arrays import ComplexArray, FloatArray
from gbid.control.tuning.search.nonsmooth.active import ActiveFunction, ActiveFunctions
from gbid.control.tuning.search.nonsmooth.cluster import Cluster
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.spectrum import eigenvalues

_NEAR = 0.5
"""Largest distance of a member from the centre, as a share of the centre's magnitude."""
_APART = 1.3
"""By how much the nearest eigenvalue outside is farther from the centre than the farthest inside."""
_WINDOW = 0.1
"""Largest distance of the objective of a member from the worst one."""
_ROUNDING = 1e-9
"""Relative error of a matrix that counts as rounding, with the conditions of balanced loops."""
_SEEDS = 8
"""Number of the worst functions around whose eigenvalues clusters are looked for."""
_ALONE, _TOGETHER = 4, 3
"""Number of clusters that are tried one by one, and largest number of clusters that meet in one step."""


@dataclass(frozen=True)
class Meeting:
    """Eigenvalues of a loop that may meet: mean as a function of the gains, cluster, and the radius around the mean."""

    mean: ActiveFunction
    cluster: Cluster
    radius: float

    @property
    def met(self) -> bool:
        """Whether the eigenvalues have met up to rounding, which moves k of them by its k-th root."""
        return bool(self.radius <= 2.0 * _ROUNDING ** (1.0 / self.mean.size) * abs(self.mean.place))

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
    spectra: dict[int, ComplexArray] = {}
    for piece in near[:_SEEDS]:
        f = piece.family
        if f not in spectra:
            spectra[f] = eigenvalues(problem.families[f].states(x))
        for centre, size, radius in nearby(spectra[f][piece.loop], piece.place, problem.scale, len(x) + 1):
            key = (f, piece.loop, size, complex(np.round(centre / problem.scale, 6)))
            places[key] = radius / max(abs(centre), 0.01 * problem.scale), centre, radius
    tightest = sorted(places, key=lambda key: places[key][0])
    largest = sorted(tightest[_ALONE:], key=lambda key: -key[2])[:1]
    subspaces, found = problem.subspaces(x), []
    for key in (*tightest[: 2 * _ALONE], *largest):
        f, loop, size, _ = key
        _, centre, radius = places[key]
        cluster = subspaces.cluster(f, loop, centre, size)
        if cluster is not None and not (cluster.real and problem.limits.objective == "damping"):
            value, slope = problem.mean_of(f, cluster)
            mean = ActiveFunction("cluster", f, loop, value, slope, cluster.mean, size)
            found.append((Meeting(mean, cluster, radius), key in tightest[:_ALONE] or key in largest))
    groups: list[tuple[Meeting, ...]] = [(one,) for one, alone in found if alone]
    joint: list[Meeting] = []
    for one, _ in found:
        if all(one.apart_from(other) for other in joint):
            joint.append(one)
            if 1 < len(joint) <= _TOGETHER:
                groups.append(tuple(joint))
    return groups


def nearby(values: ComplexArray, worst: complex, scale: float, most: int) -> list[tuple[complex, int, float]]:
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
    """
    found: list[tuple[complex, int, float]] = []
    for real in (False, True):
        members = np.array([worst])
        for size in range(2, min(most, len(values)) + 1):
            middle = complex(members.mean().real if real else members.mean())
            members = values[np.argsort(np.abs(values - middle), kind="stable")[:size]]
            centre = complex(members.mean().real if real else members.mean())
            distance = np.sort(np.abs(values - centre))
            inside, outside = float(distance[size - 1]), distance[size] if size < len(values) else np.inf
            if inside > _NEAR * max(abs(centre), 0.01 * scale):
                break
            whole = not real or abs(members.imag.sum()) <= 1e-6 * np.abs(members).sum()
            if whole and outside > _APART * inside and (real or abs(centre.imag) > inside):
                found.append((centre, size, inside * (1 + 1e-6)))
    return found


def back_to_meeting(
    problem: GainProblem, x: FloatArray, move: FloatArray, means: tuple[ActiveFunction, ...]
) -> FloatArray:
    """Return a move corrected so that its clusters of eigenvalues meet at its end.

    The distance of k eigenvalues is a k-th root. So an error of second order in the move would change it by more than
    the first order.
    """
    width = problem.upper - problem.lower
    places = [mean.place for mean in means]
    smallest = np.inf
    for _ in range(8):
        subspaces = problem.subspaces(x + move)
        clusters = [
            subspaces.cluster(mean.family, mean.loop, place, mean.size)
            for mean, place in zip(means, places, strict=True)
        ]
        found = [cluster for cluster in clusters if cluster is not None]
        if len(found) < len(clusters):
            return move
        places = [cluster.mean for cluster in found]
        values = np.concatenate([cluster.powers for cluster in found])
        size = float(np.abs(values).max())
        if size < 1e-15 or size > 0.5 * smallest:
            break
        smallest = size
        slopes = np.concatenate([cluster.powers_slope for cluster in found]) * width
        rows, sides = np.vstack([slopes.real, slopes.imag]), -np.concatenate([values.real, values.imag])
        length = np.maximum(np.linalg.norm(rows, axis=1), 1e-300)
        correction = np.linalg.lstsq(rows / length[:, None], sides / length, rcond=1e-12)[0]
        move = np.clip(x + move + correction * width, problem.lower, problem.upper) - x
    return move
