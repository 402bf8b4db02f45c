"""Inputs that do not move: a free decay, or a constant force."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from gbid.errors import DataError
from gbid.identify.data import FitData, moves
from gbid.notes.fit_notes import FitNote
from gbid.structure import AnyStructure, LinearStructure, NonlinearStructure, Parameter, ScheduledStructure, anatomy


def without_inputs(structure: AnyStructure) -> AnyStructure:
    """Return a structure without its inputs, for free decays: the states, outputs and the disturbance gain remain."""
    if not anatomy(structure).n_inputs or isinstance(structure, ScheduledStructure):
        return structure
    if isinstance(structure, NonlinearStructure):
        full, still = structure, ca.SX.zeros(len(structure.inputs))
        return NonlinearStructure(
            full.name,
            full.parameters,
            full.states,
            lambda x, _, p: full.dynamics(x, still, p),
            lambda x, _, p: full.output(x, still, p),
            (),
            full.outputs,
            intersample=full.intersample,
            disturbance_gain=full.disturbance_gain,
            x0=full.x0,
            integrator=full.integrator,
            steps=full.steps,
        )
    linear = structure

    def matrices(p: Any) -> Mapping[str, Any]:
        own = linear.matrices(p)
        return {letter: own[letter] for letter in ("A", "C", "K", "x0", "feedback") if letter in own}

    return LinearStructure(
        structure.name, structure.parameters, matrices, (), structure.outputs, intersample=structure.intersample
    )


def check_inputs_suffice(
    structure: AnyStructure, data: FitData, parameters: Sequence[Parameter], *, no_inputs: bool
) -> None:
    """Check that no free parameter acts only through inputs that do not move.

    An input that is zero in all recordings determines neither its gain nor its delay. A constant input determines its
    gain, but not its delay.

    Parameters
    ----------
    structure : Structure
        Structure of the fit, with its inputs.
    data : FitData
        Data of the fit.
    parameters : sequence of Parameter
        Parameters, with the fixed values of the caller.
    no_inputs : bool
        Whether the fit uses no input at all.

    Raises
    ------
    DataError
        When a free parameter is not determined; names it and the inputs.
    """
    still = ~np.any([moves(record.inputs) for record in data.records], axis=0)
    if not (still.any() or no_inputs):
        return
    whole = anatomy(structure)
    n_u = whole.n_inputs
    if no_inputs:
        zero = still = np.ones(n_u, bool)
    elif n_u == len(data.input_names):
        zero = still & np.all([record.inputs[0] == 0 for record in data.records], axis=0)
    else:
        return  # another check reports the number of inputs
    driven, moving = np.flatnonzero(~zero).tolist(), np.flatnonzero(~still).tolist()
    begins = frozenset().union(*whole.in_x0)
    dark = (whole.in_equations | begins) - (anatomy(structure, driven, moving).in_equations | begins)
    lost = [q.name for q in parameters if not q.fixed and q.name in dark]
    if lost:
        quiet = ", ".join(name for name, rests in zip(data.input_names, still, strict=False) if rests)
        what = "without an input" if no_inputs else f"no recording moves {quiet}:"
        raise DataError(
            f"{what} the data do not determine {', '.join(lost)}; fix each (fixed=...), or add a recording with an "
            "input that moves"
        )


def decay_notes(data: FitData) -> tuple[str, ...]:
    """Return notes on inputs that do not move in a recording: a fit takes it as it is."""
    return tuple(
        FitNote.STEADY_INPUT(
            f"recording {record.name!r}: input {name!r} is {column[0]:g} throughout, "
            + ("a free decay" if column[0] == 0 else "a constant force")
        )
        for record in data.records
        for name, column in zip(data.input_names, record.inputs.T, strict=True)
        if not moves(column)
    )
