"""Python functions as CasADi callbacks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

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
    """

    points: int = 0
    defect: Exception | None = None


class Oracle(ca.Callback):
    """CasADi callback of a Python function with named arguments and their shapes."""

    def __init__(
        self,
        name: str,
        inputs: Sequence[tuple[str, ca.Sparsity]],
        outputs: Sequence[tuple[str, ca.Sparsity]],
        function: Callable[..., list[Any]],
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

    def eval(self, arguments: Sequence[ca.DM]) -> list[Any]:
        try:
            return self._call(*arguments)
        except (ArithmeticError, np.linalg.LinAlgError, GbidError):  # a model that overflows, a delay below zero
            pass
        except Exception as error:
            self._trouble.defect = self._trouble.defect or error
        return [ca.DM(sparsity, np.nan) for _, sparsity in self._outputs]
