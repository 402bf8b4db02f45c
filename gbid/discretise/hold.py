"""Exact discretisation of a linear system whose inputs are held or interpolated between samples."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args

import casadi as ca
import numpy as np

from gbid.arrays import ComplexArray, FloatArray
from gbid.discretise.expm import each, exponentials, squarings_for
from gbid.errors import UsageError

Hold = Literal["zoh", "foh"]
"""Inter-sample behaviour of an input: constant (zero-order hold) or on a straight line (first-order hold)."""


class Discrete(NamedTuple):
    """Discrete-time system ``x[k+1] = F x[k] + G_now u[k] + G_next u[k+1]``.

    Attributes
    ----------
    F : (n, n)
        System matrix.
    G_now, G_next : (n, n_inputs)
        Input matrices; `G_next` has zero columns for inputs with zero-order hold.
    """

    F: Any
    G_now: Any
    G_next: Any


def check_holds(hold: str | Sequence[str], n_inputs: int) -> tuple[Hold, ...]:
    """Return one hold per input, from one name or a sequence of names.

    Raises
    ------
    UsageError
        When a name is unknown, or when the sequence has the wrong length.
    """
    holds = (hold,) * n_inputs if isinstance(hold, str) else tuple(hold)
    for name in holds:
        if name not in get_args(Hold):
            raise UsageError(f"intersample = {name!r}; choose 'zoh' or 'foh'")
    if len(holds) != n_inputs:
        raise UsageError(f"intersample names {len(holds)} inputs; there are {n_inputs}")
    return holds  # type: ignore[return-value]


def hold_response(cycles: FloatArray, holds: Sequence[str]) -> ComplexArray:
    """Return the frequency response of the hold of each input.

    Parameters
    ----------
    cycles : (n,) array
        Frequencies times the sample time.
    holds : sequence of {"zoh", "foh"}
        Hold of each input.

    Returns
    -------
    (n, n_inputs) complex array
        ``(1 - exp(-s T)) / (s T)`` of the zero-order hold; of the first-order hold the square of its magnitude.
    """
    flat = np.sinc(cycles) * np.exp(-1j * np.pi * cycles)
    return np.column_stack([flat if hold == "zoh" else np.sinc(cycles) ** 2 for hold in holds])


def discretise(
    A: Any, B: Any, sample_time: float, hold: str | Sequence[str] = "zoh", squarings: int | None = None
) -> Discrete:
    """Return the exact discretisation of ``xd = A x + B u`` for the given hold.

    Parameters
    ----------
    A : (n, n) casadi.SX, numpy array or Dual
        System matrix [1/s].
    B : (n, n_inputs) casadi.SX, numpy array or Dual
        Input matrix.
    sample_time : float
        Time between samples ``h`` [s].
    hold : {"zoh", "foh"} or sequence of these
        Hold of all inputs, or of each.
    squarings : int, optional
        Number of doublings; required for a symbolic `A` only (see `gbid.discretise.squarings_for`). For a numeric `A`
        it is computed.

    Returns
    -------
    Discrete
        Of the same type as `A`.

    Raises
    ------
    UsageError
        When the hold is unknown, or when `A` is symbolic and `squarings` is not given.

    Notes
    -----
    With first-order hold ``u(s) = u[k] + (u[k+1] - u[k]) s / h``, so that ``G_next = h phi_2(A h) B`` and
    ``G_now = h (phi_1(A h) - phi_2(A h)) B``. With zero-order hold ``G_now = h phi_1(A h) B``.
    """
    holds = check_holds(hold, B.shape[1])
    numeric = not isinstance(A, ca.SX)
    if squarings is None:
        if not numeric:
            raise UsageError("a symbolic matrix needs the number of squarings; take it from squarings_for")
        squarings = squarings_for(each(A * sample_time))
    exp, phi1, phi2 = exponentials(A * sample_time, squarings)
    linear: Any = np.diag([float(h == "foh") for h in holds])
    if not numeric:
        linear = ca.sparsify(ca.SX(linear))
    held = sample_time * (phi1 @ B)
    next_part = sample_time * (phi2 @ (B @ linear))
    return Discrete(exp, held - next_part, next_part)
