"""Calls of CasADi functions of one vector that write directly into numpy arrays.

The usual call with `casadi.DM` copies entry by entry, which takes twenty times as long as the function itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class DirectCall:
    """CasADi function from one vector to dense matrices, each with m blocks side by side.

    Parameters
    ----------
    function : casadi.Function
        The function.
    m : int
        Number of blocks.
    slopes_of : DirectCall, optional
        Matrices whose derivatives these are: each block then has the derivatives of ``vec`` of a block of that.
    """

    function: ca.Function
    m: int
    slopes_of: DirectCall | None = None
    _buffer: Any = field(init=False, repr=False)
    _trigger: Any = field(init=False, repr=False)
    _input: FloatArray = field(init=False, repr=False)
    _outputs: tuple[FloatArray, ...] = field(init=False, repr=False)
    _orders: tuple[npt.NDArray[np.intp], ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        n_out = range(self.function.n_out())
        assert all(self.function.sparsity_out(i).is_dense() for i in n_out)
        buffer: Any
        buffer, trigger = self.function.buffer()  # its stub asks for a size besides, which a memoryview has
        given = np.zeros(max(self.function.numel_in(0), 1))
        outputs = tuple(np.zeros(max(self.function.numel_out(i), 1)) for i in n_out)
        buffer.set_arg(0, given.data)
        for i, output in enumerate(outputs):
            buffer.set_res(i, output.data)
        orders = tuple(map(self._order, n_out))
        for name, value in (("_buffer", buffer), ("_trigger", trigger), ("_input", given), ("_outputs", outputs)):
            object.__setattr__(self, name, value)
        object.__setattr__(self, "_orders", orders)

    def _order(self, i: int) -> npt.NDArray[np.intp]:
        """Return the places of the entries of each block in an output; CasADi stores column after column."""
        rows, columns = self.function.size_out(i)
        places = np.arange(rows * columns).reshape(self.m, columns // self.m, rows)
        if self.slopes_of is None:
            return np.ascontiguousarray(places.transpose(0, 2, 1))
        _, p, q = self.slopes_of._orders[i].shape
        return np.ascontiguousarray(places.reshape(self.m, columns // self.m, q, p).transpose(0, 1, 3, 2))

    def __call__(self, x: FloatArray) -> tuple[FloatArray, ...]:
        """Return the blocks of each output: (m, rows, columns), or derivatives (m, d, rows, columns)."""
        self._input[: len(x)] = x
        self._trigger()
        return tuple(output.take(order) for output, order in zip(self._outputs, self._orders, strict=True))
