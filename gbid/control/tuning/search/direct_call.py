"""Calls of CasADi functions of one vector that write directly into numpy arrays.

The usual call with `casadi.DM` copies entry by entry, which takes twenty times as long as the function itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

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
    """

    function: ca.Function
    m: int
    _buffer: Any = field(init=False, repr=False)
    _trigger: Any = field(init=False, repr=False)
    _input: FloatArray = field(init=False, repr=False)
    _outputs: tuple[FloatArray, ...] = field(init=False, repr=False)

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
        for name, value in (("_buffer", buffer), ("_trigger", trigger), ("_input", given), ("_outputs", outputs)):
            object.__setattr__(self, name, value)

    def __call__(self, x: FloatArray) -> tuple[FloatArray, ...]:
        """Return the blocks of each output: (m, rows, columns of a block)."""
        self._input[: len(x)] = x
        self._trigger()
        shapes = (self.function.size_out(i) for i in range(self.function.n_out()))
        # CasADi stores column after column
        return tuple(
            np.array(output[: rows * columns].reshape(self.m, columns // self.m, rows).transpose(0, 2, 1), order="C")
            for output, (rows, columns) in zip(self._outputs, shapes, strict=True)
        )
