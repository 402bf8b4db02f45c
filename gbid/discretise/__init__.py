"""Exact discretisation: matrix exponential, zero- and first-order hold, linear recursion."""

from gbid.discretise.dual import Dual, constant, side_by_side
from gbid.discretise.exact import (
    Discrete,
    Exponentials,
    Hold,
    Taps,
    check_holds,
    delayed_taps,
    discretise,
    exponentials,
    hold_response,
    propagate,
    squarings_for,
)
from gbid.discretise.steps import IntegratorName, one_step, step_inputs

__all__ = [
    "Discrete",
    "Dual",
    "Exponentials",
    "Hold",
    "IntegratorName",
    "Taps",
    "check_holds",
    "constant",
    "delayed_taps",
    "discretise",
    "exponentials",
    "hold_response",
    "one_step",
    "propagate",
    "side_by_side",
    "squarings_for",
    "step_inputs",
]
