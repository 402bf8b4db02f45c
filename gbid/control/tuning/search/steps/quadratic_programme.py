"""Small convex quadratic programmes by CasADi's DAQP, which reads and writes numpy arrays directly.

The usual call with `casadi.DM` takes ten times as long as the solution.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray

_INPUTS = ("h", "g", "a", "lba", "uba", "lbx", "ubx")
_PROXIMAL = {"eps_prox": 1e-4, "eta_prox": 1e-8}
"""Weight and tolerance of proximal iterations: without them rows are broken by percents where H is nearly zero."""
_INFEASIBLE = -1
"""DAQP's status of a programme without a solution."""


class QuadraticProgramme:
    """Solver of ``min x' H x / 2 + g' x`` with ``low <= A x <= high`` and bounds, for one size.

    Parameters
    ----------
    n, m : int
        Number of variables and of rows of A.

    Attributes
    ----------
    infeasible : bool
        Whether the last programme had no solution within its rows and bounds.
    """

    def __init__(self, n: int, m: int) -> None:
        shapes = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(m, n)}
        self._solver: Any = ca.conic("step", "daqp", shapes, {"error_on_fail": False, "daqp": _PROXIMAL})
        buffer: Any
        buffer, self._trigger = self._solver.buffer()  # its stub asks for a size besides, which a memoryview has
        self._buffer, self.infeasible = buffer, False
        self._given = {name: self._array(self._solver.numel_in(name)) for name in map(str, self._solver.name_in())}
        self._found = {name: self._array(self._solver.numel_out(name)) for name in map(str, self._solver.name_out())}
        for i, array in enumerate(self._given.values()):
            buffer.set_arg(i, array.data)
        for i, array in enumerate(self._found.values()):
            buffer.set_res(i, array.data)

    @staticmethod
    def _array(size: int) -> FloatArray:
        return np.zeros(max(size, 1))

    def solve(self, *given: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return solution and multipliers of the rows for H, g, A, low, high, lower, upper; None when it fails."""
        for name, value in zip(_INPUTS, given, strict=True):
            self._given[name][: value.size] = value.ravel(order="F")  # CasADi stores column after column
        self.infeasible = False
        try:
            self._trigger()
        except RuntimeError:  # the solver finds its numbers unfit
            return None
        x, rows = self._found["x"].copy(), self._found["lam_a"].copy()
        ended = self._buffer.stats()
        self.infeasible = ended["return_status"] == _INFEASIBLE
        return (x, rows) if ended["success"] and np.isfinite(x).all() else None


@lru_cache(maxsize=64)
def quadratic_programme(n: int, m: int) -> QuadraticProgramme:
    """Return the solver for n variables and m rows."""
    return QuadraticProgramme(n, m)
