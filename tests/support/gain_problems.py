"""Design problems whose damping is a known function of the gains."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from gbid.control.tuning.loops import FunctionLoops, LoopFamily, families_of
from gbid.control.tuning.plants import Uncertainty
from gbid.control.tuning.problem import GainProblem, Limits


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


@dataclass(frozen=True)
class DampedLoops:
    """Loops of one gain whose damping factor is a function of the gain and of pressure, speed and deviations."""

    damping: Callable[[Any, Any], Any]
    uncertainty: Uncertainty | None = None

    def family(self, points: np.ndarray, which: Any = None) -> LoopFamily:
        """Loops at points with all drawn plants, or some of them."""
        rows = points if self.uncertainty is None else self.uncertainty.scenarios(points)
        rows = rows if which is None else rows[list(which)]
        scenarios = ca.DM(np.hstack([rows, np.zeros((len(rows), 16 - rows.shape[1]))]).T)
        g, s, gain, eye = ca.SX.sym("g"), ca.SX.sym("scenario", 16), ca.MX.sym("g"), ca.SX.eye(2)
        matrices = [oscillator(self.damping(g, s)), eye, ca.vertcat(eye, eye), 0 * ca.vertcat(eye, eye)]
        matrices = [ca.densify(ca.SX(M)) for M in matrices]
        slopes = [ca.densify(ca.jacobian(ca.vec(M), g)) for M in matrices]
        m = len(rows)
        function, jacobian = (
            ca.Function(
                "loops", [gain], list(ca.Function("loop", [g, s], parts).map(m)(ca.repmat(gain, 1, m), scenarios))
            )
            for parts in (matrices, slopes)
        )
        labels = tuple(f"{P:g} bar, {Omega:g} rpm" for P, Omega in rows[:, :2])
        return FunctionLoops(labels, rows[:, :2].copy(), 2, function=function, jacobian=jacobian)

    def gain_limits(self, points: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[()]:
        """No limits on the gain."""
        return ()


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
    return FunctionLoops(
        tuple(f"loop of {rate:g} rad/s" for rate in rates),
        n_outputs=1,
        function=ca.Function("matrices", [g], [ca.horzcat(*column) for column in blocks]),
        jacobian=ca.Function("slopes", [g], slopes),
    )
