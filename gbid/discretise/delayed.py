"""Exact discretisation of inputs that enter after a delay of any length."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gbid.discretise.dual import Dual
from gbid.discretise.expm import exponentials, squarings_for
from gbid.discretise.hold import Hold
from gbid.errors import UsageError


class Taps(NamedTuple):
    """How a delayed input drives the state: ``sum_i columns[i] u[k - shift + 1 - i]``.

    Attributes
    ----------
    shift : int
        Whole samples in the delay.
    columns : list of (n, 1) array or Dual
        For the samples ``k - shift + 1`` (first-order hold only, else zero), ``k - shift``, ``k - shift - 1``.
    """

    shift: int
    columns: list[Any]


def delayed_taps(A: Any, b: Any, delay: Any, sample_time: float, hold: Hold) -> Taps:
    """Discretise ``xd(t) = A x(t) + b u(t - delay)`` exactly for a held or interpolated input.

    Parameters
    ----------
    A : (n, n) array or Dual
    b : (n, 1) array or Dual
    delay : float or Dual of shape (1, 1)
        At least zero [s].
    sample_time : float
        ``h`` [s].
    hold : {"zoh", "foh"}

    Returns
    -------
    Taps

    Raises
    ------
    UsageError
        For a negative delay.

    Notes
    -----
    With ``delay = d h + e``, ``0 <= e < h``, the late input changes its piece at ``e`` within each sample.
    After ``e`` it lies on the piece that starts at ``u[k - d]``, before on the one from ``u[k - d - 1]``;
    each piece contributes by ``int_0^t e^(A s) ds = t phi_1(A t)`` and
    ``int_0^t e^(A (t - s)) s ds = t^2 phi_2(A t)``, the first carried on by ``e^(A (h - e))``. The result is
    continuous in the delay, across whole samples too.
    """
    h = sample_time
    seconds = float(delay.value[0, 0]) if isinstance(delay, Dual) else float(delay)
    if seconds < 0:
        raise UsageError(f"delay = {seconds:g} s; it must not be negative")
    shift = int(np.floor(seconds / h))
    early = delay - shift * h  # the part of the sample before the late input reaches its next piece
    late = h - early
    whole = _integrals(A, h)
    after = _integrals(A, late)
    held_after = after.first @ b
    held_before = whole.first @ b - held_after
    if hold == "zoh":
        return Taps(shift, [0.0 * held_after, held_after, held_before])
    before = _integrals(A, early)
    rise_after = (after.second @ b) * (1 / h)
    rise_before = (after.exp @ (before.second @ b)) * (1 / h) + held_before * (late * (1 / h))
    return Taps(shift, [rise_after, held_after - rise_after + rise_before, held_before - rise_before])


class _Integrals(NamedTuple):
    exp: Any  # e^(A t)
    first: Any  # int_0^t e^(A s) ds
    second: Any  # int_0^t e^(A (t - s)) s ds


def _integrals(A: Any, t: Any) -> _Integrals:
    Z = A * t
    squarings = squarings_for([Z.value if isinstance(Z, Dual) else Z])
    exp, phi1, phi2 = exponentials(Z, squarings)
    return _Integrals(exp, phi1 * t, phi2 * t * t)
