"""Rotor bearing whose film stiffens, as a nonlinear structure."""

from __future__ import annotations

from typing import Any

import casadi as ca

from gbid.structure.nonlinear.nonlinear_structure import NonlinearStructure
from gbid.structure.parameter import Values
from gbid.structure.rotor_bearing import AXES, STIFFENING, RotorBearing, square


def film_bearing(bearing: RotorBearing) -> NonlinearStructure:
    """Return the equations of a rotor bearing whose film stiffens.

    The linear part is that of `RotorBearing.matrices`, with its delays as filters or exact. The film adds
    ``s |p|^2 K p`` to the acceleration.

    Parameters
    ----------
    bearing : RotorBearing
        The bearing, with ``film="stiffening"``.
    """
    exact = bearing.delay == "exact"

    def dynamics(x: Any, u: Any, p: Values) -> Any:
        own = bearing.matrices(p)
        film = p[STIFFENING] * (x[0] ** 2 + x[1] ** 2) * (square(p, "k") @ x[:2])
        drive = own["B"] + own["B_delayed"] if exact else own["B"]
        return own["A"] @ x + drive @ u + ca.vertcat(ca.SX(2, 1), film, ca.SX(x.numel() - 4, 1))

    late = [] if exact else [f"late_{axis}{i}" for axis in AXES for i in range(bearing.pade_order)]
    return NonlinearStructure(
        bearing.name,
        bearing.parameters,
        ["p_x", "p_y", "v_x", "v_y", *late],
        dynamics,
        lambda x, _u, _p: x[:2],
        [f"{signal}.{axis}" for signal in bearing.inputs for axis in AXES],
        [f"{bearing.outputs[0]}.{axis}" for axis in AXES],
        intersample=bearing.intersample,
        disturbance_gain=None if bearing.disturbance_gain == "none" else lambda p: bearing.matrices(p)["K"],
        delay=(lambda p: bearing.matrices(p)["delay"]) if exact else None,
    )
