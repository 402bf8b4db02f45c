"""Exact discretisation of linear systems: matrix exponentials, holds, delays, irregular times, linear recursion.

With ``phi_1(Z) = int_0^1 e^(Z s) ds`` and ``phi_2(Z) = int_0^1 (1 - s) e^(Z s) ds``, the response of
``xd = A x + B u`` over one sample consists of ``e^(A h)``, ``h phi_1(A h) B`` and ``h phi_2(A h) B``.
All three follow from one Taylor polynomial of ``phi_2`` at ``Z / 2^s`` and `s` doublings:

    phi_1 = I + Z phi_2,   e^Z = I + Z phi_1,
    phi_2(2 Z) = (phi_1(Z)^2 + 2 phi_2(Z)) / 4,   phi_1(2 Z) = (e^Z + I) phi_1(Z) / 2.

The number of doublings must be known when a symbolic graph is built. It is therefore computed before from numeric
samples of the matrix, after Al-Mohy and Higham (2009), from the norms of powers of the balanced matrix. These norms
depend on the fastest pole and not on the scaling of the states.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache
from math import factorial, prod
from typing import Any, Literal, NamedTuple, get_args

import casadi as ca
import numpy as np
import scipy

from gbid.core.arrays import ComplexArray, FloatArray, IntArray
from gbid.core.compiled import CompilerMissingError, c_source, load_library, run_compiled
from gbid.core.errors import UsageError
from gbid.discretise.dual import Dual

TAYLOR_ORDER = 15  # 1 / 18! is below the rounding of a double, so this order suffices when the norm is at most one
LARGEST = 20  # states, with more of which products by BLAS are faster than those of dual_predictor.c
NUMBER = 9  # largest size of a number of dual_predictor.c: its value and its derivatives by eight parameters
_BLOCK = 4  # Paterson-Stockmeyer: powers up to Z^4, then Horner in Z^4


class Exponentials(NamedTuple):
    """Matrix exponential of ``Z`` and its first two integrals, each (n, n)."""

    exp: Any
    phi1: Any
    phi2: Any


def exponentials(Z: Any, squarings: int) -> Exponentials:
    """Return ``e^Z``, ``phi_1(Z)`` and ``phi_2(Z)``.

    Parameters
    ----------
    Z : (n, n) casadi.SX, numpy array or Dual
        The matrix, already multiplied by the sample time.
    squarings : int
        Number of doublings, from `squarings_for`.

    Returns
    -------
    Exponentials
        Of the same type as `Z`.
    """
    if isinstance(Z, Dual) and Z.shape[0] <= LARGEST and (function := compiled("gbid_exponentials")):
        return _of_dual(function, Z, squarings)
    eye: Any = ca.SX.eye(Z.shape[0]) if isinstance(Z, ca.SX) else np.eye(Z.shape[-1])
    Z = Z / 2.0**squarings
    powers = [eye, Z]
    for _ in range(2, _BLOCK + 1):
        powers.append(powers[-1] @ Z)
    coefficients = [1.0 / factorial(k + 2) for k in range(TAYLOR_ORDER + 1)]
    blocks = [
        _weighted_sum(coefficients[start : start + _BLOCK], powers) for start in range(0, TAYLOR_ORDER + 1, _BLOCK)
    ]
    phi2 = blocks[-1]
    for block in reversed(blocks[:-1]):
        phi2 = block + powers[_BLOCK] @ phi2
    phi1 = eye + Z @ phi2
    exp = eye + Z @ phi1
    for _ in range(squarings):
        phi2 = (phi1 @ phi1 + 2.0 * phi2) / 4.0
        phi1 = (exp + eye) @ phi1 / 2.0
        exp = exp @ exp
    return Exponentials(exp, phi1, phi2)


@cache
def compiled(name: str) -> Any:
    """Return a function of dual_predictor.c; None without a C compiler, when numpy computes the same numbers."""
    try:
        return getattr(load_library(c_source("gbid.discretise", "dual_predictor.c")), name)
    except CompilerMissingError:
        return None


def _of_dual(function: Any, Z: Dual, squarings: int) -> Exponentials:
    n, n_p = Z.shape[0], len(Z.slope)
    values, slopes = np.empty((3, *Z.value.shape)), np.zeros((3, *Z.slope.shape))
    sizes = (values[0].size // max(n * n, 1), n, n_p, squarings)
    run_compiled(function, sizes, [Z.value, Z.slope], [np.empty(9 * NUMBER * n * n), values, slopes])
    return Exponentials(*map(Dual, values, slopes))


def _weighted_sum(weights: list[float], matrices: list[Any]) -> Any:
    total = weights[0] * matrices[0]
    for weight, matrix in zip(weights[1:], matrices[1:], strict=False):
        total = total + weight * matrix
    return total


def each(Z: Any) -> FloatArray:
    """Return the values of a matrix or Dual at all points, (n_points, n, n)."""
    value = np.asarray(Z.value if isinstance(Z, Dual) else Z, float)
    return value.reshape(prod(value.shape[:-2]), *value.shape[-2:])


def squarings_for(matrices: Iterable[FloatArray]) -> int:
    """Return the number of squarings that makes the Taylor polynomial exact for all given matrices.

    Parameters
    ----------
    matrices : iterable of (n, n) arrays
        Samples of ``A h``: at the start values, at bounds, wherever the graph will be evaluated.

    Returns
    -------
    int
        The largest number that any of them needs.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # a power that overflows needs none
        return max((_squarings(np.asarray(Z, float)) for Z in matrices), default=0)


def _squarings(Z: FloatArray) -> int:
    if Z.size == 0 or not np.isfinite(Z).all():
        return 0
    Z = scipy.linalg.lapack.dgebal(Z, scale=1)[0]
    squared = Z @ Z
    power = squared @ squared
    reach = max(_norm(power) ** (1 / 4), _norm(power @ Z) ** (1 / 5))
    return max(0, int(np.ceil(np.log2(reach)))) if 0 < reach < np.inf else 0  # beyond, the exponential overflows


def _norm(Z: FloatArray) -> float:
    return float(np.abs(Z).sum(axis=0).max())


# ---- Exact discretisation of linear systems, with holds and delays of the inputs.

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
    """Return the hold of each input, from one name or a sequence of names.

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


def over_sample(A: Any, t: Any, squarings: int | None = None) -> Exponentials:
    """Return ``e^(A t)``, ``phi_1(A t)`` and ``phi_2(A t)``; symbols need the number of squarings.

    Parameters
    ----------
    A : (n, n) casadi.SX, numpy array or Dual
        System matrix [1/s].
    t : float, or Dual or casadi.SX of shape (1, 1)
        Time [s].
    squarings : int, optional
        Number of doublings, from `squarings_for`.
    """
    Z = A * t
    return exponentials(Z, squarings_for(each(Z)) if squarings is None else squarings)


def discretise(
    A: Any,
    B: Any,
    sample_time: float | FloatArray,
    hold: str | Sequence[str] = "zoh",
    squarings: int | None = None,
    *,
    whole: Exponentials | None = None,
) -> Discrete:
    """Return the exact discretisation of ``xd = A x + B u`` for a hold.

    Parameters
    ----------
    A : (n, n) casadi.SX, numpy array or Dual
        System matrix [1/s].
    B : (n, n_inputs) casadi.SX, numpy array or Dual
        Input matrix.
    sample_time : float or (n_points, 1, 1) array
        Time between samples ``h`` [s]; or several, for which a numeric result has a first axis.
    hold : {"zoh", "foh"} or sequence of these
        Hold of all inputs, or of each.
    squarings : int, optional
        Number of doublings; required for a symbolic `A` only (see `gbid.discretise.squarings_for`). For a numeric `A`
        it is computed.
    whole : Exponentials, optional
        Those of ``A h``, where they are known.

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
    if squarings is None and not numeric:
        raise UsageError("a symbolic matrix needs the number of squarings; take it from squarings_for")
    exp, phi1, phi2 = whole or over_sample(A, sample_time, squarings)
    linear: Any = np.diag([float(h == "foh") for h in holds])
    if not numeric:
        linear = ca.sparsify(ca.SX(linear))
    held = sample_time * (phi1 @ B)
    next_part = sample_time * (phi2 @ (B @ linear))
    return Discrete(exp, held - next_part, next_part)


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
    A: Any,
    b: Any,
    delay: Any,
    sample_time: float,
    hold: Hold,
    *,
    near: tuple[float, int] | None = None,
    whole: Exponentials | None = None,
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
    whole : Exponentials, optional
        Those of ``A h``, where they are known.

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
    With ``I_1(t) = t phi_1(A t)`` and ``I_2(t) = t^2 phi_2(A t)`` the later piece contributes ``I_1(h - e) b`` of its
    value and ``I_2(h - e) b`` of its slope, and the earlier one what is left of ``I_1(h) b`` and
    ``(I_2(h) - e I_1(h - e)) b``. The result is a continuous function of the delay, also at whole samples.
    """
    h = sample_time
    doublings = None if near is None else near[1]
    seconds = near[0] if near else float(delay.value.flat[0]) if isinstance(delay, Dual) else float(delay)
    shift = whole_samples(seconds, h)
    early = (delay - shift * h) * (1 / h)  # share of the sample before the delayed input changes to its next piece
    rest = 1.0 - early
    whole, after = whole or over_sample(A, h, doublings), over_sample(A, rest * h, doublings)
    held_after = (after.phi1 @ b) * (rest * h)
    held_before = (whole.phi1 @ b) * h - held_after
    if hold == "zoh":
        return Taps(shift, [0.0 * held_after, held_after, held_before])
    rise_after = (after.phi2 @ b) * (rest * rest * h)
    rise_before = (whole.phi2 @ b) * h - rise_after - held_after * early + held_before * rest
    return Taps(shift, [rise_after, held_after - rise_after + rise_before, held_before - rise_before])


def whole_samples(seconds: float, sample_time: float) -> int:
    """Return the number of whole samples in a delay [s]; a negative delay is refused."""
    if seconds < 0:
        raise UsageError(f"delay = {seconds:g} s; it must not be negative")
    return int(np.floor(seconds / sample_time))


_SAME = 1e-9  # relative difference of intervals that is rounding: over a million samples, a thousandth of one


def distinct_steps(*times: FloatArray) -> FloatArray:
    """Return the different intervals between the times of one or several records [s], in ascending order.

    Intervals are the same when they differ by the rounding of the times or by less than 1e-9 of the median interval.
    """
    steps = np.concatenate([np.diff(time) for time in times])
    rounding = 4 * np.finfo(float).eps * max(float(np.abs(time).max()) for time in times)
    steps.sort()
    begins = np.flatnonzero(np.diff(steps, prepend=-np.inf) > max(_SAME * float(np.median(steps)), rounding))
    return np.asarray(np.add.reduceat(steps, begins) / np.diff(begins, append=len(steps)))


def step_numbers(time: FloatArray, steps: FloatArray) -> IntArray:
    """Return the position in `steps` of the interval after each time, (n_samples,); the last value is repeated."""
    numbers = np.searchsorted((steps[1:] + steps[:-1]) / 2, np.diff(time))
    return np.append(numbers, numbers[-1:])


# ---- Linear recursion over a long record, in blocks of samples.


def propagate(F: FloatArray, forcing: FloatArray, initial_state: FloatArray) -> FloatArray:
    """Return the states of ``x[k+1] = F x[k] + w[k]``.

    The record is cut into about sqrt(N) blocks. All blocks are computed at the same time from zero states. Then the
    initial states of the blocks are computed one after the other, and the free response from each is added. The
    result is exact. In Python it is about fifty times faster than a loop over the samples.

    Parameters
    ----------
    F : (n, n) array
        System matrix.
    forcing : (n_samples, n) array
        ``w``.
    initial_state : (n,) array
        ``x[0]``.

    Returns
    -------
    (n_samples, n) array
        ``x[0]`` to ``x[n_samples - 1]``; the last row of `forcing` is not used.
    """
    n_samples, n = forcing.shape
    length = max(1, int(np.ceil(np.sqrt(n_samples))))
    n_blocks = -(-n_samples // length)
    padded = np.zeros((n_blocks * length, n))
    padded[:n_samples] = forcing
    steps = np.ascontiguousarray(padded.reshape(n_blocks, length, n).transpose(1, 2, 0))
    states = np.zeros((length, n, n_blocks))
    powers = np.empty((length, n, n))
    x, power = np.zeros((n, n_blocks)), np.eye(n)
    for k in range(length):
        states[k], powers[k] = x, power
        x = F @ x + steps[k]
        power = F @ power
    starts = np.empty((n, n_blocks))
    start = np.asarray(initial_state, float)
    for block in range(n_blocks):
        starts[:, block] = start
        start = power @ start + x[:, block]
    states += powers @ starts
    return np.ascontiguousarray(states.transpose(2, 0, 1).reshape(n_blocks * length, n)[:n_samples])
