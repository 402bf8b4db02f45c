"""Multisine: lines, optimal spectrum, and amplitudes with small peaks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gbid.arrays import ComplexArray, FloatArray, IntArray
from gbid.excite.design_goal import DesignGoal
from gbid.excite.excitation_limits import ExcitationLimits, LimitedSignal, limited_signals
from gbid.excite.information.line_model import LineModel
from gbid.excite.signals.crest import with_small_peaks
from gbid.excite.signals.spectrum_design import optimal_spectrum
from gbid.excite.signals.use_of_limits import disc_in_machines, use_of

PERIOD_S = 1.0
"""Longest period of a multisine [s]: lines are a multiple of its inverse apart."""
_ALONG, _NEAR = 40, 24  # lines over the whole range, and lines around each mode
_WIDTH = 5.0  # half bandwidths around a mode
_HIGHEST = 0.4  # of the sampling frequency
_LEAST = 1e-3  # part of the information of a line or direction that is left out: it would only make peaks
_ROUNDS = 2
_CREST = 1.8  # of a signal whose phases are not known yet
_HARDEST = 8  # machines that are designed for; the others are only checked


class Multisine(NamedTuple):
    """Multisine at its limits.

    Attributes
    ----------
    bins : (n_lines,) integer array
        Lines as multiples of one over the period.
    period : int
        Samples of the period.
    spectrum : (n_lines, n_inputs) array
        Amplitudes: one period is ``Re sum U exp(2 pi j bin k / period)``.
    gap : float
        Certificate of the spectrum, see `Spectrum`.
    """

    bins: IntArray
    period: int
    spectrum: ComplexArray
    gap: float

    def signal(self, n_samples: int) -> FloatArray:
        """Return the inputs, (n_samples, n_inputs)."""
        flat = np.zeros((self.period // 2 + 1, self.spectrum.shape[1]), complex)
        flat[self.bins] = self.spectrum * (self.period / 2)
        return np.resize(np.fft.irfft(flat, self.period, axis=0), (n_samples, self.spectrum.shape[1]))


def design_multisine(
    goal: DesignGoal, lines: LineModel, limits: ExcitationLimits, n_samples: int, earlier: FloatArray
) -> Multisine:
    """Return the multisine with the best criterion within limits.

    The spectrum is designed on every second multiple of one over the period, with the full cross spectrum of the
    inputs. A line whose inputs should not be coherent gives its second direction to the free multiple above it
    (interleaved lines). Peaks are not known before the phases are. So spectrum and phases are found in turn: the second
    spectrum knows the crest factors of the first.

    Parameters
    ----------
    goal : DesignGoal
        The criterion.
    lines : LineModel
        The model.
    limits : ExcitationLimits
        The limits.
    n_samples : int
        Length of the recording.
    earlier : (n_free, n_free) array
        Information that is there without the excitation.
    """
    dt = lines.sample_time
    period = n_samples // max(1, round(n_samples * dt / PERIOD_S))
    coarse = 2 * _candidates(lines, period * dt)
    frequency = coarse / (period * dt)
    at = lines.at(frequency)
    hard: list[int] = []
    crest = dict[str, float]()
    for round_ in range(_ROUNDS):
        limited = _limited(limits, lines, frequency, at.response, hard)
        costs: ComplexArray = np.array(
            [
                crest.get(each.name, _CREST) ** 2 * each.response.conj().transpose(0, 2, 1) @ each.response
                for each in limited
            ]
        )
        found = optimal_spectrum(goal, at.sensitivity / np.sqrt(2), costs / 2, n_samples, earlier)
        bins, spectrum = _interleaved(coarse, found.cross, found.sensitivity)
        own = lines.at(bins / (period * dt))
        limited = _limited(limits, lines, own.frequency_hz, own.response, hard)
        spectrum = with_small_peaks(goal, own.sensitivity, limited, bins, spectrum, n_samples, earlier)
        made = Multisine(bins, period, spectrum, found.gap)
        made = made._replace(spectrum=spectrum / max(use_of(limits, lines, made.signal(period)).values()))
        crest = {each.name: _crest(each, made) for each in limited}
        if limits.machines and round_ < _ROUNDS - 1:
            use = np.array(list(disc_in_machines(limits, lines, bins, made.spectrum, period)))
            hard = sorted(np.argsort(-use)[:_HARDEST].tolist())
    shrunk = min(1.0, 1 / max(use_of(limits, lines, made.signal(period), with_machines=True).values()))
    return made._replace(spectrum=made.spectrum * shrunk)


def _crest(signal: LimitedSignal, made: Multisine) -> float:
    """Return the largest value of a limited signal over its root mean square."""
    flat = np.zeros((made.period // 2 + 1, signal.response.shape[1]), complex)
    flat[made.bins] = np.einsum("fcu,fu->fc", signal.response, made.spectrum)
    way = np.linalg.norm(np.fft.irfft(flat, made.period, axis=0), axis=1)
    return float(way.max() / np.sqrt(np.mean(way**2)))


def _limited(
    limits: ExcitationLimits, lines: LineModel, frequency_hz: FloatArray, response: ComplexArray, hard: Sequence[int]
) -> list[LimitedSignal]:
    """Return the limited signals, with those of the machines that come closest to the wall."""
    chosen = replace(limits, machines=tuple(limits.machines[i] for i in hard))
    others = [lines.response(frequency_hz, dict(machine.parameters)) for machine in chosen.machines]
    return limited_signals(chosen, lines.known, response, others)


def _candidates(lines: LineModel, period_s: float) -> IntArray:
    """Return lines as multiples of two over the period: some over the whole range, more around the modes."""
    top = _HIGHEST / lines.sample_time
    wanted = [np.geomspace(2 / period_s, top, _ALONG)]
    for frequency, damping in lines.known.model.modes():
        width = max(_WIDTH * damping * frequency, 4 / period_s)
        wanted.append(frequency + width * np.linspace(-1, 1, _NEAR))
    multiples = np.round(np.concatenate(wanted) * period_s / 2)
    return np.unique(multiples[(multiples >= 1) & (multiples * 2 / period_s <= top)]).astype(np.int64)


def _interleaved(bins: IntArray, cross: ComplexArray, sensitivity: ComplexArray) -> tuple[IntArray, ComplexArray]:
    """Return lines of one direction each: the first direction of each cross spectrum, and the second one line above.

    Those that hardly inform are left out.
    """
    values, vectors = np.linalg.eigh(cross)
    informs = values * np.einsum("fui,fuv,fvi->fi", vectors.conj(), sensitivity, vectors).real
    least = _LEAST * informs.sum()
    at, amplitude = list[int](), list[ComplexArray]()
    for line, size, direction, told in zip(bins.tolist(), values, vectors, informs, strict=True):
        for above, i in enumerate(range(len(size) - 1, max(len(size) - 3, -1), -1)):
            if told[i] > least:
                at.append(line + above)
                amplitude.append(np.sqrt(2 * size[i]) * direction[:, i])
    return np.array(at, dtype=np.int64), np.array(amplitude)
