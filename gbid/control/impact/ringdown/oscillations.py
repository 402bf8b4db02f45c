"""Decays that oscillate, beside the two modes of a ring-down: a loop may have more modes that ring than two."""

from __future__ import annotations

import numpy as np
import scipy

from gbid.arrays import FloatArray
from gbid.control.impact.ringdown.basis import N_MECHANICAL
from gbid.control.impact.ringdown.separable import RingProblem, SeparableFit
from gbid.control.impact.ringdown.start import eigenvalues_of

_MOST = 2
"""Largest number of decays that oscillate."""
_RATIOS = (0.5, 0.7, 1.0, 1.4, 2.0, 3.0, 5.0)
"""Frequencies at which the search starts, over that of the modes."""
_START_DAMPING = 0.6
_DAMPING = (0.02, 0.98)
_EVALUATIONS = 40


def add_oscillations(problem: RingProblem, solved: SeparableFit) -> tuple[RingProblem, SeparableFit]:
    """Return the fit with up to two further decays that oscillate, as many as Schwarz's criterion selects.

    A loop with filters rings in more modes than two. If they are left out, the damping of the two modes can be a fifth
    too low. Frequency and damping of a further decay are those that reduce the residuals most with the two modes as
    they are. Then all other parameters are fitted together. Such a decay stands for all modes that are not fitted. It
    need not be one of them.
    """
    for _ in range(_MOST):
        rate = _best_rate(problem, solved)
        larger, theta, _ = problem.with_decays(solved.theta, [*problem.rates, rate])
        try:
            more = larger.solve(theta)
        except (np.linalg.LinAlgError, ValueError):
            break
        if schwarz(problem, solved) <= schwarz(larger, more):
            break
        problem, solved = larger, more
    return problem, solved


def oscillations(problem: RingProblem) -> FloatArray:
    """Return natural frequency [Hz] and damping factor of the decays that oscillate, shape (n, 2)."""
    found = [(abs(rate) / (2 * np.pi), rate.real / abs(rate)) for rate in problem.rates if rate.imag]
    return np.array(found).reshape(-1, 2)


def schwarz(problem: RingProblem, solved: SeparableFit) -> float:
    """Return Schwarz's criterion (BIC) up to a constant; residuals below 1e-6 of the signal count as rounding."""
    n = problem.n_values
    parameters = len(solved.theta) + problem.n_linear + 2 * len(oscillations(problem))
    return float(n * np.log(max(solved.at.squares / n, 1e-12)) + np.log(n) * parameters)


def _best_rate(problem: RingProblem, solved: SeparableFit) -> complex:
    """Return the rate of the decay that reduces the residuals most, with the two modes as they are."""
    K, D = solved.theta[:4].reshape(2, 2), solved.theta[4:N_MECHANICAL].reshape(2, 2)
    middle = problem.scale.rate * float(np.abs(eigenvalues_of(-np.hstack([K, D]))).mean())

    def rate_of(v: FloatArray) -> complex:
        size, damping = np.exp(v[0]), float(np.clip(v[1], *_DAMPING))
        return complex(size * damping, size * np.sqrt(1 - damping**2))

    def squares(v: FloatArray) -> float:
        outside = max(_DAMPING[0] - v[1], v[1] - _DAMPING[1], 0.0)
        left = problem.with_decays(solved.theta, [*problem.rates, rate_of(v)])[2]
        return left * (1.0 + float(outside))

    starts = [np.array([np.log(middle * ratio), _START_DAMPING]) for ratio in _RATIOS]
    start = min(starts, key=squares)
    corners = start + np.array([[0.0, 0.0], [0.3, 0.0], [0.0, -0.25]])
    options = {"maxfev": _EVALUATIONS, "initial_simplex": corners}
    return rate_of(scipy.optimize.minimize(squares, start, method="Nelder-Mead", options=options).x)
