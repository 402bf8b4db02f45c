"""Loops whose best decay is known exactly, with where it was published."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

import gbid
from gbid.structure.delay import pade_delay


@dataclass(frozen=True)
class KnownLoop:
    """Closed-loop matrix of gains within bounds, and the fastest decay that any gains give [1/s]."""

    name: str
    function: Any
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    best: float

    @property
    def gains(self) -> tuple[str, ...]:
        """Names of the gains."""
        return tuple(f"g{i}" for i in range(len(self.lower)))

    def tune(self, **options: Any) -> gbid.control.GainResult:
        """Return what gbid finds."""
        return gbid.maximise_damping(self.function, self.gains, self.lower, self.upper, "decay", **options)


def two_masses(limit: float = 10.0) -> KnownLoop:
    """Two masses and a spring, 1/(s^4 + 2 s^2), with any controller of order two: the nine entries of its matrices.

    D. Henrion, M. L. Overton, "Maximizing the closed loop asymptotic decay rate for the two-mass-spring control
    problem", 2006; exact by V. Blondel, M. Gurbuzbalaban, A. Megretski, M. L. Overton, "Explicit solutions for root
    optimization of a polynomial family with one affine constraint", IEEE Trans. Automatic Control 57, 2012: sqrt(15)/5,
    where six eigenvalues meet.
    """
    plant = ca.DM([[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0, 0, -2, 0]])
    B, C = ca.DM([0, 0, 0, 1]), ca.DM([[1, 0, 0, 0]])
    g = ca.SX.sym("g", 9)
    inner = ca.reshape(g[:4], 2, 2)
    A = ca.blockcat([[ca.SX(plant) + g[8] * (B @ C), B @ g[6:8].T], [g[4:6] @ C, inner]])
    return _known("two masses, nine entries", A, g, limit, np.sqrt(15) / 5)


def two_masses_canonical(limit: float = 10.0) -> KnownLoop:
    """The same by the five coefficients of the controller's transfer function."""
    g = ca.SX.sym("g", 5)
    x1, x0, y2, y1, y0 = ca.vertsplit(g)
    A = ca.SX.zeros(6, 6)
    A[:5, 1:] = ca.SX.eye(5)
    A[5, :] = -ca.horzcat(y0, y1, 2 * x0 + y2, 2 * x1, 2 + x0, x1)
    return _known("two masses, canonical", A, g, limit, np.sqrt(15) / 5)


def delayed_pd(order: int = 8, limit: float = 5.0) -> KnownLoop:
    """Double integrator behind a delay of 1 s with PD: 2 - sqrt(2) at kp = 0.07912, kd = 0.46116, a triple eigenvalue.

    ``s^2 + (kd s + kp) exp(-s)`` and its first two derivatives vanish at -(2 - sqrt(2)); a Pade filter of the given
    order stands for the delay.
    """
    delayed = pade_delay(1.0, order)
    a, b, c, d = (ca.SX(ca.evalf(ca.SX(M))) for M in (delayed.A, delayed.B, delayed.C, delayed.D))
    g = ca.SX.sym("g", 2)
    K, A, B = -g.T, ca.SX([[0, 1], [0, 0]]), ca.DM([0, 1])
    return _known("delayed PD", ca.blockcat([[A + B @ d @ K, B @ c], [b @ K, a]]), g, limit, 2 - np.sqrt(2))


def integrators(n: int) -> KnownLoop:
    """Chain of n integrators with the last gain, minus the sum of all eigenvalues, at most n: they all meet at -1."""
    g = ca.SX.sym("g", n)
    A = ca.SX.zeros(n, n)
    A[: n - 1, 1:] = ca.SX.eye(n - 1)
    A[n - 1, :] = -g.T
    function = ca.Function("A", [g], [A])
    return KnownLoop(f"{n} integrators", function, (-30.0,) * n, (*(30.0,) * (n - 1), float(n)), 1.0)


def reactor(limit: float = 20.0) -> KnownLoop:
    """Chemical reactor REA1 of COMPleib with static feedback; its best is the best that any search found.

    F. Leibfritz, "COMPleib: constrained matrix-optimization problem library", 2004.
    """
    A = [[1.38, -0.2077, 6.715, -5.676], [-0.5814, -4.29, 0, 0.675], [1.067, 4.273, -6.654, 5.893]]
    A.append([0.048, 4.273, 1.343, -2.104])
    B, C = [[0, 0], [5.679, 0], [1.136, -3.146], [1.136, 0]], [[1, 0, 1, -1], [0, 1, 0, 0], [0, 0, 1, -1]]
    return _static_feedback("REA1", np.array(A), np.array(B), np.array(C), limit, 16.6926)


def tuned_mass_damper(limit: float = 20.0) -> KnownLoop:
    """Tuned mass damper TMD of COMPleib with static feedback; its best is the best that any search found."""
    M, damping, stiffness, lever = np.array([[1.0, 1, 0], [-1, 1, 0], [0, 0, 5]]), 0.05, 3.0, (0.6 / 0.4) ** 2
    K, D = np.diag([0, 0, stiffness]), np.diag([0, 0, damping])
    forces = np.array([[-1, -1], [lever, -lever], [1, 1.0]])
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    B = np.vstack([np.zeros((3, 2)), np.linalg.solve(M, forces)])
    C = np.array([[1, 0, -1, 0, 0, 0], [0, 0, 0, 1, 0, -1], [0, 1, -1, 0, 0, 0], [0, 0, 0, 0, 1, -1.0]])
    return _static_feedback("TMD", A, B, C, limit, 1.1247)


def _static_feedback(name: str, A: Any, B: Any, C: Any, limit: float, best: float) -> KnownLoop:
    g = ca.SX.sym("g", B.shape[1] * C.shape[0])
    return _known(name, A + B @ ca.reshape(g, B.shape[1], C.shape[0]) @ C, g, limit, best)


def _known(name: str, A: Any, g: Any, limit: float, best: float) -> KnownLoop:
    n = g.shape[0]
    return KnownLoop(name, ca.Function("A", [g], [A]), (-limit,) * n, (limit,) * n, float(best))
