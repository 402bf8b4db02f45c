"""Certificate of optimality: the smallest convex combination of gradients, also where eigenvalues coalesce."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from gbid.control.tuning.plane import Cluster, eigenvalues, power_sums, true_rates
from gbid.control.tuning.problem import ActiveFunction, ActiveFunctions, GainProblem, merit
from gbid.core.arrays import BoolArray, ComplexArray, FloatArray

# ---- Choice of the eigenvalues that may coalesce at a better design, and return to a point of coalescence.

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
"""Largest number of corrections of a move towards a coalescence."""
_MET = 1e-14
"""Largest power sum of eigenvalues that have met."""
_PAIR_MET = 1e-11
"""Largest power sum of two eigenvalues that have met; it is the square of their distance."""
_ROUNDED = 1e-12
"""Power sum from which on corrections that no longer shrink it end: the rest is rounding."""
_PART = 0.1
"""Part of a move after which the power sums tell its error of second order."""
_ALONE, _TOGETHER = 4, 3
"""Number of clusters that are tried one by one, and largest number of clusters that coalesce in one step."""


@dataclass(frozen=True)
class Coalescence:
    """Cluster of eigenvalues of one loop that may coalesce: mean as a function of the gains, cluster and radius."""

    mean: ActiveFunction
    cluster: Cluster
    radius: float

    @property
    def close(self) -> bool:
        """Whether the eigenvalues are so near to each other that their mean can replace each of them."""
        return bool(self.radius <= _CLOSE * abs(self.mean.place))

    def holds(self, piece: ActiveFunction) -> bool:
        """Return whether an active function belongs to an eigenvalue of this cluster."""
        same = (piece.family, piece.loop) == (self.mean.family, self.mean.loop)
        return same and abs(piece.place - self.mean.place) <= self.radius

    def apart_from(self, other: Coalescence) -> bool:
        """Return whether two clusters have no eigenvalue in common, conjugates included."""
        if (self.mean.family, self.mean.loop) != (other.mean.family, other.mean.loop):
            return True
        both = self.radius + other.radius
        distance = abs(self.mean.place - other.mean.place), abs(self.mean.place - other.mean.place.conjugate())
        return min(distance) > both

    @property
    def rows(self) -> list[tuple[float, FloatArray]]:
        """Values and gradients of the power sums, which are zero where the eigenvalues coalesce."""
        sums = list(zip(self.cluster.powers.real.tolist(), self.cluster.powers_slope.real, strict=True))
        if not self.cluster.real:
            sums += zip(self.cluster.powers.imag.tolist(), self.cluster.powers_slope.imag, strict=True)
        return sums


def coalescences(problem: GainProblem, x: FloatArray, functions: ActiveFunctions) -> list[tuple[Coalescence, ...]]:
    """Return groups of clusters that may coalesce at a better design: single clusters, and several at once.

    The clusters are for the objectives damping and decay of all modes: the mean of a cluster has no meaning for others.
    """
    places: dict[tuple[int, int, int, complex], tuple[float, complex, float]] = {}
    near = sorted(
        (piece for piece in functions.aim if piece.kind == "aim" and piece.value < functions.score.value + _WINDOW),
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
    groups: list[tuple[Coalescence, ...]] = []
    joint: list[Coalescence] = []
    for key in (*tightest[: 2 * _ALONE], *largest):
        alone = len(groups) < _ALONE or key in largest
        if not alone and len(joint) >= _TOGETHER:
            continue
        f, loop, size, _ = key
        _, centre, radius = places[key]
        cluster = problem.cluster(functions.states, f, loop, centre, size)
        if cluster is None or (cluster.real and damping):
            continue
        value, slope = problem.mean_of(f, cluster)
        one = Coalescence(ActiveFunction("cluster", f, loop, value, slope, cluster.mean, size), cluster, radius)
        if alone:
            groups.append((one,))
        if len(joint) < _TOGETHER and all(one.apart_from(other) for other in joint):
            joint.append(one)
    return [*groups, *(tuple(joint[:n]) for n in range(2, len(joint) + 1))]


def nearby(
    values: ComplexArray, worst: complex, scale: float, most: int, with_real: bool = True
) -> list[tuple[complex, int, float]]:
    """Return centres, sizes and radii of the clusters that may contain a given eigenvalue.

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
    clusters: list[tuple[complex, int, float]] = []
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
                clusters.append((centre, size, inside * (1 + 1e-6)))
    return clusters


def _middle(members: ComplexArray, real: bool) -> complex:
    middle = complex(members.sum()) / len(members)
    return complex(middle.real) if real else middle


def back_to_coalescence(
    problem: GainProblem, x: FloatArray, move: FloatArray, group: tuple[Coalescence, ...], least: float = -np.inf
) -> FloatArray | None:
    """Return a step of the gains, corrected so that the clusters of a group coalesce at its end.

    None when the objective of the means, or of other eigenvalues of their loops, is below `least` after the first
    correction; the others hardly change it.

    The distance of k eigenvalues is a k-th root. So an error of second order in the move would change it by more than
    the first order. The power sums after a small part of the move tell this error, before the eigenvalues are too far
    apart to be told from others: that is the first correction. For the others the derivatives of the power sums are
    updated with their changes (Broyden's method), and computed again where these do not shrink. Gains that the move
    takes to their bounds stay there.
    """
    width, means = problem.upper - problem.lower, tuple(one.mean for one in group)
    met = _MET if max(mean.size for mean in means) > 2 else _PAIR_MET
    places = [mean.place for mean in means]

    def corrected(move: FloatArray, inverse: FloatArray, powers: ComplexArray) -> FloatArray:
        change = inverse @ np.concatenate([powers.real, powers.imag])
        return np.asarray(np.minimum(np.maximum(x + move - change * width, problem.lower), problem.upper) - x)

    inner = (x + move > problem.lower) & (x + move < problem.upper)
    scaled = width * inner if inner.sum() >= sum(len(one.rows) for one in group) else width
    inverse = _inverse([one.cluster for one in group], scaled)
    part = _sums(problem, x + _PART * move, means, places)[1]
    bends = [(p - (1 - _PART) * one.cluster.powers) / _PART**2 for (_, p), one in zip(part, group, strict=True)]
    move = corrected(move, inverse, np.concatenate(bends))
    spectra, sums = _sums(problem, x + move, means, places)
    if _reached(problem, spectra, means, sums) < least:
        return None
    smallest, nearest, last, fresh = np.inf, (move, sums), (np.zeros(0), np.zeros(0)), True
    for step in range(_CORRECTIONS):
        values = np.concatenate([powers for _, powers in sums])
        size = float(np.abs(values).max())
        slow = not size < 0.5 * smallest
        if size < smallest:
            smallest, nearest = size, (move, sums)
        if not size > met or (slow and (fresh or smallest < _ROUNDED)):
            break
        if slow:
            (move, sums), states = nearest, problem.states(x + nearest[0])
            clusters = [
                problem.cluster(states, mean.family, mean.loop, place, mean.size)
                for mean, (place, _) in zip(means, sums, strict=True)
            ]
            remaining = [cluster for cluster in clusters if cluster is not None]
            if len(remaining) < len(clusters):
                break
            inverse, values = _inverse(remaining, scaled), np.concatenate([cluster.powers for cluster in remaining])
        reached = np.concatenate([values.real, values.imag])
        if step and not slow:
            change, taken = reached - last[0], last[1] @ inverse
            product = float(taken @ change)
            if abs(product) > 1e-3 * float(last[1] @ last[1]):
                inverse = inverse + np.outer(last[1] - inverse @ change, taken) / product
        moved = corrected(move, inverse, values)
        last, fresh, move = (reached, (moved - move) / width), slow, moved
        sums = _sums(problem, x + move, means, [place for place, _ in sums])[1]
    return nearest[0]


def _inverse(clusters: Sequence[Cluster], width: FloatArray) -> FloatArray:
    """Return the pseudo-inverse of the derivatives of the power sums, in units of the width."""
    slopes = np.concatenate([cluster.powers_slope for cluster in clusters]) * width
    rows = np.vstack([slopes.real, slopes.imag])
    length = np.maximum(np.linalg.norm(rows, axis=1), 1e-300)  # the rows have very different lengths
    return np.asarray(np.linalg.pinv(rows / length[:, None], rcond=1e-12) / length)


def _reached(
    problem: GainProblem,
    spectra: dict[tuple[int, int], ComplexArray],
    means: tuple[ActiveFunction, ...],
    sums: list[tuple[complex, ComplexArray]],
) -> float:
    """Return the smallest objective over some loops, with each cluster of eigenvalues replaced by its mean."""
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


def _sums(
    problem: GainProblem, x: FloatArray, means: tuple[ActiveFunction, ...], places: list[complex]
) -> tuple[dict[tuple[int, int], ComplexArray], list[tuple[complex, ComplexArray]]]:
    """Return the eigenvalues of the loops of some clusters at a design, with means and power sums of the clusters."""
    spectra: dict[tuple[int, int], ComplexArray] = {}
    sums = []
    for mean, place in zip(means, places, strict=True):
        f, loop = mean.family, mean.loop
        if (f, loop) not in spectra:
            spectra[f, loop] = eigenvalues(problem.families[f].states(x, slice(loop, loop + 1)))[0]
        values = spectra[f, loop]
        nearest = np.abs(values - place).argsort(kind="stable")[: mean.size]
        sums.append(power_sums(values[nearest], max(abs(place), 0.01 * problem.scale)))
    return spectra, sums


# ---- Shortest combination of gradients: convex for the objective, conic for limits, bounds and coalescence.

_NO_CHANGE = 1e-10
"""Relative length of a gradient of a coalescence that is rounding; its multiple would be without an end."""


class GradientHull:
    """Gradients of objective and limits, and the bounds that are active at the design, in units of the gains.

    Parameters
    ----------
    unit : (d,) array
        Units of the gains.
    at_lower, at_upper : (d,) array
        Whether the design is at its lower or upper bounds.
    """

    def __init__(self, unit: FloatArray, at_lower: BoolArray, at_upper: BoolArray) -> None:
        self.unit = unit
        self._aims: list[FloatArray] = []
        eye = np.eye(len(unit))
        self._others: list[FloatArray] = [*eye[at_lower], *-eye[at_upper]]
        self._spreads: list[float] = [0.0] * len(self._others)

    @property
    def steepest(self) -> float:
        """Length of the longest gradient of the objective."""
        return max((float(np.linalg.norm(aim)) for aim in self._aims), default=0.0)

    def add(self, functions: ActiveFunctions, direction: FloatArray | None = None) -> bool:
        """Add the gradients at a point; return whether one of them shortens the combination along a direction."""
        aims = [piece.slope * self.unit for piece in functions.aim]
        limits = [-piece.slope * self.unit for piece in functions.limits]
        self._aims += aims
        self._others += limits
        self._spreads += [0.0] * len(limits)
        if direction is None:
            return False
        enough = 0.5 * float(direction @ direction)
        return any(float(gradient @ direction) < enough for gradient in (*aims, *limits))

    def add_coalescence(self, worse: tuple[FloatArray, float], free: list[tuple[FloatArray, float]]) -> None:
        """Add a function that must not rise and functions that must not change, each with its tolerated change."""
        rows = [(-worse[0], worse[1]), *free, *((-row, spread) for row, spread in free)]
        lengths = [float(np.linalg.norm(gradient * self.unit)) for gradient, _ in rows]
        for (gradient, spread), length in zip(rows, lengths, strict=True):
            if length > _NO_CHANGE * max(lengths):
                self._others.append(gradient * self.unit)
                self._spreads.append(spread)

    def shortest(self) -> FloatArray:
        """Return the shortest convex combination (d,); its direction is the direction of steepest ascent."""
        return self.combination()[0]

    def combination(self) -> tuple[FloatArray, float]:
        """Return the shortest convex combination, and the rise that the tolerated changes of power sums allow."""
        aims = np.array(self._aims).reshape(-1, len(self.unit)).T
        others = np.array(self._others).reshape(-1, len(self.unit)).T
        scale = max(self.steepest, 1e-300)
        lengths = np.maximum(np.linalg.norm(others, axis=0), 1e-300)
        columns = np.hstack([aims / scale, others / lengths])
        ones = np.append(np.ones(aims.shape[1]), np.zeros(others.shape[1]))
        sides = np.append(np.zeros(len(columns)), 1.0)
        if not np.isfinite(columns).all():  # without a combination there is no certificate
            return np.full(len(self.unit), np.inf), np.inf
        # bounded variables by an active set; scipy's nnls frees its memory twice where it does not converge
        weights = scipy.optimize.lsq_linear(
            np.vstack([columns, ones]), sides, (0.0, np.inf), method="bvls", max_iter=500
        ).x
        total = max(float(weights[: aims.shape[1]].sum()), 1e-300)
        multipliers = weights[aims.shape[1] :] / lengths * (scale / total)
        return np.asarray(columns @ weights * (scale / total)), float(multipliers @ self._spreads)


TOLERANCE = 2e-3
"""Largest relative first-order gain of an optimal design."""
ROOM = 5e-3
"""Largest relative rise of the objective that an optimal design leaves open."""
_RADII = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
_ACTIVE = 1e-4
"""Distance from a limit, as log, or from a bound, in units of the gain, within which it is active."""
_KEPT = 0.1
"""Share of the promised gain that a better point must reach."""


@dataclass(frozen=True)
class Certificate:
    """First-order optimality of a design.

    Attributes
    ----------
    gain : float
        Length of the shortest convex combination of gradients over the value of the objective: by this share the
        objective would rise to first order if the gains changed by one unit.
    radius : float
        Radius of the ball from which the gradients are, in units of the gains; 0: from the design itself.
    room : float
        By which share of its value the objective could still rise within the ball, or by coalescences of eigenvalues.
    coalescing : tuple of int
        Numbers of eigenvalues that coalesce at the design or beside it. Their mean takes the place of each of them.
    """

    gain: float
    radius: float
    room: float
    coalescing: tuple[int, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether the design is optimal to first order."""
        return bool(self.gain <= TOLERANCE and self.room <= ROOM)


NO_CERTIFICATE = Certificate(np.inf, 0.0, np.inf)
"""Certificate of a design that has no gradients."""


def certify(problem: GainProblem, x: FloatArray, unit: FloatArray) -> tuple[Certificate, FloatArray]:
    r"""Return the certificate of a design, and a better nearby design if the search for the certificate found one.

    A design is optimal to first order when zero lies in the set

    .. math:: \Big\{ \sum_i \lambda_i a_i - \sum_k \mu_k c_k - \nu : \lambda_i, \mu_k \ge 0, \sum_i \lambda_i = 1 \Big\}

    of gradients a of the smallest functions of the objective and c of the limits, with the outward normals of bounds as
    :math:`\nu`. Two cases need more than the gradients at the design:

    - Eigenvalues coalesce. Their gradients are unbounded. The gradient of their mean takes their place, together with
      multiples of the gradients of their power sums, which vary at a first-order change of the gains (J. V. Burke,
      A. S. Lewis, M. L. Overton, "Optimal stability and eigenvalue multiplicity", Foundations of Computational
      Mathematics 1, 2001). The objective is never above that of the mean. Where the eigenvalues are near each other but
      have not met, the mean may rise as the multiples times the changes of the power sums, which are at most twice
      their values at the cluster's radius; this is added to the room.
    - Functions change place with each other near the design. Gradients are taken from a ball around it (the Goldstein
      subdifferential). The points of the ball are not random. Along the shortest combination found so far either the
      merit rises, and the design moves, or a gradient shortens the combination (gradient sampling: J. V. Burke,
      A. S. Lewis, M. L. Overton, SIAM J. Optimization 15, 2005; choice of points: N. Mahdavi-Amiri, R. Yousefpour,
      J. Optimization Theory and Applications 155, 2012).

    Parameters
    ----------
    problem : GainProblem
        The design problem.
    x : (d,) array
        The design.
    unit : (d,) array
        Units of the gains.

    Returns
    -------
    Certificate
        The best one of the design that is returned.
    (d,) array
        The design, or a better one.
    """
    best = _at_design(problem, x, unit)
    for radius in _RADII:
        if best.holds or problem.evaluations.exhausted:
            break
        certificate, y = _in_ball(problem, x, unit, radius)
        if y is not x:
            x, best = y, min(_at_design(problem, y, unit), certificate, key=_order)
        else:
            best = min(best, certificate, key=_order)
    return best, x


def _order(one: Certificate) -> tuple[bool, float]:
    return not one.holds, max(one.gain / TOLERANCE, one.room / ROOM)


def _bounds(problem: GainProblem, x: FloatArray, unit: FloatArray, radius: float) -> GradientHull:
    return GradientHull(unit, (x - problem.lower) / unit <= radius, (problem.upper - x) / unit <= radius)


def _at_design(problem: GainProblem, x: FloatArray, unit: FloatArray) -> Certificate:
    """Return the best certificate by gradients at the design, over all groups of coalescing eigenvalues."""
    here = problem.functions(x)
    if not here.score.usable:
        return NO_CERTIFICATE
    if not here.aim and here.score.violation <= 0:  # no mode oscillates: the objective has its largest value
        return Certificate(0.0, 0.0, 0.0)
    value, best = max(abs(here.score.value), 1e-3), NO_CERTIFICATE
    for group in [(), *coalescences(problem, x, here)]:
        if not all(one.close for one in group):
            continue
        aims = [piece for piece in here.aim if not any(one.holds(piece) for one in group)]
        aims += [one.mean for one in group]
        if not aims:
            continue
        lowest = min(piece.value for piece in aims)
        room = (lowest - here.score.value) / value
        active = ActiveFunctions(
            here.score,
            tuple(piece for piece in aims if piece.value <= lowest + ROOM * value),
            tuple(piece for piece in here.limits if piece.value >= -_ACTIVE),
        )
        nearer = 0.0
        for near in (1e-6, _ACTIVE):
            hull = _bounds(problem, x, unit, near)
            hull.add(active)
            for one in group:
                hull.add_coalescence(*_spreads(one, problem))
            shortest, rise = hull.combination()
            gain = float(np.linalg.norm(shortest)) / value
            # on the way to a bound that is not quite reached the objective rises by at most what it would without it
            certificate = Certificate(gain, 0.0, room + nearer + rise / value, tuple(one.mean.size for one in group))
            best, nearer = min(best, certificate, key=_order), _ACTIVE * gain
            if certificate.holds:
                break
    return best


_Spread = tuple[FloatArray, float]
"""Gradient of a power sum, and its largest change while the eigenvalues stay as near to each other."""


def _spreads(one: Coalescence, problem: GainProblem) -> tuple[_Spread, list[_Spread]]:
    """Return the power sum whose rise lowers the objective, and all other power sums of the cluster."""
    slopes = one.cluster.powers_slope
    share = one.radius / max(abs(one.mean.place), 0.01 * problem.scale)
    largest = [2.0 * share**k for k in range(2, len(slopes) + 2)]
    if one.cluster.real:
        return (slopes[0].real, largest[0]), [*zip(slopes[1:].real, largest[1:], strict=True)]
    # eigenvalues that part along the gradient of the objective lower it, those that part across it do not
    damping = problem.limits.objective == "damping"
    across = -((one.mean.place / abs(one.mean.place)) ** 2) if damping else 1.0
    turned = slopes[0] / across
    others = [turned.imag, *slopes[1:].real, *slopes[1:].imag]
    return (turned.real, largest[0]), [*zip(others, [*largest, *largest[1:]], strict=True)]


def _in_ball(problem: GainProblem, x: FloatArray, unit: FloatArray, radius: float) -> tuple[Certificate, FloatArray]:
    """Return the certificate by gradients from a ball around a design, and a better design from the ball or `x`."""
    before, most = problem.evaluations.count, 20 + 5 * len(x)
    here = problem.functions(x, radius)
    if not here.score.usable:
        return NO_CERTIFICATE, x
    value = max(abs(here.score.value), 1e-3)
    hull = _bounds(problem, x, unit, radius)
    hull.add(here)
    gain = np.inf
    while problem.evaluations.count - before < most and not problem.evaluations.exhausted:
        direction = hull.shortest()
        length = float(np.linalg.norm(direction))
        gain = length / value
        if gain <= TOLERANCE or not np.isfinite(length):
            break
        floor, share, added = merit(here.score), radius, False
        for trial in range(8):
            y = np.clip(x + share * direction / length * unit, problem.lower, problem.upper)
            nearby = problem.functions(y, 0.0)
            share /= 2
            if not nearby.score.usable:
                continue
            if trial == 0 and merit(nearby.score) > floor + _KEPT * radius * length:
                x, here = y, problem.functions(y, radius)
                hull = _bounds(problem, x, unit, radius)
                added = hull.add(here) or True
                break
            if hull.add(nearby, direction):
                added = True
                break
        if not added:
            break
    return Certificate(gain, radius, radius * hull.steepest / value), x
