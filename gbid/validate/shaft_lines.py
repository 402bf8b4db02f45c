"""Lines of the shaft in the residuals of a fit: run-out that the prefilter left."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify import FitResult
from gbid.prefilter.residual import power_of
from gbid.prefilter.shaft import turns_per_second
from gbid.recording import Recording
from gbid.validate.residuals import residuals_of
from gbid.validate.validation_data import Ranges

CLEAR = 30.0
"""A line counts when its power is this many times the usual power beside it. Of 50 lines in noise, none does with a
probability of more than 0.999."""
MOST = 50
"""Largest order that is looked at."""


class ShaftLine(NamedTuple):
    """Line at a multiple of the shaft frequency.

    Attributes
    ----------
    output : str
        Name of the output.
    order : int
        Multiple of the shaft frequency.
    frequency_hz : float
        Frequency.
    rms : float
        Size, in the unit of the output.
    """

    output: str
    order: int
    frequency_hz: float
    rms: float


def shaft_lines(result: FitResult, recording: Recording, left_out: Ranges = ()) -> list[ShaftLine]:
    """Return the largest line of the shaft in the residuals of each output, where one is clear.

    Parameters
    ----------
    result : FitResult
        The fit.
    recording : Recording
        A recording of it, with the shaft angle phi.
    left_out : sequence of (start, stop)
        Ranges of samples that do not count.

    Returns
    -------
    list of ShaftLine
        Empty for a shaft at rest, and without phi.

    Raises
    ------
    DataError
        When the recording lacks a signal, or when the predictions overflow.
    """
    turning = turns_per_second(recording)
    if turning is None:
        return []
    error, names = residuals_of(result, recording, left_out)
    power, frequency = power_of(error - error.mean(axis=0), recording.sample_time)
    found = []
    for j, name in enumerate(names):
        lines = _lines(power[:, j], frequency, turning)
        if lines:
            order, rms = max(lines, key=lambda line: line[1])
            found.append(ShaftLine(name, order, order * turning, rms))
    return found


def _lines(power: FloatArray, frequency: FloatArray, turning: float) -> list[tuple[int, float]]:
    """Return order and rms of the clear lines."""
    step = frequency[0]
    lines = []
    for order in range(1, min(MOST, int(frequency[-1] / turning)) + 1):
        at = round(order * turning / step) - 1
        width = max(8, round(0.4 * turning / step))
        near = power[max(0, at - 2) : at + 3]
        beside = np.concatenate([power[max(0, at - width) : max(0, at - 2)], power[at + 3 : at + 3 + width]])
        # The usual power of a periodogram: its median over ln 2, because it is chi-square with two degrees of freedom.
        usual = float(np.median(beside)) / np.log(2) if beside.size else np.inf
        if near.size and near.max() > CLEAR * usual:
            lines.append((order, float(np.sqrt(near.sum()))))
    return lines
