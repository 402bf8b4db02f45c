"""What both baselines share: the unknowns in order, their scales, the first state."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from benchmarks.case import N_STATES, STRUCTURE, Samples
from gbid.core.arrays import FloatArray


def names() -> list[str]:
    """Parameters in order."""
    return [q.name for q in STRUCTURE.parameters]


def scales(start: Mapping[str, float]) -> FloatArray:
    """Largest start value among the parameters of a kind; the disturbance gain, which starts at 0, as stiffness."""
    largest: dict[str, float] = {}
    for name, value in start.items():
        kind = name.split("_")[0]
        largest[kind] = max(largest.get(kind, 0.0), abs(value))
    largest["bd"] = 0.1 * largest["k"]
    return np.array([largest[name.split("_")[0]] for name in names()])


def start_state(samples: Samples) -> FloatArray:
    """The measured position, and nothing else."""
    return np.concatenate([samples.p[0], np.zeros(N_STATES - 2)])
