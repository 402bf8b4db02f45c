"""Measured and simulated curves of a fit, small enough for a page with hundreds of them."""

from __future__ import annotations

from base64 import b64encode
from typing import Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.validate import Validation

SAMPLES = 1200
"""Number of samples in the part shown."""
POINTS = 600
"""Largest number of points of a curve."""
BINS = 240
"""Number of intervals of the whole recording for which the range of the error is stored."""
_LARGEST = 32767


def trace(validation: Validation, from_s: float | None = None) -> dict[str, Any]:
    """Return a part of a validation, and the range of its error over the whole recording.

    Parameters
    ----------
    validation : Validation
        The validation.
    from_s : float, optional
        Start of the part [s]; by default a third of the recording, also when too few samples follow.

    Returns
    -------
    dict
        recording; start, step, duration [s]; outputs, each with name, unit, n, measured, simulated, and error_n,
        error_low, error_high. Lengths are in micrometres. Curves are in the form of `packed`.
    """
    time, n = validation.time, len(validation.time)
    first = n // 3 if from_s is None else int(np.searchsorted(time, from_s))
    first = max(0, min(first, n - SAMPLES))
    every = max(1, min(SAMPLES, n) // POINTS)
    part = slice(first, first + SAMPLES, every)
    edges = np.linspace(0, n, min(BINS, n) + 1).astype(int)[:-1]
    outputs = []
    for i, (name, unit) in enumerate(zip(validation.output_names, validation.output_units, strict=True)):
        factor, shown = (1e6, "µm") if unit == "m" else (1.0, unit or "-")
        measured, simulated = factor * validation.measured[:, i], factor * validation.simulated[:, i]
        error = measured - simulated
        outputs.append(
            {
                "name": name,
                "unit": shown,
                "n": len(measured[part]),
                "measured": packed(measured[part]),
                "simulated": packed(simulated[part]),
                "error_n": len(edges),
                "error_low": packed(np.minimum.reduceat(error, edges)),
                "error_high": packed(np.maximum.reduceat(error, edges)),
            }
        )
    step = float(time[1] - time[0]) if n > 1 else 0.0
    return {
        "recording": validation.recording,
        "start": float(time[first]),
        "step": every * step,
        "duration": n * step,
        "outputs": outputs,
    }


def packed(values: FloatArray) -> dict[str, Any]:
    """Return a curve as base64 of little-endian 16-bit integers, and the factor from these to the values."""
    largest = float(np.abs(values).max(initial=0.0))
    scale = largest / _LARGEST if largest > 0 else 1.0
    whole = np.round(values / scale).astype("<i2")
    return {"scale": scale, "values": b64encode(whole.tobytes()).decode("ascii")}
