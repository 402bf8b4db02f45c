"""PRBS: hold, register and taps by the criterion of a design, amplitude by the limits."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy

from gbid.arrays import ComplexArray, FloatArray, IntArray
from gbid.errors import UsageError
from gbid.excite.design_goal import DesignGoal
from gbid.excite.excitation import ExcitationSequence
from gbid.excite.excitation_limits import ExcitationLimits
from gbid.excite.information.line_model import LineModel
from gbid.excite.signals.use_of_limits import use_of

_REGISTERS = range(4, 15)
_HOLDS = 10  # tried between a sample and a half period of the slowest mode
_LINES = 160
_HIGHEST = 0.45


class ChosenSequence(NamedTuple):
    """Sequence with its signal.

    Attributes
    ----------
    sequence : ExcitationSequence
        Hold, register, taps and amplitude.
    signal : (n_samples, n_inputs) array
        Inputs.
    """

    sequence: ExcitationSequence
    signal: FloatArray


def choose_prbs(
    goal: DesignGoal, lines: LineModel, limits: ExcitationLimits, n_samples: int, earlier: FloatArray
) -> ChosenSequence:
    """Return the sequence of maximal length with the best criterion within limits.

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

    Notes
    -----
    A sequence of each hold is as long as the recording allows, or half as long, with the taps of the register or their
    mirror image. All inputs have the same sequence, shifted by equal parts of its period. The information is that of
    the periodogram of the signal, summed around lines that are dense at the modes.
    """
    model = lines.known.model
    grid = _grid(lines, n_samples)
    at = lines.at(grid)
    frequency = np.fft.rfftfreq(n_samples, lines.sample_time)
    cell = np.searchsorted(np.sqrt(grid[1:] * grid[:-1]), np.maximum(frequency, 1e-9))
    n_u = model.B.shape[1]
    best: tuple[float, ChosenSequence] | None = None
    for sequence in _candidates(lines, n_samples, n_u):
        unit = _signal(sequence, n_samples, lines.sample_time)
        amplitude = 1 / max(use_of(limits, lines, unit).values())
        spectrum = np.fft.rfft(unit * amplitude, axis=0)[1:] * (2 / n_samples)
        loss = goal.loss(_information(at.sensitivity, spectrum, cell[1:], n_samples) + earlier)
        if best is None or loss < best[0]:
            best = loss, ChosenSequence(replace(sequence, amplitude=amplitude), unit * amplitude)
    if best is None or not np.isfinite(best[0]):
        raise UsageError(
            f"no PRBS of {n_samples * lines.sample_time:g} s determines all parameters; give a longer duration, or "
            "fix some parameters"
        )
    chosen = best[1]
    shrunk = min(1.0, 1 / max(use_of(limits, lines, chosen.signal, with_machines=True).values()))
    made = replace(chosen.sequence, amplitude=chosen.sequence.amplitude * shrunk)
    return ChosenSequence(made, chosen.signal * shrunk)


def _grid(lines: LineModel, n_samples: int) -> FloatArray:
    dt = lines.sample_time
    wanted = [np.geomspace(1 / (n_samples * dt), _HIGHEST / dt, _LINES // 2)]
    for frequency, damping in lines.known.model.modes():
        wanted.append(frequency * (1 + 6 * max(damping, 1e-3) * np.linspace(-1, 1, _LINES // 4)))
    found = np.unique(np.concatenate(wanted))
    return np.asarray(found[(found > 0) & (found <= _HIGHEST / dt)])


def _candidates(lines: LineModel, n_samples: int, n_inputs: int) -> list[ExcitationSequence]:
    dt = lines.sample_time
    slowest = min((frequency for frequency, _ in lines.known.model.modes()), default=1 / (n_samples * dt) * 20)
    longest = max(2, min(int(2.5 / (slowest * dt)), n_samples // 16))
    found = list[ExcitationSequence]()
    for hold in np.unique(np.round(np.geomspace(1, longest, _HOLDS)).astype(int)).tolist():
        fitting = [n for n in _REGISTERS if (2**n - 1) * hold <= n_samples]
        for register in fitting[-2:]:
            taps = tuple(int(tap) for tap in _TAPS[register])
            mirrored = tuple(sorted((register - tap for tap in taps), reverse=True))
            length = 2**register - 1
            shift = tuple(length * i // n_inputs for i in range(n_inputs))
            for own in {taps, mirrored}:
                found.append(ExcitationSequence(1.0, hold * dt, register, own, shift))
    return found


_TAPS = {
    4: (3,), 5: (3,), 6: (5,), 7: (6,), 8: (7, 6, 1), 9: (5,), 10: (7,), 11: (9,), 12: (11, 10, 4), 13: (12, 11, 8),
    14: (13, 12, 2),
}  # fmt: skip
"""Taps of registers of maximal length, as in scipy.signal.max_len_seq."""


def _signal(sequence: ExcitationSequence, n_samples: int, sample_time: float) -> FloatArray:
    bits = 2.0 * scipy.signal.max_len_seq(sequence.register, taps=np.array(sequence.taps))[0] - 1.0
    hold = round(sequence.hold_s / sample_time)
    columns = [np.resize(np.repeat(np.roll(bits, -shift), hold), n_samples) for shift in sequence.shift]
    return np.column_stack(columns) * sequence.amplitude


def _information(sensitivity: ComplexArray, spectrum: ComplexArray, cell: IntArray, n_samples: int) -> FloatArray:
    """Return the information of a signal whose lines count at the nearest line of a grid."""
    n_u = spectrum.shape[1]
    cross = np.zeros((len(sensitivity), n_u, n_u), complex)
    np.add.at(cross, cell, spectrum[:, :, None] * spectrum[:, None, :].conj())
    flat = np.einsum("fpyu,fuv,fqyv->pq", sensitivity, cross, sensitivity.conj(), optimize=True)
    return np.asarray(n_samples / 2 * flat.real)
