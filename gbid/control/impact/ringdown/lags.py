"""Fit of two modes, with and without additional lags."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.impact.ringdown.basis import N_MECHANICAL
from gbid.control.impact.ringdown.oscillations import add_oscillations, schwarz
from gbid.control.impact.ringdown.separable import RingProblem, SeparableFit
from gbid.control.impact.ringdown.start import eigenvalues_of
from gbid.errors import DataError

LAGS = 3
"""Number of lags of ``"auto"`` when the data require lags."""
_SLOWEST, _FASTEST = 1.0, 3.0  # rates of the lags over the angular frequency of the modes
_GUESSES = 2  # number of start values from which a fit is made


def fit_lags(
    problems: Callable[[float], RingProblem], guesses: Sequence[tuple[float, FloatArray]], lags: int | str
) -> tuple[RingProblem, SeparableFit]:
    """Return the fit of two modes, with lags when they are requested or when the data require them.

    Where ``"auto"`` chooses lags, it also chooses decays that oscillate, see `add_oscillations`.

    The rates of the lags are fixed around the frequency of the modes. Sums of such decays approximate any other decay
    in this range. Estimated rates would become equal, or would fit noise.

    Parameters
    ----------
    problems : callable
        Returns the problem for a rate [rad/s] that scales K and D.
    guesses : sequence of (rate, theta)
        Start values.
    lags : int or "auto"
        Number of lags.

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
    larger, theta, _ = problem.with_decays(solved.theta, lag_rates(problem, solved, wanted).tolist())
    try:
        more = larger.solve(theta)
    except (np.linalg.LinAlgError, ValueError):
        more = None
    if more is None and lags != "auto":
        raise DataError(f"recording {problem.data[0].name!r}: no fit with {lags} lags; use fewer, or lags='auto'")
    if more is None or (lags == "auto" and schwarz(problem, solved) <= schwarz(larger, more)):
        return problem, solved
    return add_oscillations(larger, more) if lags == "auto" else (larger, more)


def lag_rates(problem: RingProblem, solved: SeparableFit, count: int) -> FloatArray:
    """Return the rates of a number of lags, in geometric steps around the modes [1/s]."""
    K, D = solved.theta[:4].reshape(2, 2), solved.theta[4:N_MECHANICAL].reshape(2, 2)
    middle = problem.scale.rate * float(np.abs(eigenvalues_of(-np.hstack([K, D]))).mean())
    steps = np.geomspace(_SLOWEST, _FASTEST, count) if count > 1 else np.array([np.sqrt(_SLOWEST * _FASTEST)])
    return np.asarray(middle * steps)


def _fit_modes(
    problems: Callable[[float], RingProblem], guesses: Sequence[tuple[float, FloatArray]]
) -> tuple[RingProblem, SeparableFit]:
    """Return the fit of two modes without lags, from the best of the guesses."""
    tries = []
    for rate, theta in guesses:
        with contextlib.suppress(np.linalg.LinAlgError, ValueError):  # the response of an unstable guess can overflow
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
