"""Python functions as CasADi callbacks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca


class Oracle(ca.Callback):
    """CasADi callback of a Python function with named arguments and their shapes."""

    def __init__(
        self,
        name: str,
        inputs: Sequence[tuple[str, ca.Sparsity]],
        outputs: Sequence[tuple[str, ca.Sparsity]],
        function: Callable[..., list[Any]],
    ) -> None:
        ca.Callback.__init__(self)
        self._inputs, self._outputs, self._call = inputs, outputs, function
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
        return self._call(*arguments)
