"""Equations of a nonlinear structure as CasADi expressions, checked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from gbid.errors import UsageError
from gbid.structure.asked_once import once
from gbid.structure.linear import in_one_line
from gbid.structure.nonlinear.nonlinear_structure import NonlinearStructure
from gbid.structure.parameter import Values

_JUMPS = {
    ca.OP_LT: "<",
    ca.OP_LE: "<=",
    ca.OP_EQ: "==",
    ca.OP_NE: "!=",
    ca.OP_IF_ELSE_ZERO: "if_else",
    ca.OP_FLOOR: "floor",
    ca.OP_CEIL: "ceil",
    ca.OP_SIGN: "sign",
    ca.OP_FABS: "fabs",
    ca.OP_FMIN: "fmin",
    ca.OP_FMAX: "fmax",
    ca.OP_FMOD: "fmod",
}
"""Operations of CasADi that have a jump or a kink."""


class Equations(NamedTuple):
    """Equations of a nonlinear structure as casadi.SX.

    Attributes
    ----------
    x, u, p : casadi.SX
        Symbols of states, inputs and parameters: (n, 1), (n_inputs, 1), (n_parameters, 1).
    dx, y : casadi.SX
        Derivatives of the states (n, 1), and outputs (n_outputs, 1).
    K : casadi.SX
        Disturbance gain, (n, n_outputs).
    x0 : casadi.SX
        Initial state, (n, 1); empty when the structure states none.
    delay : casadi.SX
        Exact delays of the inputs [s], (n_inputs, 1); without an entry for an input without delay.
    """

    x: ca.SX
    u: ca.SX
    p: ca.SX
    dx: ca.SX
    y: ca.SX
    K: ca.SX
    x0: ca.SX
    delay: ca.SX

    @property
    def delayed(self) -> tuple[int, ...]:
        """Inputs with an exact delay."""
        return tuple(self.delay.sparsity().row())


@once
def symbolic_equations(structure: NonlinearStructure) -> Equations:
    """Return the equations of a structure.

    Parameters
    ----------
    structure : NonlinearStructure
        The structure.

    Returns
    -------
    Equations
        Expressions of checked shape.

    Raises
    ------
    UsageError
        When a function of the structure fails, or returns what is no CasADi expression, or of wrong size.
    """
    x, u = _symbols(structure.states), _symbols(structure.inputs)
    p = _symbols([q.name for q in structure.parameters])
    known, n, n_y = Values.of(structure.parameters, p), len(structure.states), len(structure.outputs)

    def column(what: str, value: Callable[[], Any], rows: int, each: str) -> ca.SX:
        found = _expression(structure.name, what, value)
        if found.shape == (1, rows):
            found = found.T
        if found.shape != (rows, 1):
            raise UsageError(
                f"structure {structure.name!r}: {what} returns {found.numel()} expressions, one for each {each} is "
                f"needed: {rows}"
            )
        return ca.densify(found)

    dx = column("dynamics(x, u, p)", lambda: structure.dynamics(x, u, known), n, "state")
    y = column("output(x, u, p)", lambda: structure.output(x, u, known), n_y, "output")
    gain, initial, late = structure.disturbance_gain, structure.x0, structure.delay
    K = ca.SX(n, n_y)
    if gain is not None:
        K = _expression(structure.name, "disturbance_gain(p)", lambda: gain(known))
        if K.shape != (n, n_y):
            raise UsageError(
                f"structure {structure.name!r}: disturbance_gain(p) has shape {K.shape}, expected {(n, n_y)}: a row "
                "for each state, a column for each output"
            )
    x0 = ca.SX(0, 1) if initial is None else column("x0(p)", lambda: initial(known), n, "state")
    n_u = len(structure.inputs)
    delay = ca.SX(n_u, 1) if late is None else ca.sparsify(column("delay(p)", lambda: late(known), n_u, "input"))
    inside = {
        "dynamics": (dx, [x, u, p]),
        "output": (y, [x, u, p]),
        "disturbance_gain": (K, [p]),
        "x0": (x0, [p]),
        "delay": (delay, [p]),
    }
    for what, (expression, symbols) in inside.items():
        function = ca.Function("e", symbols, [expression], {"allow_free": True})
        if foreign := [symbol.name() for symbol in function.free_sx()]:
            raise UsageError(
                f"structure {structure.name!r}: {what} contains symbols that are none of its own: {', '.join(foreign)}"
            )
        if any(np.isnan(c) for c in _constants(function)):
            raise UsageError(
                f"structure {structure.name!r}: {what} contains nan: a function that is not casadi's, such as "
                "math.sin or float, was applied to a symbol; use functions of casadi, such as casadi.sin"
            )
    own = Equations(x, u, p, dx, y, K, x0, delay)
    if at_once := [structure.inputs[i] for i in own.delayed if ca.depends_on(y, u[i])]:
        raise UsageError(
            f"structure {structure.name!r}: output contains the delayed input {', '.join(at_once)}; delayed inputs act "
            "on the derivatives of the states only"
        )
    return own


def jumps_in(equations: Equations) -> tuple[str, ...]:
    """Return the operations in dynamics and output that have a jump or a kink, by name."""
    function = ca.Function("f", list(equations[:3]), [equations.dx, equations.y])
    met = {function.instruction_id(k) for k in range(function.n_instructions())}
    return tuple(name for operation, name in _JUMPS.items() if operation in met)


def _constants(function: ca.Function) -> list[float]:
    every = range(function.n_instructions())
    return [float(function.instruction_constant(k)) for k in every if function.instruction_id(k) == ca.OP_CONST]


def _symbols(names: Sequence[str]) -> ca.SX:
    return ca.vertcat(*(ca.SX.sym(name) for name in names)) if names else ca.SX(0, 1)


def _expression(name: str, what: str, value: Callable[[], Any]) -> ca.SX:
    try:
        found = value()
    except UsageError:
        raise
    except Exception as error:
        raise UsageError(
            f"structure {name!r}: {what} failed: {in_one_line(error)}; write it with x[i], u[i], p.name and functions "
            "of casadi, such as casadi.sin"
        ) from error
    try:
        if isinstance(found, ca.SX | ca.DM | float | int):
            return ca.SX(found)
        rows = [row if isinstance(row, list | tuple) else [row] for row in list(found)]
        return ca.vertcat(*(ca.horzcat(*(ca.SX(entry) for entry in row)) for row in rows))
    except Exception as error:
        raise UsageError(
            f"structure {name!r}: {what} returns {type(found).__name__}, which is no CasADi expression (casadi.SX) and "
            f"no list of such: {in_one_line(error)}"
        ) from None
