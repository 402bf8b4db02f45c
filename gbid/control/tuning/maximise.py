"""Gains with the largest damping, for any closed-loop matrices that depend on gains."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray, is_whole
from gbid.control.tuning.gain_result import GainResult, GainStatus, WorstMode
from gbid.control.tuning.search.basins.ranking import FEASIBLE
from gbid.control.tuning.search.global_search import Effort, Progress
from gbid.control.tuning.search.limits import Limits, Objective
from gbid.control.tuning.search.loop_family import families_of
from gbid.control.tuning.search.nonsmooth.certificate import Certificate
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.sqp import LocalOptimum
from gbid.control.tuning.search.starts.neutral import typical_rate, usable_start
from gbid.control.tuning.search.step import SearchStep
from gbid.control.tuning.solving import solve
from gbid.control.tuning.verify import largest_norm, static_gains, worst_mode
from gbid.errors import UsageError
from gbid.notes.control_notes import ControlNote


def maximise_damping(
    A_of_gains: ca.Function | Sequence[ca.Function],
    gains: Sequence[str],
    lower: npt.ArrayLike,
    upper: npt.ArrayLike,
    objective: Objective = "damping",
    *,
    slowest_pole: float = 0.0,
    peak_sensitivity: float | None = None,
    peak_control: float | None = None,
    static_amplification: float | None = None,
    start: npt.ArrayLike | None = None,
    starts: int | None = None,
    seed: int = 0,
    evaluations: int | None = None,
    progress: Progress | None = None,
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
        Seed of the random starts.
    evaluations : int, optional
        Number of designs after which the search ends, about; the status is then ``"iteration limit"``.
    progress : callable, optional
        Called with a `SearchStep` after each stage.

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
    A global stage finds regions of attraction of local optima, from starts that are first made stable. In each of them
    BFGS climbs along ridges, and local optimisation takes steps that use all eigenvalues near the worst one (see
    `gbid.control.tuning.search.sqp`). Eigenvalues that meet are represented by their mean and by power sums of their
    distances, because these have derivatives there and the eigenvalues have not. The result is ``"optimal"`` only when
    a convex combination of gradients certifies it, otherwise ``"stalled"``.

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
        raise UsageError(f"maximise_damping: gains {', '.join(map(str, names))}; give each a name of its own")
    low, high = as_bounds(lower, upper, names)
    check_counts(seed=seed, starts=starts, evaluations=evaluations)
    families = families_of(functions, len(names))
    neutral = np.clip(np.zeros(len(names)), low, high)
    limits = Limits(objective, slowest_pole, peak_sensitivity, peak_control, static_amplification)
    if limits.has_responses and not all(family.n_outputs for family in families):
        raise UsageError("limits on frequency responses need functions from the gains to A, B, C and D of every loop")
    given = [] if start is None else [np.clip(as_start(start, names), low, high)]
    neutral = usable_start(families, [neutral, *given], low, high, int(seed))
    problem = GainProblem(families, limits, low, high, typical_rate(families, neutral))
    problem.most_evaluations = evaluations
    optimum, history = solve(problem, neutral, Effort(starts, seed), given, progress)
    count = sum(len(family) for family in families)
    norms = " and exact H-infinity norms" if limits.has_responses else ""
    return summarise(problem, optimum, names, history, f"eigenvalues{norms} of the {count} closed-loop matrices")


def check_counts(seed: int, starts: int | None, evaluations: int | None = None) -> None:
    """Refuse a seed and numbers of starts or designs that are no whole numbers, or too small.

    Raises
    ------
    UsageError
        When one of them is.
    """
    for name, value, least in (("seed", seed, 0), ("starts", starts, 0), ("evaluations", evaluations, 1)):
        if not is_whole(value, least) and (value is not None or name == "seed"):
            raise UsageError(f"{name} = {value!r}; give an integer of at least {least}")


def _listed(functions: Any) -> list[Any]:
    if not isinstance(functions, Iterable) or isinstance(functions, str):
        kind = type(functions).__name__
        raise UsageError(
            f"A_of_gains is a {kind}; give a casadi.Function from the gains to the matrix, or a list of these"
        )
    return list(functions)


def summarise(
    problem: GainProblem,
    found: LocalOptimum,
    names: tuple[str, ...],
    history: tuple[SearchStep, ...],
    verified_on: str,
    notes: tuple[str, ...] = (),
    **more: Any,
) -> GainResult:
    """Return the result, from eigenvalues and exact norms of the final design."""
    x = np.clip(found.x, problem.lower, problem.upper)
    score, stable = problem.score(x), problem.stable(x)
    worst = worst_mode(problem, x)
    certificate = found.certificate
    status = GainStatus.OPTIMAL if certificate is not None and certificate.holds else GainStatus.STALLED
    if not found.converged or (problem.exhausted and status is GainStatus.STALLED):
        status = GainStatus.ITERATION_LIMIT
    if not stable:
        status = GainStatus.NO_STABILISING_GAINS
        text = f"no gains within the bounds were found that stabilise {worst.where}: {_mode(worst)}"
        notes = (*notes, ControlNote.NO_STABILISING_GAINS(text))
    elif score.violation > FEASIBLE:
        status = GainStatus.LIMITS_CONTRADICT
        text = f"no design was found that keeps all limits; this one exceeds them by {score.violation:.2g}"
        notes = (*notes, ControlNote.LIMITS_EXCEEDED(text))
    if status is GainStatus.STALLED and certificate is not None:
        notes = (*notes, _stalled(certificate))
    more = {**_peaks(problem, x, stable), **_certificate(certificate), **more}
    return GainResult(
        dict(zip(names, map(float, x), strict=True)),
        problem.in_units(score.value),
        problem.limits.objective,
        status,
        score.violation,
        verified_on,
        worst,
        _active(problem, x, names, stable),
        notes,
        history=history,
        **more,
    )


def _stalled(certificate: Certificate) -> str:
    return ControlNote.NO_CERTIFICATE(
        "no certificate of optimality: to first order the objective would rise by "
        f"{100 * certificate.gain:.2g} % if the gains changed by their own size; sequential quadratic programmes, "
        "steps to meeting eigenvalues, BFGS, random moves and gradients from balls around it found no better one"
    )


def _certificate(found: Certificate | None) -> dict[str, float]:
    if found is None or not np.isfinite(found.gain):
        return {}
    return {
        "certificate_gain": found.gain,
        "certificate_radius": found.radius,
        "certificate_room": found.room,
    }


def _mode(worst: WorstMode) -> str:
    if np.isnan(worst.frequency_hz):
        return "its matrix is not finite"
    return f"its worst mode has {worst.frequency_hz:.4g} Hz and damping {worst.damping:.4g}"


def _peaks(problem: GainProblem, x: FloatArray, stable: bool) -> dict[str, float]:
    """Return the exact peaks over all loops that have outputs."""
    families = [family for family in problem.families if family.n_outputs]
    if not families or not stable:
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
    if not stable:
        return tuple(bounds)
    found: dict[str, dict[str, None]] = {}
    located = {*_TITLES, *(extra.name for extra in problem.limits.extra)}
    for piece in sorted(problem.functions(x).limits, key=lambda piece: -piece.value):
        if piece.value > -1e-4:
            places = found.setdefault(_TITLES.get(piece.kind, piece.kind), {})
            if piece.kind in located:
                places[problem.families[piece.family].labels[piece.loop]] = None
    return tuple(dict.fromkeys([*(text for title in found for text in _located(title, [*found[title]])), *bounds]))


def _located(title: str, places: list[str]) -> list[str]:
    """Return a limit at each of its places, worst first; of many only how many there are besides the worst."""
    if len(places) > _PLACES:
        return [f"{title} at {places[0]} and {len(places) - 1} more"]
    return [f"{title} at {place}" for place in places] or [title]


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
