"""Types of arrays, for annotations, and checks of numbers."""

from __future__ import annotations

from math import isfinite
from typing import TypeGuard

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


def is_finite(value: object) -> TypeGuard[float]:
    """Return whether a value is one finite number; text, None, flags and lists are not."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool) and isfinite(value)


def is_whole(value: object, least: int) -> bool:
    """Return whether a value is one whole number of at least some size; flags are not."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and int(value) >= least
