"""Exact discretisation: matrix exponential, zero- and first-order hold, linear recursion."""

from gbid.discretise.delayed import Taps, delayed_taps
from gbid.discretise.dual import Dual, constant, side_by_side
from gbid.discretise.expm import Exponentials, exponentials, squarings_for
from gbid.discretise.hold import Discrete, Hold, check_holds, discretise, hold_response
from gbid.discretise.look_ahead import look_ahead
from gbid.discretise.one_step import IntegratorName, one_step
from gbid.discretise.propagate import propagate
from gbid.discretise.step_inputs import step_inputs

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
    "look_ahead",
    "one_step",
    "propagate",
    "side_by_side",
    "squarings_for",
    "step_inputs",
]
