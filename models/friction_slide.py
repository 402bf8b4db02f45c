"""A linear slide with friction: Coulomb, stiction that falls with velocity (Stribeck), and viscous friction."""

import casadi as ca

import gbid

TURN = 2e-3
"""Velocity [m/s] within which friction turns its sign. It stands for the jump, which has no derivative."""


def friction(v, p):
    """Return the friction force [N] at a velocity [m/s]."""
    stiction = (p.F_s - p.F_c) * ca.exp(-((v / p.v_s) ** 2))
    return (p.F_c + stiction) * ca.tanh(v / TURN) + p.F_v * v


def dynamics(x, u, p):
    """Return the derivatives of position [m] and velocity [m/s]; the motor current u [A] pushes with K_t."""
    return [x[1], (p.K_t * u[0] - friction(x[1], p)) / p.m]


structure = gbid.NonlinearStructure(
    "friction_slide",
    [
        gbid.Parameter("m", 2.4, fixed=True, unit="kg"),
        gbid.Parameter("K_t", 10.0, lower=0.1, unit="N/A"),
        gbid.Parameter("F_c", 4.0, lower=0.0, unit="N"),
        gbid.Parameter("F_s", 8.0, lower=0.0, unit="N"),
        gbid.Parameter("v_s", 0.05, lower=5e-3, upper=1.0, unit="m/s"),
        gbid.Parameter("F_v", 10.0, lower=0.0, unit="N s/m"),
    ],
    states=["position", "velocity"],
    dynamics=dynamics,
    output=lambda x, _u, _p: x[0],
    inputs="current",
    outputs="position",
    steps=8,  # of 2 ms: friction turns its sign within TURN
)
