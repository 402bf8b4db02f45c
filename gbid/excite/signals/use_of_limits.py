"""Use of the limits: the largest value of each limited signal over its limit."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gbid.arrays import ComplexArray, FloatArray, IntArray
from gbid.excite.excitation_limits import SAFE, ExcitationLimits
from gbid.excite.information.line_model import LineModel

_SEEN = 1e-4  # lines of the disc below this part of its largest one do not count in other machines
IN_MACHINES = "clearance in all machines"
"""Name of the limit of the other machines."""


def use_of(
    limits: ExcitationLimits, lines: LineModel, signal: FloatArray, with_machines: bool = False
) -> dict[str, float]:
    """Return the largest value of each limited signal over the part of its limit that a design uses.

    The signal is periodic, and its transient has passed.

    Parameters
    ----------
    limits : ExcitationLimits
        The limits.
    lines : LineModel
        The model.
    signal : (n_samples, n_inputs) array
        Inputs.
    with_machines : bool
        Whether the machines of the limits count, too.
    """
    known = lines.known
    twice = np.vstack([signal, signal])
    outputs = known.model.simulate(twice, lines.sample_time, intersample=known.intersample)[len(signal) :]
    found = dict[str, float]()
    for name, limit in limits.peaks.items():
        is_input, columns = known.channels(name)
        labels = known.model.input_names if is_input else known.model.output_names
        for i in columns:
            found[labels[i]] = float(np.abs((signal if is_input else outputs)[:, i]).max() / (SAFE * limit))
    for name, limit in limits.radius.items():
        is_input, columns = known.channels(name)
        way = np.linalg.norm((signal if is_input else outputs)[:, columns], axis=1).max()
        found[f"radius of {name}"] = float(way / (SAFE * limit))
    if limits.clearance is not None:
        columns = known.channels(limits.disc)[1]
        way = np.linalg.norm(outputs[:, columns], axis=1).max()
        found["clearance"] = float(way / (SAFE * (limits.clearance - limits.taken)))
        if with_machines and limits.machines:
            found[IN_MACHINES] = float(max(disc_in_machines(limits, lines, *_lines_of(lines, signal, columns))))
    return found


def disc_in_machines(
    limits: ExcitationLimits, lines: LineModel, bins: IntArray, spectrum: ComplexArray, period: int
) -> Iterator[float]:
    """Yield the largest radius of the disc in each machine of the limits, over what is left of its clearance.

    Parameters
    ----------
    limits : ExcitationLimits
        Limits with a clearance.
    lines : LineModel
        The model.
    bins : (n_lines,) integer array
        Lines as multiples of one over the period.
    spectrum : (n_lines, n_inputs) array
        Their amplitudes.
    period : int
        Samples of the period.
    """
    assert limits.clearance is not None
    columns = lines.known.channels(limits.disc)[1]
    frequency = bins / (period * lines.sample_time)
    for machine in limits.machines:
        response = lines.response(frequency, dict(machine.parameters))[:, columns]
        flat = np.zeros((period // 2 + 1, len(columns)), complex)
        flat[bins] = np.einsum("fcu,fu->fc", response, spectrum) * (period / 2)
        way = np.linalg.norm(np.fft.irfft(flat, period, axis=0), axis=1).max()
        yield float(way / (SAFE * (limits.clearance - machine.taken)))


def _lines_of(lines: LineModel, signal: FloatArray, columns: list[int]) -> tuple[IntArray, ComplexArray, int]:
    """Return the lines of a signal that move the disc."""
    n = len(signal)
    bins = np.arange(1, n // 2)
    spectrum = np.fft.rfft(signal, axis=0)[bins] * (2 / n)
    strong = np.abs(spectrum).max(axis=1) > _SEEN * np.abs(spectrum).max()
    bins, spectrum = bins[strong], spectrum[strong]
    response = lines.response(bins / (n * lines.sample_time))[:, columns]
    moved = np.linalg.norm(np.einsum("fcu,fu->fc", response, spectrum), axis=1)
    seen = moved > _SEEN * moved.max()
    return bins[seen].astype(np.int64), spectrum[seen], n
