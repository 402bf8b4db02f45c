"""Structure of a finite-element rotor of ROSS whose bearing coefficients are to be identified."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite, pi
from typing import Any

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.interchange.ross.lateral_matrices import LateralMatrices, Place, UnknownBearing, lateral_matrices
from gbid.interchange.ross.modal_basis import modal_basis
from gbid.structure import LinearStructure, Parameter, Values

_PAIRS = ("xx", "xy", "yx", "yy")


def from_ross(
    rotor: Any,
    *,
    sensors: Sequence[Place | Any],
    actuators: Sequence[Place | Any],
    bearings: Mapping[str, int | str] | Sequence[str] | None = None,
    speed_rpm: float = 0.0,
    modes: int = 8,
    outputs: str | Sequence[str] = "p",
    inputs: str | Sequence[str] = "f",
    name: str = "rotor",
) -> LinearStructure:
    r"""Return a finite-element rotor of ROSS, modally reduced, as a structure with unknown bearing coefficients.

    Parameters
    ----------
    rotor : ross.Rotor
        Shaft, discs and bearings. The coefficients of the unknown bearings in it are the start values.
    sensors : sequence of (int, str) or ross.Probe
        Node and axis of each position that is measured, one for each output channel. The axis is ``"x"``, ``"y"`` or
        an angle from x to y [rad].
    actuators : sequence of (int, str)
        Node and axis of each force that is known, one for each input channel.
    bearings : dict of str to (int or str), sequence of str, optional
        Bearings whose coefficients are unknown: tags of bearing elements, or names with the tag or node of each,
        ``{"left": 0, "right": 6}``. The names end the names of the parameters. All bearings when not given. Bearings
        that are not named keep their coefficients.
    speed_rpm : float
        Speed of the recordings, for gyroscopic moments and for coefficients over frequency.
    modes : int
        Number of lateral modes of the reduced model. Static shapes of forces at bearings and actuators come to them.
    outputs, inputs : str or sequence of str
        Signals of the recordings: positions [m] and forces [N].
    name : str
        Name of the structure.

    Returns
    -------
    LinearStructure
        For `gbid.fit`. The parameters of a bearing are ``k_xx_NAME`` to ``k_yy_NAME`` [N/m] and ``c_xx_NAME`` to
        ``c_yy_NAME`` [N s/m].

    Raises
    ------
    UsageError
        When `rotor` is no rotor of ROSS, when a bearing or node does not exist, when there are no sensors, or when a
        number is out of range.

    Notes
    -----
    The equations are those of ROSS, :math:`M \ddot q + (C + \Omega G) \dot q + K q = F f`, where a bearing acts on the
    rotor with :math:`-k\,(x, y)^T - c\,(\dot x, \dot y)^T`. So the coefficients of a bearing that holds the rotor are
    positive, contrary to those of `gbid.RotorBearing`, and are not divided by a mass. In modal coordinates
    :math:`q = \Phi \eta`; the states are :math:`\omega_0 \eta` and :math:`\dot \eta`, with :math:`\omega_0` the lowest
    natural frequency, so that both are of one magnitude.
    """
    if not all(hasattr(rotor, part) for part in ("bearing_elements", "number_dof", "M", "K", "C", "G")):
        raise UsageError(f"a {type(rotor).__name__} is no rotor of ROSS; give a ross.Rotor")
    if not (isinstance(speed_rpm, int | float | np.number) and isfinite(speed_rpm)):
        raise UsageError(f"structure {name!r}: speed_rpm = {speed_rpm!r}; give a finite number")
    if isinstance(modes, bool) or not isinstance(modes, int | np.integer):
        raise UsageError(f"structure {name!r}: modes = {modes!r}; give a whole number")
    if not sensors:
        raise UsageError(f"structure {name!r}: no sensors; give the node and axis of each")
    equations = lateral_matrices(rotor, bearings, 2.0 * pi / 60.0 * float(speed_rpm))
    seen = _entries(equations, "sensors", sensors)
    driven = _entries(equations, "actuators", actuators)
    shapes = modal_basis(equations, int(modes), driven)
    return LinearStructure(
        name,
        [parameter for bearing in equations.bearings for parameter in _parameters(bearing)],
        _matrices(equations, shapes, seen, driven),
        inputs=inputs,
        outputs=outputs,
    )


def _entries(equations: LateralMatrices, what: str, places: Sequence[Any]) -> FloatArray:
    columns = [equations.entry(f"{what}[{i}]", place) for i, place in enumerate(places)]
    return np.column_stack(columns) if columns else np.zeros((len(equations.mass), 0))


def _parameters(bearing: UnknownBearing) -> list[Parameter]:
    coefficients = (("k", bearing.stiffness, "N/m"), ("c", bearing.damping, "N s/m"))
    return [
        Parameter(f"{letter}_{pair}_{bearing.name}", float(value), unit=unit)
        for letter, matrix, unit in coefficients
        for pair, value in zip(_PAIRS, matrix.ravel(), strict=True)
    ]


def _matrices(equations: LateralMatrices, shapes: FloatArray, seen: FloatArray, driven: FloatArray) -> Any:
    """Return the function of the matrices, with everything but the coefficients computed."""
    n = shapes.shape[1]
    stiffness, damping = (shapes.T @ matrix @ shapes for matrix in (equations.stiffness, equations.damping))
    at = {bearing.name: shapes.T @ bearing.entry for bearing in equations.bearings}
    held = stiffness + sum(at[b.name] @ b.stiffness @ at[b.name].T for b in equations.bearings)
    lowest = np.sort(np.abs(np.linalg.eigvals(held)))
    scale = float(np.sqrt(lowest[lowest > 1e-9 * lowest[-1]][0]))

    def matrices(p: Values) -> dict[str, Any]:
        k, c = ca.SX(ca.DM(stiffness)), ca.SX(ca.DM(damping))
        for name, entry in at.items():
            side = ca.DM(entry)
            k += side @ _square(p, "k", name) @ side.T
            c += side @ _square(p, "c", name) @ side.T
        return {
            "A": ca.blockcat([[ca.SX(n, n), scale * ca.SX.eye(n)], [-k / scale, -c]]),
            "B": ca.vertcat(ca.SX(n, driven.shape[1]), ca.SX(ca.DM(shapes.T @ driven))),
            "C": ca.horzcat(ca.SX(ca.DM(seen.T @ shapes / scale)), ca.SX(seen.shape[1], n)),
        }

    return matrices


def _square(p: Values, letter: str, name: str) -> Any:
    xx, xy, yx, yy = (p[f"{letter}_{pair}_{name}"] for pair in _PAIRS)
    return ca.blockcat([[ca.SX(xx), ca.SX(xy)], [ca.SX(yx), ca.SX(yy)]])
