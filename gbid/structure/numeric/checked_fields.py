"""Checks of the fields of a linear model, and the read-only arrays and names that it keeps."""

from __future__ import annotations

from typing import Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.structure.numeric.sampled_run import check_sample_time
from gbid.structure.numeric.state_space import StateSpace


def checked_fields(model: StateSpace) -> dict[str, Any]:
    """Return the matrices of a model as read-only arrays, its delays, and its names with those that were not given.

    Raises
    ------
    UsageError
        As `LinearModel`.
    """
    if model.dt is not None:
        check_sample_time(model.name, model.dt)
    given = {letter: getattr(model, letter) for letter in "ABCDK"}
    matrices = {letter: np.atleast_2d(np.array(m, float)) for letter, m in given.items() if m is not None}
    n, n_u, n_y = matrices["A"].shape[0], matrices["B"].shape[1], matrices["C"].shape[0]
    expected = {"A": (n, n), "B": (n, n_u), "C": (n_y, n), "D": (n_y, n_u), "K": (n, n_y)}
    for letter, matrix in matrices.items():
        if matrix.shape != expected[letter]:
            raise UsageError(f"model {model.name!r}: {letter} has shape {matrix.shape}, expected {expected[letter]}")
        if not np.isfinite(matrix).all():
            raise UsageError(f"model {model.name!r}: {letter} holds entries that are not finite")
    arrays = {**matrices, **_checked_delay(model, n, n_u)}
    for array in arrays.values():
        array.setflags(write=False)
    counts = {"input_names": (n_u, "u"), "output_names": (n_y, "y"), "state_names": (n, "x")}
    return {**arrays, **{field: _names(model, field, *default) for field, default in counts.items()}}


def _checked_delay(model: StateSpace, n: int, n_u: int) -> dict[str, FloatArray]:
    if (model.delay is None) != (model.B_delayed is None):
        raise UsageError(f"model {model.name!r}: give both delay and B_delayed, or neither")
    if model.delay is None:
        return {}
    delay, B_delayed = np.array(model.delay, float), np.array(model.B_delayed, float)
    if delay.shape != (n_u,) or B_delayed.shape != (n, n_u):
        raise UsageError(
            f"model {model.name!r}: delay has shape {delay.shape} and B_delayed {B_delayed.shape}, "
            f"expected {(n_u,)} and {(n, n_u)}"
        )
    if model.dt is not None:
        raise UsageError(f"model {model.name!r}: exact delays are possible in continuous time only")
    if not (np.isfinite(B_delayed).all() and np.isfinite(delay).all() and (delay >= 0).all()):
        raise UsageError(f"model {model.name!r}: delays must be finite and not negative, B_delayed finite")
    return {"delay": delay, "B_delayed": B_delayed}


def _names(model: StateSpace, field: str, count: int, letter: str) -> tuple[str, ...]:
    names = tuple(getattr(model, field)) or tuple(f"{letter}{i + 1}" for i in range(count))
    if len(names) != count:
        raise UsageError(f"model {model.name!r}: {field} has {len(names)} names for {count}")
    return names
