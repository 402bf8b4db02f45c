"""Design problems whose damping is a known function of the gains."""

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from gbid.control.tuning.loops import LoopEquations, LoopFamily, families_of
from gbid.control.tuning.plants import LpvPlants, Uncertainty
from gbid.control.tuning.problem import GainProblem, Limits
from gbid.structure import KEY_PARAMETERS, Parameter


def oscillator(damping: Any, rate: float = 1.0) -> Any:
    """State matrix with one pair of poles, of a damping factor and a natural frequency [rad/s]."""
    return rate * ca.blockcat([[0, 1], [-1, -2 * damping]])


def damping_problem(
    damping: Callable[[Any], Any], lower: list[float], upper: list[float], limits: Limits | None = None
) -> GainProblem:
    """Problem of one oscillator whose damping factor is a function of the gains."""
    g = ca.SX.sym("g", len(lower))
    families = families_of([ca.Function("A", [g], [oscillator(damping(g))])], len(lower))
    return GainProblem(families, limits or Limits(), np.array(lower), np.array(upper), 1.0)


def loops_of(damping: Callable[[Any, Any], Any], uncertainty: Uncertainty | None = None) -> LpvPlants:
    """Loops of one gain whose damping factor is a function of the gain and of pressure, speed and deviations."""
    g, s = ca.SX.sym("g"), ca.SX.sym("scenario", 2 + len(KEY_PARAMETERS))
    eye = ca.SX.eye(2)
    matrices = [
        ca.densify(ca.SX(M)) for M in (oscillator(damping(g, s)), eye, ca.vertcat(eye, eye), 0 * ca.vertcat(eye, eye))
    ]
    slopes = [ca.densify(ca.jacobian(ca.vec(M), g)) for M in matrices]
    equations = LoopEquations(
        (Parameter("g", 0.0, -3.0, 3.0),), ca.Function("loop", [g, s], matrices), ca.Function("slopes", [g, s], slopes)
    )
    return LpvPlants(None, np.zeros((0, 2)), equations=equations, lpv=None, uncertainty=uncertainty)


def responding(damping: Any, g: Any, rates: tuple[float, ...] = (1.0,), size: Any = 1.0) -> LoopFamily:
    """Loops from w to ``size w^2 / (s^2 + 2 damping w s + w^2)``, and three times that as control signal.

    The peak is ``size / (2 damping sqrt(1 - damping^2))`` at ``w sqrt(1 - 2 damping^2)``, the gain at rest `size`.
    """
    every = [
        [
            oscillator(damping, rate),
            ca.DM([0, rate]),
            ca.vertcat(*(k * size * ca.SX([[1, 0]]) for k in (1, 3))),
            ca.SX(2, 1),
        ]
        for rate in rates
    ]
    blocks = [[ca.densify(ca.SX(M)) for M in column] for column in zip(*every, strict=True)]
    slopes = [ca.horzcat(*(ca.densify(ca.jacobian(ca.vec(M), g)) for M in column)) for column in blocks]
    return LoopFamily(
        ca.Function("matrices", [g], [ca.horzcat(*column) for column in blocks]),
        ca.Function("slopes", [g], slopes),
        tuple(f"loop of {rate:g} rad/s" for rate in rates),
        n_outputs=1,
    )
