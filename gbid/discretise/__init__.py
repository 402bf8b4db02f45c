"""Exact discretisation: matrix exponential, zero- and first-order hold, the linear recursion."""

from gbid.discretise.expm import Exponentials, exponentials, squarings_for
from gbid.discretise.hold import Discrete, Hold, check_holds, discretise
from gbid.discretise.propagate import propagate

__all__ = [
    "Discrete",
    "Exponentials",
    "Hold",
    "check_holds",
    "discretise",
    "exponentials",
    "propagate",
    "squarings_for",
]
