"""Array types and number checks, poles and modes, linear recursion, operating points, threads of BLAS and solver."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from math import isfinite
from typing import Any, TypeGuard

import numpy as np
import numpy.typing as npt
from threadpoolctl import OpenBLASController, ThreadpoolController  # type: ignore[import-untyped]

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


def is_finite(value: object) -> TypeGuard[float]:
    """Return whether a value is one finite number; text, None, flags and lists are not."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool) and isfinite(value)


# ---- Poles: natural frequencies and damping factors.

REAL = 1e-9
"""A pole with a smaller imaginary part, relative to its magnitude, counts as real."""


def is_real(poles: ComplexArray) -> BoolArray:
    """Return whether each pole is real, hence not oscillatory (any shape).

    Parameters
    ----------
    poles : complex array
        Continuous time [rad/s].
    """
    return np.abs(poles.imag) <= REAL * np.abs(poles)


def one_of_each_pair(poles: ComplexArray) -> BoolArray:
    """Return which poles stand for an oscillatory mode: the pole in the upper half-plane of each complex pair.

    Parameters
    ----------
    poles : complex array
        Continuous time [rad/s].
    """
    return ~is_real(poles) & (poles.imag > 0)


def poles_of_samples(eigenvalues: ComplexArray, dt: float) -> ComplexArray:
    """Return the poles ``log(eigenvalue) / dt`` in continuous time [rad/s] of a sampled model (any shape).

    Parameters
    ----------
    eigenvalues : complex array
        Eigenvalues of its state matrix.
    dt : float
        Sample time [s].
    """
    values = np.asarray(eigenvalues, complex)
    with np.errstate(divide="ignore"):  # an eigenvalue at zero, as of a shift register
        return np.asarray(np.log(np.abs(values)) / dt + 1j * np.angle(values) / dt)


def frequencies_and_dampings(poles: ComplexArray) -> FloatArray:
    """Return natural frequency ``|p| / 2 pi`` [Hz] and damping factor ``-Re(p) / |p|`` of each pole (n, 2).

    Parameters
    ----------
    poles : (n,) complex array
        Continuous time [rad/s]; none at zero.
    """
    size = np.abs(poles)
    return np.column_stack([size / (2 * np.pi), -poles.real / size])


def oscillatory_modes(poles: ComplexArray) -> FloatArray:
    """Return natural frequency [Hz] and damping factor of each oscillatory mode, by rising frequency (n_modes, 2).

    Parameters
    ----------
    poles : (n,) complex array
        Continuous time [rad/s]. Real poles are no modes.
    """
    pairs = poles[one_of_each_pair(poles)]
    return frequencies_and_dampings(pairs[np.argsort(np.abs(pairs), kind="stable")])


# ---- Labels of operating points.

Point = tuple[float, ...]
"""Operating point: scheduling variables; of a gas bearing pressure [bar] and speed [rpm]."""
_POINT_UNITS = {"pressure_bar": "bar", "speed_rpm": "rpm"}


def point_label(*point: float, variables: Sequence[str] = tuple(_POINT_UNITS)) -> str:
    """Return the label of an operating point, as reports show it.

    Parameters
    ----------
    *point : float
        Scheduling variables; by default supply pressure [bar] and shaft speed [rpm].
    variables : sequence of str
        Names of the variables.

    Returns
    -------
    str
        For example ``"6 bar, 4000 rpm"``, or ``"6 bar, eccentricity 0.2"``.
    """
    named = zip(variables, point, strict=True)
    return ", ".join(f"{v:g} {_POINT_UNITS[n]}" if n in _POINT_UNITS else f"{n} {v:g}" for n, v in named)


# ---- Threads of this process: one in each BLAS library, and one at a time in the solver.


class _Shared:
    """Locks that all threads of the process share: for the solver, and for the limit of the BLAS libraries."""

    def __init__(self) -> None:
        self.turn, self.counting = threading.RLock(), threading.Lock()
        self.users = 0
        self.limit: Any = None


_shared = _Shared()
if hasattr(os, "register_at_fork"):  # a child has none of the threads that may hold a lock
    os.register_at_fork(after_in_child=lambda: _shared.__init__())  # type: ignore[misc]


@cache
def _controller(_with_scipy: bool) -> Any:
    return ThreadpoolController()  # inspects every loaded library, so it is made once, and again with that of scipy


# From threadpoolctl 3.8 on, OpenBLAS obeys the first thread that limits it, and no other as long as that one lives.
_let_any_thread_limit = getattr(OpenBLASController, "clear_controlling_thread", lambda **_: None)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Return a context in which the BLAS libraries of this process use one thread.

    Products of small matrices are slower with several threads. The limit is that of the process: the first thread to
    enter sets it, and the last one to leave restores what was there.
    """
    with _shared.counting:
        if _shared.users == 0:
            _let_any_thread_limit(force=True)
            _shared.limit = _controller("scipy.linalg" in sys.modules).limit(limits=1, user_api="blas")
        _shared.users += 1
    try:
        yield
    finally:
        with _shared.counting:
            _shared.users -= 1
            if _shared.users == 0:
                _let_any_thread_limit(force=True)
                _shared.limit.restore_original_limits()
                _let_any_thread_limit(force=True)


def keep_freed_memory() -> None:
    """Let the C allocator keep some megabytes of freed arrays for the arrays that follow.

    The allocator of Linux (glibc) returns memory to the system beyond twice the largest block that it has seen freed,
    and counts blocks up to 32 MB. The system clears each page before it gives it out again. Other allocators see no
    difference.
    """
    np.empty(31 << 20, np.uint8)  # freed at once, and never touched


def one_solver() -> AbstractContextManager[Any]:
    """Return a context for one thread at a time: MUMPS, which IPOPT uses, is not thread-safe."""
    return _shared.turn


def recursion(pole: complex, forcing: FloatArray | ComplexArray) -> np.ndarray:
    """Return ``y[k] = pole y[k-1] + w[k]`` with ``y[-1] = 0``, by a banded triangular solve.

    `scipy.signal.lfilter` is as fast, but the import of `scipy.signal` takes each process a second.

    Parameters
    ----------
    pole : float or complex
        The pole.
    forcing : (n_samples,) array, real or complex
        ``w``; its first value is that of ``y``.

    Returns
    -------
    (n_samples,) array
        ``y``, complex where the pole or the forcing is.
    """
    from scipy.linalg.blas import dtbsv, ztbsv  # not for all who need arrays

    kind = np.result_type(type(pole), forcing)
    band = np.empty((2, len(forcing)), kind, order="F")
    band[0], band[1] = 1.0, -pole
    solve = ztbsv if kind.kind == "c" else dtbsv
    return np.asarray(solve(1, band, forcing, lower=1, diag=1))
