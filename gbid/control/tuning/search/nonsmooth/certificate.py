"""Certificate of optimality: the smallest convex combination of gradients at or near a design."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.search.nonsmooth.active import ActiveFunctions, merit
from gbid.control.tuning.search.nonsmooth.hull import GradientHull
from gbid.control.tuning.search.nonsmooth.meetings import Meeting, meetings
from gbid.control.tuning.search.problem import GainProblem

TOLERANCE = 2e-3
"""Largest relative first-order gain of an optimal design."""
ROOM = 5e-3
"""Largest relative rise of the objective that an optimal design leaves open."""
_RADII = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
_PENALTY = 10.0
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
        By which share of its value the objective could still rise within the ball, or by meetings of eigenvalues.
    meeting : tuple of int
        Numbers of eigenvalues that meet at the design or beside it, where their mean takes the place of each of them.
    """

    gain: float
    radius: float
    room: float
    meeting: tuple[int, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether the design is optimal to first order."""
        return bool(self.gain <= TOLERANCE and self.room <= ROOM)


NO_CERTIFICATE = Certificate(np.inf, 0.0, np.inf)
"""Certificate of a design that has no gradients."""


def certify(problem: GainProblem, x: FloatArray, unit: FloatArray) -> tuple[Certificate, FloatArray]:
    r"""Return the certificate of a design, and a better design if one was found near it.

    A design is optimal to first order when zero lies in the set

    .. math:: \Big\{ \sum_i \lambda_i a_i - \sum_k \mu_k c_k - \nu : \lambda_i, \mu_k \ge 0, \sum_i \lambda_i = 1 \Big\}

    of gradients a of the smallest functions of the objective and c of the limits, with the outward normals of bounds as
    :math:`\nu`. Two cases need more than the gradients at the design:

    - Eigenvalues meet. Their gradients are unbounded. The gradient of their mean takes their place, together with
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
        if best.holds or problem.exhausted:
            break
        found, y = _in_ball(problem, x, unit, radius)
        if y is not x:
            x, best = y, min(_at_design(problem, y, unit), found, key=_order)
        else:
            best = min(best, found, key=_order)
    return best, x


def _order(one: Certificate) -> tuple[bool, float]:
    return not one.holds, max(one.gain / TOLERANCE, one.room / ROOM)


def _bounds(problem: GainProblem, x: FloatArray, unit: FloatArray, radius: float) -> GradientHull:
    return GradientHull(unit, (x - problem.lower) / unit <= radius, (problem.upper - x) / unit <= radius)


def _at_design(problem: GainProblem, x: FloatArray, unit: FloatArray) -> Certificate:
    """Return the best certificate by the gradients at the design, each with other eigenvalues that meet."""
    here = problem.functions(x)
    if not here.score.usable:
        return NO_CERTIFICATE
    if not here.aim and here.score.violation <= 0:  # no mode oscillates: the objective has its largest value
        return Certificate(0.0, 0.0, 0.0)
    value, best = max(abs(here.score.value), 1e-3), NO_CERTIFICATE
    for group in [(), *meetings(problem, x, here)]:
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
                hull.add_meeting(*_spreads(one, problem))
            shortest, rise = hull.combination()
            gain = float(np.linalg.norm(shortest)) / value
            # on the way to a bound that is not quite reached the objective rises by at most what it would without it
            found = Certificate(gain, 0.0, room + nearer + rise / value, tuple(one.mean.size for one in group))
            best, nearer = min(best, found, key=_order), _ACTIVE * gain
            if found.holds:
                break
    return best


_Spread = tuple[FloatArray, float]
"""Gradient of a power sum, and its largest change while the eigenvalues stay as near to each other."""


def _spreads(one: Meeting, problem: GainProblem) -> tuple[_Spread, list[_Spread]]:
    """Return the power sum whose rise lowers the objective, and the others."""
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
    """Return the certificate by gradients from a ball, and a better design if there is one in it, else the same."""
    before, most = problem.evaluations, 20 + 5 * len(x)
    here = problem.functions(x, radius)
    if not here.score.usable:
        return NO_CERTIFICATE, x
    value = max(abs(here.score.value), 1e-3)
    hull = _bounds(problem, x, unit, radius)
    hull.add(here)
    gain = np.inf
    while problem.evaluations - before < most:
        direction = hull.shortest()
        length = float(np.linalg.norm(direction))
        gain = length / value
        if gain <= TOLERANCE or not np.isfinite(length):
            break
        floor, share, added = merit(here.score, _PENALTY), radius, False
        for trial in range(8):
            y = np.clip(x + share * direction / length * unit, problem.lower, problem.upper)
            there = problem.functions(y, 0.0)
            share /= 2
            if not there.score.usable:
                continue
            if trial == 0 and merit(there.score, _PENALTY) > floor + _KEPT * radius * length:
                x, here = y, problem.functions(y, radius)
                hull = _bounds(problem, x, unit, radius)
                added = hull.add(here) or True
                break
            if hull.add(there, direction):
                added = True
                break
        if not added:
            break
    return Certificate(gain, radius, radius * hull.steepest / value), x
