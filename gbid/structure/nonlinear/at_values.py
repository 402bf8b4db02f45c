"""Nonlinear model of a structure at given values of its parameters."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from gbid.errors import UsageError
from gbid.structure.nonlinear.equations import symbolic_equations
from gbid.structure.nonlinear.nonlinear_model import NonlinearModel
from gbid.structure.nonlinear.nonlinear_structure import NonlinearStructure


def nonlinear_model(
    structure: NonlinearStructure,
    values: Mapping[str, float],
    input_names: tuple[str, ...] = (),
    output_names: tuple[str, ...] = (),
    *,
    steps: int = 1,
) -> NonlinearModel:
    """Return the model of a nonlinear structure for given parameter values.

    Parameters
    ----------
    structure : NonlinearStructure
        The structure.
    values : dict of str to float
        A value for every parameter.
    input_names, output_names : tuple of str, optional
        Names of the channels; by default those of the structure.
    steps : int
        Steps of the integrator in a sample.

    Raises
    ------
    UsageError
        When a value is missing.
    """
    if missing := [q.name for q in structure.parameters if q.name not in values]:
        raise UsageError(f"structure {structure.name!r}: no value for {', '.join(missing)}")
    e = symbolic_equations(structure)
    p = np.array([float(values[q.name]) for q in structure.parameters])
    K = np.array(ca.Function("K", [e.p], [ca.densify(e.K)])(p), float)
    function = ca.Function("equations", [e.x, e.u, e.p], [e.dx, e.y])
    delay = np.array(ca.Function("delay", [e.p], [ca.densify(e.delay)])(p), float).ravel()
    return NonlinearModel(
        structure.name,
        function.serialize(),
        p,
        K.reshape(e.K.shape),
        structure.states,
        input_names or structure.inputs,
        output_names or structure.outputs,
        structure.integrator,
        steps,
        delay if e.delayed else None,
    )
