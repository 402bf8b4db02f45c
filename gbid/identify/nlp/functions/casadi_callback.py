"""Python functions as CasADi callbacks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import GbidError


@dataclass
class Trouble:
    """Points of the solver at which a callback had no value.

    An exception inside of a callback would be printed with a traceback and all values of the point. A point at which
    the model overflows has no value instead, and the solver steps back. Any other exception is a defect, and kept.

    Attributes
    ----------
    points : int
        Number of points at which the cost has no finite value.
    defect : Exception or None
        First exception that is not numerical.
    most : float
        How many times the largest gap of the first point, or one if that is larger, a gap may become. A point with a
        larger one has no value either.
    first : float or None
        Largest gap of the first point.
    """

    points: int = 0
    defect: Exception | None = None
    most: float = np.inf
    first: float | None = None

    def too_far(self, gap: float) -> bool:
        """Return whether a point with this largest gap is too far from where the solver began."""
        if self.first is None:
            self.first = gap
        return gap > self.most * max(1.0, self.first)


class Oracle(ca.Callback):
    """CasADi callback of a Python function with named arguments and their shapes.

    The function gets the nonzeros of its arguments and returns those of its results, as arrays in column order. They
    are views of CasADi's own memory: copies into its matrices and back took longer than what is between them.
    """

    def __init__(
        self,
        name: str,
        inputs: Sequence[tuple[str, ca.Sparsity]],
        outputs: Sequence[tuple[str, ca.Sparsity]],
        function: Callable[..., Sequence[FloatArray | float]],
        trouble: Trouble,
    ) -> None:
        ca.Callback.__init__(self)
        self._inputs, self._outputs, self._call, self._trouble = inputs, outputs, function, trouble
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self._inputs)

    def get_n_out(self) -> int:
        return len(self._outputs)

    def get_name_in(self, i: int) -> str:
        return self._inputs[i][0]

    def get_name_out(self, i: int) -> str:
        return self._outputs[i][0]

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return self._inputs[i][1]

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return self._outputs[i][1]

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arguments: Sequence[memoryview | None], results: Sequence[memoryview | None]) -> int:
        """Write the results that are wanted; an argument that is not given is zero."""
        given = [
            np.zeros(sparsity.nnz()) if own is None else np.frombuffer(own)
            for own, (_, sparsity) in zip(arguments, self._inputs, strict=True)
        ]
        found: Sequence[FloatArray | float] = [np.nan] * len(results)
        try:
            found = self._call(*given)
        except (ArithmeticError, np.linalg.LinAlgError, GbidError):  # a model that overflows, a delay below zero
            pass
        except Exception as error:
            self._trouble.defect = self._trouble.defect or error
        for own, values in zip(results, found, strict=True):
            if own is not None and len(own):
                np.frombuffer(own)[:] = values
        return 0
