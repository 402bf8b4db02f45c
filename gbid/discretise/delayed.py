"""Exact discretisation of inputs with any delay."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gbid.discretise.dual import Dual
from gbid.discretise.expm import each, exponentials, squarings_for
from gbid.discretise.hold import Hold
from gbid.errors import UsageError


class Taps(NamedTuple):
    """Discrete-time effect of a delayed input on the state: ``sum_i columns[i] u[k - shift + 1 - i]``.

    Attributes
    ----------
    shift : int
        Whole samples in the delay.
    columns : list of (n, 1) array or Dual
        Columns for the samples ``k - shift + 1`` (first-order hold only, else zero), ``k - shift``, ``k - shift - 1``.
    """

    shift: int
    columns: list[Any]


def delayed_taps(
    A: Any, b: Any, delay: Any, sample_time: float, hold: Hold, *, near: tuple[float, int] | None = None
) -> Taps:
    """Return the exact discretisation of ``xd(t) = A x(t) + b u(t - delay)`` for a held or interpolated input.

    Parameters
    ----------
    A : (n, n) array, Dual or casadi.SX
        System matrix [1/s].
    b : (n, 1) array, Dual or casadi.SX
        Input column.
    delay : float, or Dual or casadi.SX of shape (1, 1)
        Delay, at least zero [s]. Of a dual at several points, the delay at the first point sets the whole samples.
    sample_time : float
        Time between samples ``h`` [s].
    hold : {"zoh", "foh"}
        Zero- or first-order hold of the input.
    near : (float, int), optional
        For symbols: a delay [s] with the same whole samples, and the number of doublings (see `squarings_for`).

    Returns
    -------
    Taps

    Raises
    ------
    UsageError
        When the delay is negative.

    Notes
    -----
    With ``delay = d h + e``, ``0 <= e < h``, the delayed input changes to its next piece at ``e`` within each sample.
    After ``e`` it is on the piece that starts at ``u[k - d]``, before ``e`` on the one that starts at ``u[k - d - 1]``.
    Each piece contributes ``int_0^t e^(A s) ds = t phi_1(A t)`` and ``int_0^t e^(A (t - s)) s ds = t^2 phi_2(A t)``;
    the first piece is then multiplied by ``e^(A (h - e))``. The result is a continuous function of the delay, also at
    whole samples.
    """
    h = sample_time
    doublings = None if near is None else near[1]
    seconds = near[0] if near else float(delay.value.flat[0]) if isinstance(delay, Dual) else float(delay)
    if seconds < 0:
        raise UsageError(f"delay = {seconds:g} s; it must not be negative")
    shift = int(np.floor(seconds / h))
    early = delay - shift * h  # time in the sample before the delayed input changes to its next piece
    late = h - early
    whole = _integrals(A, h, doublings)
    after = _integrals(A, late, doublings)
    held_after = after.first @ b
    held_before = whole.first @ b - held_after
    if hold == "zoh":
        return Taps(shift, [0.0 * held_after, held_after, held_before])
    before = _integrals(A, early, doublings)
    rise_after = (after.second @ b) * (1 / h)
    rise_before = (after.exp @ (before.second @ b)) * (1 / h) + held_before * (late * (1 / h))
    return Taps(shift, [rise_after, held_after - rise_after + rise_before, held_before - rise_before])


class _Integrals(NamedTuple):
    exp: Any  # e^(A t)
    first: Any  # int_0^t e^(A s) ds
    second: Any  # int_0^t e^(A (t - s)) s ds


def _integrals(A: Any, t: Any, squarings: int | None) -> _Integrals:
    Z = A * t
    if squarings is None:
        squarings = squarings_for(each(Z))
    exp, phi1, phi2 = exponentials(Z, squarings)
    return _Integrals(exp, phi1 * t, phi2 * t * t)
