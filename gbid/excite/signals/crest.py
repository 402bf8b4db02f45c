"""Small peaks: amplitudes and phases of a multisine by descent of the criterion at equal peaks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from gbid.arrays import ComplexArray, FloatArray, IntArray
from gbid.excite.design_goal import DesignGoal
from gbid.excite.excitation_limits import LimitedSignal

_OF_PHASES = (4.0, 10.0, 24.0)
_OF_BOTH = (24.0, 60.0, 150.0)
_STARTS = 2
_OPTIONS = {"maxiter": 50}
_PER_CYCLE = 8  # points in a cycle of the highest line: more would see a higher peak by less than a hundredth


class Waves:
    """Limited signals over one period as functions of the amplitudes of all lines.

    Parameters
    ----------
    limited : sequence of LimitedSignal
        Signals over their limits.
    bins : (n_lines,) integer array
        Lines as multiples of one over the period.
    """

    def __init__(self, limited: Sequence[LimitedSignal], bins: IntArray) -> None:
        n = int(min(8192, 2 ** np.ceil(np.log2(_PER_CYCLE * bins.max()))))
        self._turn = np.exp(2j * np.pi * np.outer(np.arange(n) / n, bins))
        self._rows = np.concatenate([each.response for each in limited], axis=1)  # (n_lines, n_channels, n_inputs)
        self._first = np.cumsum([0, *(each.response.shape[1] for each in limited)])[:-1]

    def norm(self, spectrum: ComplexArray, exponent: float) -> tuple[float, ComplexArray]:
        """Return a norm of all signals over time, which tends to the largest peak, and its slope by the spectrum.

        The slope g is that of ``norm(U + dU) = norm(U) + Re sum conj(g) dU``.
        """
        lines = np.einsum("fcu,fu->fc", self._rows, spectrum)
        values = np.asarray((self._turn @ lines).real)
        squares = np.add.reduceat(values**2, self._first, axis=1)
        top = squares.max()
        if np.isinf(exponent):
            return float(np.sqrt(top)), np.zeros_like(spectrum)
        powers = (squares / top) ** (exponent / 2)
        mean = float(powers.sum() / len(powers))
        size = np.sqrt(top) * mean ** (1 / exponent)
        inner = powers / np.maximum(squares, 1e-300) * (size / (mean * len(powers)))
        widths = np.diff([*self._first, values.shape[1]])
        back = self._turn.conj().T @ (values * np.repeat(inner, widths, axis=1))
        return float(size), np.einsum("fcu,fc->fu", self._rows.conj(), back)


def with_small_peaks(
    goal: DesignGoal,
    sensitivity: ComplexArray,
    limited: Sequence[LimitedSignal],
    bins: IntArray,
    spectrum: ComplexArray,
    n_samples: int,
    earlier: FloatArray,
) -> ComplexArray:
    """Return the amplitudes of a multisine whose largest peak is one, with the best criterion nearby.

    First the phases alone are moved by the steepest norm of the signals (Guillaume, Schoukens, Pintelon and Kollar
    1991). Then amplitudes and phases together are moved by the criterion of the signal at its largest peak.

    Parameters
    ----------
    goal : DesignGoal
        The criterion.
    sensitivity : (n_lines, n_free, n_outputs, n_inputs) array
        Sensitivities at the lines.
    limited : sequence of LimitedSignal
        Signals over their limits.
    bins : (n_lines,) integer array
        Lines as multiples of one over the period.
    spectrum : (n_lines, n_inputs) array
        Amplitudes to start from.
    n_samples : int
        Length of the recording.
    earlier : (n_free, n_free) array
        Information that is there without the excitation.

    Returns
    -------
    (n_lines, n_inputs) array
    """
    waves = Waves(limited, bins)
    psi = np.sqrt(n_samples / 2) * sensitivity
    first = _schroeder(np.sum(abs(spectrum) ** 2, axis=1))
    random = np.random.default_rng(len(bins)).uniform(-np.pi, np.pi, (_STARTS - 1, len(bins)))
    tried = [_descended(goal, waves, psi, spectrum, angle, earlier) for angle in (first, *random)]
    return min(tried, key=lambda each: each[0])[1]


def _descended(
    goal: DesignGoal, waves: Waves, psi: ComplexArray, spectrum: ComplexArray, angle: FloatArray, earlier: FloatArray
) -> tuple[float, ComplexArray]:
    """Return criterion and amplitudes of the descent from given phases."""
    start = spectrum

    def of_phases(angle: FloatArray, exponent: float) -> tuple[float, FloatArray]:
        turned: ComplexArray = start * np.exp(1j * angle)[:, None]
        size, slope = waves.norm(turned, exponent)
        return np.log(size), np.sum(slope.conj() * 1j * turned, axis=1).real / size

    for exponent in _OF_PHASES:
        angle = scipy.optimize.minimize(of_phases, angle, (exponent,), jac=True, method="L-BFGS-B", options=_OPTIONS).x
    found = start * np.exp(1j * angle)[:, None]

    def of_both(flat: FloatArray, exponent: float, scale: FloatArray) -> tuple[float, FloatArray]:
        own = _complex(flat, found.shape) * scale
        size, slope = waves.norm(own, exponent)
        moved = np.einsum("fpyu,fu->pfy", psi, own)
        columns = moved.reshape(len(moved), -1) / size
        raw = (columns @ columns.conj().T).real
        P = goal.gradient(raw + earlier)
        value = goal.loss(raw + earlier)
        pushed = np.einsum("fpyu,pfy->fu", psi.conj(), (P @ columns).reshape(moved.shape)) / size
        total = 2 * np.sum(P * raw) * slope / size - 2 * pushed
        return value, np.ascontiguousarray(total * scale).view(float).ravel()

    # Scaled by their size, strong and weak lines turn alike.
    for exponent in _OF_BOTH:
        found = found / waves.norm(found, exponent)[0]
        scale = np.linalg.norm(found, axis=1)[:, None]
        flat = np.ascontiguousarray(found / scale).view(float).ravel()
        moved = scipy.optimize.minimize(
            of_both, flat, (exponent, scale), jac=True, method="L-BFGS-B", options=_OPTIONS
        ).x
        found = _complex(moved, found.shape) * scale
    found = found / waves.norm(found, np.inf)[0]
    moved = np.einsum("fpyu,fu->pfy", psi, found).reshape(psi.shape[1], -1)
    return goal.loss((moved @ moved.conj().T).real + earlier), found


def _complex(flat: FloatArray, shape: tuple[int, ...]) -> ComplexArray:
    return np.ascontiguousarray(flat).view(complex).reshape(shape)


def _schroeder(power: FloatArray) -> FloatArray:
    """Return phases that spread the lines over the period (Schroeder 1970)."""
    share = np.concatenate([[0.0], np.cumsum(power / power.sum())[:-1]])
    return np.asarray(-2 * np.pi * np.cumsum(share))
