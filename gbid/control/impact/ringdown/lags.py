"""The fit of two modes, alone and with lags beside them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.impact.ringdown.basis import N_MECHANICAL
from gbid.control.impact.ringdown.separable import RingProblem, SeparableFit
from gbid.control.impact.ringdown.start import eigenvalues_of
from gbid.errors import DataError

LAGS = 3
"""How many lags ``"auto"`` takes where the data ask for any."""
_SLOWEST, _FASTEST = 1.0, 3.0  # rates of the lags over the angular frequency of the modes
_GUESSES = 2  # start values that are followed


def fit_lags(
    problems: Callable[[float], RingProblem], guesses: Sequence[tuple[float, FloatArray]], lags: int | str
) -> tuple[RingProblem, SeparableFit]:
    """Fit two modes, and lags if they are asked for or the data ask for them.

    The rates of the lags are fixed, spread around the frequency of the modes. Sums of such decays come close to any
    others there; rates that were estimated would run into each other, or off to where they explain noise.

    Parameters
    ----------
    problems : callable
        The problem for a rate [rad/s] by which K and D are scaled.
    guesses : sequence of (rate, theta)
        To start from.
    lags : int or "auto"

    Returns
    -------
    problem, solved

    Raises
    ------
    DataError
        When two modes cannot be fitted.
    """
    problem, solved = _fit_modes(problems, guesses)
    wanted = LAGS if lags == "auto" else int(lags)
    if wanted == 0:
        return problem, solved
    larger, theta = problem.with_lags(solved.theta, lag_rates(problem, solved, wanted).tolist())
    try:
        more = larger.solve(theta)
    except (np.linalg.LinAlgError, ValueError):
        more = None
    if more is None and lags != "auto":
        raise DataError(f"recording {problem.data[0].name!r}: no fit with {lags} lags; use fewer, or lags='auto'")
    if more is None or (lags == "auto" and _schwarz(problem, solved) <= _schwarz(larger, more)):
        return problem, solved
    return larger, more


def lag_rates(problem: RingProblem, solved: SeparableFit, count: int) -> FloatArray:
    """Rates of so many lags, in geometric steps about the modes [1/s]."""
    K, D = solved.theta[:4].reshape(2, 2), solved.theta[4:N_MECHANICAL].reshape(2, 2)
    middle = problem.scale.rate * float(np.abs(eigenvalues_of(-np.hstack([K, D]))).mean())
    steps = np.geomspace(_SLOWEST, _FASTEST, count) if count > 1 else np.array([np.sqrt(_SLOWEST * _FASTEST)])
    return np.asarray(middle * steps)


def _fit_modes(
    problems: Callable[[float], RingProblem], guesses: Sequence[tuple[float, FloatArray]]
) -> tuple[RingProblem, SeparableFit]:
    """Fit two modes without lags, from the best of the guesses."""
    tries = []
    for rate, theta in guesses:
        with contextlib.suppress(np.linalg.LinAlgError, ValueError):  # a guess that grows until it overflows
            tries.append((problems(rate).at(theta, slopes=False).squares, rate, theta))
    tries = [t for t in tries if np.isfinite(t[0])]
    found = []
    for _, rate, theta in sorted(tries, key=lambda t: t[0])[:_GUESSES]:
        problem = problems(rate)
        with contextlib.suppress(np.linalg.LinAlgError, ValueError):
            found.append((problem, problem.solve(theta)))
    if not found:
        raise DataError(
            f"recording {problems(1.0).data[0].name!r}: no two modes fit the ring-down; give start=[(f, zeta), ...]"
        )
    return min(found, key=lambda t: t[1].at.squares)


def _schwarz(problem: RingProblem, solved: SeparableFit) -> float:
    """Schwarz's criterion (BIC), up to a constant; residuals of a millionth of the signal are rounding, not noise."""
    n = problem.n_values
    return float(n * np.log(max(solved.at.squares / n, 1e-12)) + np.log(n) * (len(solved.theta) + problem.n_linear))
