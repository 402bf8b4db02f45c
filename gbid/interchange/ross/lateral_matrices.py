"""Finite-element matrices of the lateral motion of a rotor of ROSS, without the bearings that are unknown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import cos, sin
from typing import Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError

_LATERAL = {4: (0, 1, 2, 3), 6: (0, 1, 3, 4)}  # x, y and their rotations, by the degrees of freedom of a node
Place = tuple[int, str | float]
"""Node, and axis "x" or "y", or angle from x to y [rad]."""


@dataclass(frozen=True, eq=False)
class UnknownBearing:
    """A bearing whose coefficients are to be identified.

    Attributes
    ----------
    name : str
        End of the names of its parameters.
    node : int
        Node of the rotor.
    stiffness, damping : (2, 2) array
        Coefficients in the rotor at its speed [N/m], [N s/m]: the start values.
    entry : (n, 2) array
        Degrees of freedom x and y of the node.
    """

    name: str
    node: int
    stiffness: FloatArray
    damping: FloatArray
    entry: FloatArray


@dataclass(frozen=True, eq=False)
class LateralMatrices:
    """Equations ``M q'' + C q' + K q = F f`` of the lateral motion at one speed, without the unknown bearings.

    Attributes
    ----------
    mass, damping, stiffness : (n, n) array
        Matrices in SI units; gyroscopic terms are in the damping.
    bearings : tuple of UnknownBearing
        The unknown bearings.
    """

    mass: FloatArray
    damping: FloatArray
    stiffness: FloatArray
    bearings: tuple[UnknownBearing, ...]
    n_per_node: int

    def entry(self, what: str, place: Any) -> FloatArray:
        """Return the direction of a sensor or actuator in the degrees of freedom, shape (n,).

        Raises
        ------
        UsageError
            When the node does not exist, or when the axis is none.
        """
        n_nodes = len(self.mass) // self.n_per_node
        node, axis = (place.node, place.angle) if hasattr(place, "angle") else _pair(what, place)
        if isinstance(node, bool) or not isinstance(node, int | np.integer) or not 0 <= node < n_nodes:
            raise UsageError(f"{what}: node {node!r}; the rotor has nodes 0 to {n_nodes - 1}")
        if axis in ("x", "y"):
            along = (1.0, 0.0) if axis == "x" else (0.0, 1.0)
        elif isinstance(axis, int | float) and not isinstance(axis, bool) and np.isfinite(axis):
            along = (cos(axis), sin(axis))
        else:
            raise UsageError(f"{what}: axis {axis!r}; give 'x', 'y' or an angle from x to y in radians")
        direction = np.zeros(len(self.mass))
        direction[self.n_per_node * node : self.n_per_node * node + 2] = along
        return direction


def lateral_matrices(
    rotor: Any, bearings: Mapping[str, int | str] | Sequence[str] | None, omega: float
) -> LateralMatrices:
    """Return the lateral equations of a rotor at a speed.

    Parameters
    ----------
    rotor : ross.Rotor
        The rotor with its bearings.
    bearings : dict of str to (int or str), sequence of str, or None
        The unknown bearings; see `from_ross`.
    omega : float
        Speed [rad/s]; coefficients over frequency are taken at this frequency.

    Raises
    ------
    UsageError
        When a bearing is not found, found twice, or connects two nodes.
    """
    if rotor.number_dof not in _LATERAL:
        raise UsageError(f"the rotor has {rotor.number_dof} degrees of freedom at a node; models with 4 or 6 are known")
    keep = [i for i in range(rotor.ndof) if i % rotor.number_dof in _LATERAL[rotor.number_dof]]
    chosen = _chosen(rotor, bearings)
    mass, damping = rotor.M(omega), rotor.C(omega) + rotor.G() * omega
    stiffness = rotor.K(omega)
    unknown = []
    for name, element in chosen.items():
        dofs = list(element.dof_global_index.values())
        square = np.ix_(dofs, dofs)
        k, c = np.asarray(element.K(omega), float), np.asarray(element.C(omega), float)
        stiffness[square] -= k
        damping[square] -= c
        entry = np.zeros((len(keep), 2))
        entry[keep.index(dofs[0]), 0] = entry[keep.index(dofs[1]), 1] = 1.0
        unknown.append(UnknownBearing(name, int(element.n), k[:2, :2], c[:2, :2], entry))
        if k.shape[0] > 2:  # what acts along the shaft is no part of the lateral motion
            stiffness[dofs[2], dofs[2]] += k[2, 2]
            damping[dofs[2], dofs[2]] += c[2, 2]
    lateral = np.ix_(keep, keep)
    return LateralMatrices(
        mass[lateral], damping[lateral], stiffness[lateral], tuple(unknown), len(_LATERAL[rotor.number_dof])
    )


def _chosen(rotor: Any, bearings: Mapping[str, int | str] | Sequence[str] | None) -> dict[str, Any]:
    """Return the unknown bearing elements by the names of their parameters."""
    elements = list(rotor.bearing_elements)
    if not elements:
        raise UsageError("the rotor has no bearings; give it some, whose coefficients are the start values")
    there = ", ".join(f"{element.tag!r} at node {element.n}" for element in elements)
    if bearings is None:
        named: dict[str, int | str] = {element.tag: element.tag for element in elements}
    elif isinstance(bearings, Mapping):
        named = dict(bearings)
    else:
        named = {tag: tag for tag in ((bearings,) if isinstance(bearings, str) else bearings)}
    if not named:
        raise UsageError(f"bearings: none is named; there is {there}")
    chosen: dict[str, Any] = {}
    for name, key in named.items():
        found = [e for e in elements if key == (e.n if isinstance(key, int) else e.tag)]
        if len(found) != 1:
            which = "no bearing" if not found else f"{len(found)} bearings"
            raise UsageError(f"bearings: {which} {key!r} in the rotor; there is {there}")
        if not str(name).isidentifier():
            raise UsageError(
                f"bearings: {name!r} cannot end the names of parameters; give names, as {{'left': {key!r}}}"
            )
        if found[0].n_link is not None:
            raise UsageError(
                f"bearings: {key!r} connects node {found[0].n} with node {found[0].n_link}; give one to ground"
            )
        if found[0] in chosen.values():
            raise UsageError(f"bearings: {key!r} is named twice; name each bearing once")
        chosen[str(name)] = found[0]
    return chosen


def _pair(what: str, place: Any) -> tuple[Any, Any]:
    if not isinstance(place, tuple | list) or len(place) != 2:
        raise UsageError(f"{what}: {place!r}; give (node, 'x'), (node, 'y'), (node, angle) or a ross.Probe")
    return place[0], place[1]
