"""Exchange with ROSS: identified bearings as bearing elements, and finite-element rotors as structures."""

from __future__ import annotations

import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from inspect import signature
from math import cos, isfinite, pi, sin
from typing import Annotated, Any

import casadi as ca
import numpy as np
import numpy.typing as npt
import scipy

from gbid.core.arrays import ComplexArray, FloatArray
from gbid.core.errors import UsageError
from gbid.core.extras import extra_package
from gbid.core.notes import FitNote
from gbid.core.option_types import Allowed, Finite
from gbid.discretise import Hold
from gbid.identify import FitResult
from gbid.lpv import LPVModel
from gbid.structure import LinearStructure, Parameter, Values
from gbid.structure.built_in import PAIRS
from gbid.structure.linear import as_names
from gbid.structure.parameter import set_fields


def ross_package(what: str) -> Any:
    """Return the package `ross`, imported without its messages; an error names the missing package.

    Its dependencies print on their import that fluid libraries are not installed, which no rotor needs.

    Parameters
    ----------
    what : str
        What needs it, for the message.

    Raises
    ------
    UsageError
        When ROSS is not installed, or when it fails on its import.
    """
    if "ross" in sys.modules:
        return extra_package("ross", "ross", what)
    with warnings.catch_warnings(), _silence():
        warnings.simplefilter("ignore")
        return extra_package("ross", "ross", what)


@contextmanager
def _silence() -> Iterator[None]:
    """Discard all output of the process: compiled libraries print past `sys.stdout`."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(1), os.dup(2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        for target, source in enumerate(kept, start=1):
            os.dup2(source, target)
            os.close(source)
        os.close(nowhere)


_N_SPEEDS = 25


def bearing_element(
    what: LPVModel | FitResult,
    node: int,
    *,
    mass_kg: float,
    pressure_bar: float | None = None,
    speed_rpm: npt.ArrayLike | None = None,
    tag: str | None = None,
) -> Any:
    r"""Return the identified bearing as a bearing element of ROSS, over the speed if the model has surfaces.

    Parameters
    ----------
    what : LPVModel or FitResult
        Surfaces over pressure and speed, or a fit of `gbid.RotorBearing` at one operating point.
    node : int
        Node of the rotor.
    mass_kg : float
        Modal mass by which the coefficients of the model are multiplied [kg]; the model is per unit mass.
    pressure_bar : float, optional
        Injection pressure [bar]; required for surfaces.
    speed_rpm : (n,) array, optional
        Speeds of the element [rpm]; by default 25 speeds over the domain of the surfaces.
    tag : str, optional
        Tag of the element.

    Returns
    -------
    ross.BearingElement
        With stiffness [N/m] and damping [N s/m] over the speeds [rad/s]: `speed`, or `frequency` in ROSS 2.

    Raises
    ------
    UsageError
        When ROSS is not installed, when the mass is not positive, when a point lies outside the domain, or when the
        fit has no bearing.

    Notes
    -----
    gbid writes :math:`\ddot p = K p + D \dot p` per unit mass; ROSS writes the force of a bearing on the rotor as
    :math:`-k\,q - c\,\dot q`. So :math:`k = -m K` and :math:`c = -m D`, entry by entry with the same axes: x and y of
    the recordings are x and y of ROSS, and a positive speed turns from x to y. K holds everything that pulls the disc
    back, the elasticity of the shaft included. In a rotor with a flexible shaft the coefficients therefore describe
    the bearing alone only where it is much softer than the shaft.
    """
    if not (isfinite(mass_kg) and mass_kg > 0):
        raise UsageError(f"bearing element: mass_kg = {mass_kg}; give the modal mass, a positive number of kilograms")
    ross = ross_package("a bearing element of ROSS")
    if isinstance(what, LPVModel):
        what.need_bearing()
        if pressure_bar is None:
            raise UsageError(f"bearing element of model {what.name!r}: give pressure_bar")
        speeds = np.linspace(*what.domain.speed_rpm, _N_SPEEDS) if speed_rpm is None else np.atleast_1d(speed_rpm)
        values = what.key_parameters(float(pressure_bar), np.asarray(speeds, float))
        given = {key: np.broadcast_to(value, np.shape(speeds)) for key, value in values.items()}
        axis = "speed" if "speed" in signature(ross.BearingElement.__init__).parameters else "frequency"  # ROSS 3 or 2
        over = {axis: 2.0 * pi / 60.0 * np.asarray(speeds, float)} if np.size(speeds) > 1 else {}
    else:
        missing = [key for key in ("k_xx", "d_xx") if key not in what.parameters]
        if missing:
            raise UsageError(
                f"bearing element of fit {what.structure!r}: it has no {missing[0]}; give a fit of RotorBearing"
            )
        if speed_rpm is not None or pressure_bar is not None:
            raise UsageError(
                f"bearing element of fit {what.structure!r}: a fit holds at one operating point; leave it out"
            )
        given, over = {key: np.array([value]) for key, value in what.parameters.items()}, {}
    coefficients = {
        f"{ours}{pair}": (-mass_kg * given[f"{theirs}_{pair}"]).tolist()
        for ours, theirs in (("k", "k"), ("c", "d"))
        for pair in ("xx", "xy", "yx", "yy")
    }
    if not over:
        coefficients = {key: values[0] for key, values in coefficients.items()}
    return ross.BearingElement(n=node, tag=tag, **coefficients, **over)


# ---- Finite-element rotor of ROSS as a structure: lateral equations, modal reduction, unknown bearings.

_LATERAL = {4: (0, 1, 2, 3), 6: (0, 1, 3, 4)}  # x, y and their rotations, by the degrees of freedom of a node
Place = tuple[int | str, str | float]
"""Node, and axis "x" or "y", or angle from x to y [rad]. A magnetic bearing's tag in place of the node: its current."""


@dataclass(frozen=True, eq=False)
class UnknownBearing:
    """Bearing of a ROSS rotor whose coefficients are to be identified.

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
    tag : str
        Tag of the element.
    force_per_current : float, optional
        Of a magnetic bearing k_i [N/A]. Its stiffness is then the magnetic one alone, without that of its controller.
    """

    name: str
    node: int
    stiffness: FloatArray
    damping: FloatArray
    entry: FloatArray
    tag: str = ""
    force_per_current: float | None = None


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
        """Return the direction of a sensor or actuator as a vector over the degrees of freedom, shape (n,).

        Raises
        ------
        UsageError
            When the node does not exist, or when the axis is none.
        """
        n_nodes = len(self.mass) // self.n_per_node
        node, axis = (place.node, place.angle) if hasattr(place, "angle") else _pair(what, place)
        if isinstance(node, str):
            node = self.magnetic(what, node).node
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

    def magnetic(self, what: str, tag: str) -> UnknownBearing:
        """Return the magnetic bearing with a given tag.

        Raises
        ------
        UsageError
            When there is none among the unknown bearings.
        """
        magnetic = {b.tag: b for b in self.bearings if b.force_per_current is not None}
        if tag not in magnetic:
            known = ", ".join(map(repr, magnetic)) or "none"
            raise UsageError(f"{what}: {tag!r} is no magnetic bearing with unknown coefficients; choose from {known}")
        return magnetic[tag]

    def state_matrix(self, shapes: FloatArray | None = None) -> FloatArray:
        """Return the system matrix of positions and velocities, with all bearings at their start values.

        Parameters
        ----------
        shapes : (n, m) array, optional
            Shapes that are orthonormal in the mass; all degrees of freedom by default.
        """
        stiffness = self.stiffness + sum(b.entry @ b.stiffness @ b.entry.T for b in self.bearings)
        damping = self.damping + sum(b.entry @ b.damping @ b.entry.T for b in self.bearings)
        if shapes is None:
            blocks = np.linalg.solve(self.mass, stiffness), np.linalg.solve(self.mass, damping)
        else:
            blocks = shapes.T @ stiffness @ shapes, shapes.T @ damping @ shapes
        n = len(blocks[0])
        return np.block([[np.zeros((n, n)), np.eye(n)], [-blocks[0], -blocks[1]]])


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
        When a bearing is not found, found twice, or connects two nodes, or when the motion is coupled with torsion.
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
        tag, n = str(element.tag), int(element.n)
        magnetic = _magnetic_coefficients(element)
        if magnetic is None:
            unknown.append(UnknownBearing(name, n, k[:2, :2], c[:2, :2], entry, tag))
        else:
            unknown.append(UnknownBearing(name, n, magnetic[0] * np.eye(2), np.zeros((2, 2)), entry, tag, magnetic[1]))
        if k.shape[0] > 2:  # what acts along the shaft is no part of the lateral motion
            stiffness[dofs[2], dofs[2]] += k[2, 2]
            damping[dofs[2], dofs[2]] += c[2, 2]
    lateral, rest = np.ix_(keep, keep), np.setdiff1d(np.arange(rotor.ndof), keep)
    for matrix in (mass, damping, stiffness):
        coupling = [np.abs(matrix[np.ix_(*pair)]).max(initial=0.0) for pair in ((keep, rest), (rest, keep))]
        if max(coupling) > 1e-9 * np.abs(matrix).max():
            raise UsageError(
                "the rotor's lateral motion is coupled with its torsion or with motion along the shaft, as by gears; "
                "give each shaft as a separate ross.Rotor"
            )
    return LateralMatrices(
        mass[lateral], damping[lateral], stiffness[lateral], tuple(unknown), len(_LATERAL[rotor.number_dof])
    )


def _magnetic_coefficients(element: Any) -> tuple[float, float] | None:
    """Return the (negative) stiffness [N/m] and force per current [N/A] of a magnetic bearing; else None."""
    if not (hasattr(element, "ks") and hasattr(element, "ki")):
        return None
    pairs = [np.unique(np.asarray(value, float)) for value in (element.ks, element.ki)]
    if any(len(values) != 1 for values in pairs):
        raise UsageError(f"bearings: {element.tag!r} has different coefficients in its two axes; give it equal ones")
    return float(pairs[0][0]), float(pairs[1][0])


def _chosen(rotor: Any, bearings: Mapping[str, int | str] | Sequence[str] | None) -> dict[str, Any]:
    """Return the unknown bearing elements, keyed by the ending of their parameter names."""
    elements = list(rotor.bearing_elements)
    if not elements:
        raise UsageError("the rotor has no bearings; add bearings; their coefficients are the start values")
    choices = ", ".join(f"{element.tag!r} at node {element.n}" for element in elements)
    if bearings is None:
        named: dict[str, int | str] = {_as_name(e.tag): e.tag for e in elements if e.n_link is None}
    elif isinstance(bearings, Mapping):
        named = dict(bearings)
    else:
        named = {_as_name(tag): tag for tag in ((bearings,) if isinstance(bearings, str) else bearings)}
    if not named:
        raise UsageError(f"bearings: none is named; choose from {choices}")
    chosen: dict[str, Any] = {}
    for name, key in named.items():
        matching = [e for e in elements if key == (e.n if isinstance(key, int) else e.tag)]
        if len(matching) != 1:
            which = "no bearing" if not matching else f"{len(matching)} bearings"
            raise UsageError(f"bearings: {which} {key!r} in the rotor; choose from {choices}")
        if not str(name).isidentifier():
            raise UsageError(
                f"bearings: {name!r} cannot be the suffix of parameter names; give names, as {{'left': {key!r}}}"
            )
        if matching[0].n_link is not None:
            raise UsageError(
                f"bearings: {key!r} connects node {matching[0].n} with node {matching[0].n_link}; give one to ground"
            )
        if matching[0] in chosen.values():
            raise UsageError(f"bearings: {key!r} is named twice; name each bearing once")
        chosen[str(name)] = matching[0]
    return chosen


def _as_name(tag: Any) -> Any:
    """Return a ROSS tag as the ending of parameter names: "Bearing 0" becomes "Bearing_0"."""
    return re.sub(r"\W", "_", tag) if isinstance(tag, str) else tag


def _pair(what: str, place: Any) -> tuple[Any, Any]:
    if not isinstance(place, tuple | list) or len(place) != 2:
        raise UsageError(f"{what}: {place!r}; give (node, 'x'), (node, 'y'), (node, angle) or a ross.Probe")
    return place[0], place[1]


N_GYROSCOPIC = 4
"""Number of modes whose gyroscopic moments have static shapes of their own."""
_DEPENDENT = 1e-10  # of the largest; below it a shape is a sum of the others


def modal_basis(equations: LateralMatrices, modes: int, loads: FloatArray) -> FloatArray:
    r"""Return shapes that span the motion of a rotor for any coefficients of its unknown bearings.

    Parameters
    ----------
    equations : LateralMatrices
        Equations of the rotor.
    modes : int
        Number of modes of the rotor at rest on supports of the start values.
    loads : (n, n_loads) array
        Directions of the actuators.

    Returns
    -------
    (n, m) array
        Shapes :math:`\Phi`, orthonormal in the mass: :math:`\Phi^T M \Phi = I`.

    Raises
    ------
    UsageError
        When there are not that many modes.

    Notes
    -----
    To the modes come the static shapes under forces at the unknown bearings and at the actuators, and under the
    gyroscopic moments of the lowest modes (attachment modes; Craig, Structural Dynamics, ch. 19). With them the
    compliance at bearings and actuators is exact at frequency zero, whatever the number of modes.
    """
    n = len(equations.mass)
    if not 1 <= modes <= n:
        raise UsageError(f"modes = {modes}; the rotor has 1 to {n} lateral modes")
    supports = np.hstack([bearing.entry for bearing in equations.bearings])
    symmetric = (equations.stiffness + equations.stiffness.T) / 2.0
    stiff = np.repeat([_support(bearing.stiffness, symmetric) for bearing in equations.bearings], 2)
    supported = symmetric + (supports * stiff) @ supports.T
    _, shapes = scipy.linalg.eigh(supported, equations.mass, subset_by_index=[0, modes - 1])
    gyroscopic = (equations.damping - equations.damping.T) @ shapes[:, :N_GYROSCOPIC]
    loaded = np.hstack([supports, loads, gyroscopic])
    forced = np.linalg.solve(supported, loaded[:, loaded.any(axis=0)])
    full_size = _size(equations, forced)
    for _ in range(2):  # twice: what rounding leaves of the first projection is then as small as rounding
        forced = forced - shapes @ (shapes.T @ (equations.mass @ forced))
    size = _size(equations, forced)
    new = size > np.sqrt(_DEPENDENT) * full_size
    forced = forced[:, new] / size[new]
    if not forced.shape[1]:
        return np.asarray(shapes)
    weights, mix = np.linalg.eigh(forced.T @ equations.mass @ forced)
    kept = weights > _DEPENDENT * weights.max()
    return np.hstack([shapes, forced @ (mix[:, kept] / np.sqrt(weights[kept]))])


def _size(equations: LateralMatrices, shapes: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.einsum("ij,ij->j", shapes, equations.mass @ shapes)))


def _support(stiffness: FloatArray, shaft: FloatArray) -> float:
    """Return the support stiffness for the modal basis: a bearing's start value if positive, else a soft spring."""
    direct = float(np.mean(np.diag(stiffness)))
    return direct if direct > 0 else 1e-3 * float(np.diag(shaft).max())


_REDUCED_WELL = 0.01
"""Largest relative error of a frequency without a note: finite-element rotors and measured ones agree no better."""
_SPLIT = 1e-3
"""Share of an imaginary part from which on a pole oscillates: rounding splits a double real pole, one in each axis."""


@dataclass(frozen=True)
class ReducedMode:
    """Mode of the reduced rotor beside the mode of the full rotor, with the bearings at their start values.

    Attributes
    ----------
    frequency_hz, damping : float
        Natural frequency [Hz] and damping factor in the reduced model.
    whole_frequency_hz, whole_damping : float
        The same in the model with all lateral degrees of freedom.
    """

    frequency_hz: float
    damping: float
    whole_frequency_hz: float
    whole_damping: float

    @property
    def error(self) -> float:
        """Relative error of the natural frequency."""
        return self.frequency_hz / self.whole_frequency_hz - 1.0


@dataclass(frozen=True, init=False, eq=False, repr=False)
class RotorStructure(LinearStructure):
    """Finite-element rotor of ROSS as a structure, with the error of its modal reduction.

    Attributes
    ----------
    reduction : tuple of ReducedMode
        The lowest oscillating modes of the whole rotor, as many as were asked for, and the nearest ones of the reduced
        rotor.
    notes : tuple of str
        Remarks on the reduction.
    """

    reduction: tuple[ReducedMode, ...] = ()

    def __init__(
        self,
        name: str,
        parameters: Sequence[Parameter],
        matrices: Callable[[Values], Mapping[str, Any]],
        inputs: str | Sequence[str] = "u",
        outputs: str | Sequence[str] = "y",
        intersample: Hold | tuple[Hold, ...] = "zoh",
        reduction: tuple[ReducedMode, ...] = (),
    ) -> None:
        names = {"inputs": as_names(inputs), "outputs": as_names(outputs)}
        set_fields(self, {**locals(), **names, "parameters": tuple(parameters)})

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences about the modal reduction."""
        off = [mode for mode in self.reduction if abs(mode.error) > _REDUCED_WELL]
        if not off:
            return ()
        worst = max(off, key=lambda mode: abs(mode.error))
        text = (
            f"{len(off)} of {len(self.reduction)} modes of the reduced rotor differ from the full rotor by more than "
            f"{100 * _REDUCED_WELL:g} % in frequency; the worst has {worst.frequency_hz:.4g} Hz and damping "
            f"{worst.damping:.3g} in place of {worst.whole_frequency_hz:.4g} Hz and {worst.whole_damping:.3g}"
        )
        return (FitNote.REDUCED(text),)


def _reduction(equations: LateralMatrices, shapes: FloatArray, modes: int) -> tuple[ReducedMode, ...]:
    """Return the lowest oscillatory modes of the full rotor and the nearest modes of the reduced rotor."""
    whole, reduced = (_oscillating(equations.state_matrix(basis)) for basis in (None, shapes))
    whole = whole[:modes]
    rows, columns = scipy.optimize.linear_sum_assignment(np.abs(whole[:, None] - reduced) / np.abs(whole)[:, None])
    return tuple(ReducedMode(*_mode(reduced[j]), *_mode(whole[i])) for i, j in zip(rows, columns, strict=True))


def _oscillating(A: FloatArray) -> ComplexArray:
    values = np.linalg.eigvals(A)
    values = values[values.imag > _SPLIT * np.abs(values)]
    return np.asarray(values[np.argsort(np.abs(values))], complex)


def _mode(value: complex) -> tuple[float, float]:
    return float(abs(value) / (2 * pi)), float(-value.real / abs(value))


def from_ross(
    rotor: Any,
    *,
    sensors: Sequence[Place | Any],
    actuators: Sequence[Place | Any],
    bearings: Mapping[str, int | str] | Sequence[str] | None = None,
    speed_rpm: Annotated[Finite, Allowed("a finite number")] = 0.0,
    modes: int = 8,
    outputs: str | Sequence[str] = "p",
    inputs: str | Sequence[str] = "f",
    name: str = "rotor",
) -> RotorStructure:
    r"""Return a finite-element rotor of ROSS, modally reduced, as a structure with unknown bearing coefficients.

    Parameters
    ----------
    rotor : ross.Rotor
        Shaft, discs and bearings. The coefficients of the unknown bearings in it are the start values.
    sensors : sequence of (int, str) or ross.Probe
        Node and axis of each position that is measured, one for each output channel. The axis is ``"x"``, ``"y"`` or
        an angle from x to y [rad].
    actuators : sequence of (int or str, str)
        Node and axis of each force that is known, one for each input channel. With the tag of a magnetic bearing in
        place of the node, the input is its current along the axis [A].
    bearings : dict of str to (int or str), sequence of str, optional
        Bearings whose coefficients are unknown: tags of bearing elements, or names with the tag or node of each,
        ``{"left": 0, "right": 6}``. The names end the names of the parameters; a tag does so with ``_`` for blanks. All
        bearings to ground when not given. Others keep their coefficients, magnetic ones those of bearing and controller
        together.
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
    RotorStructure
        A `gbid.LinearStructure` for `gbid.fit`. The parameters of a bearing are ``k_xx_NAME`` to ``k_yy_NAME`` [N/m]
        and ``c_xx_NAME`` to ``c_yy_NAME`` [N s/m]; those of a magnetic bearing ``k_s_NAME`` [N/m] and ``k_i_NAME``
        [N/A]. `reduction` has the modes beside those of the whole rotor, `notes` name large errors of these.

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

    A magnetic bearing is the plant of its controller: it acts with :math:`k_s (x, y)^T + k_i (i_x, i_y)^T`. The
    controller that ROSS mixes into stiffness and damping of the element, its amplifier and its sensor are left out.
    """
    if not all(hasattr(rotor, part) for part in ("bearing_elements", "number_dof", "M", "K", "C", "G")):
        raise UsageError(f"a {type(rotor).__name__} is no rotor of ROSS; give a ross.Rotor")
    if not sensors:
        raise UsageError(f"structure {name!r}: no sensors; give the node and axis of each")
    equations = lateral_matrices(rotor, bearings, 2.0 * pi / 60.0 * float(speed_rpm))
    seen = _entries(equations, "sensors", sensors)
    driven = _entries(equations, "actuators", actuators)
    shapes = modal_basis(equations, int(modes), driven)
    currents = [
        equations.magnetic(f"actuators[{i}]", place[0]).name
        if not hasattr(place, "angle") and isinstance(place[0], str)
        else None
        for i, place in enumerate(actuators)
    ]
    return RotorStructure(
        name,
        [parameter for bearing in equations.bearings for parameter in _parameters(bearing)],
        _matrices(equations, shapes, seen, driven, currents),
        inputs=inputs,
        outputs=outputs,
        reduction=_reduction(equations, shapes, int(modes)),
    )


def _entries(equations: LateralMatrices, what: str, places: Sequence[Any]) -> FloatArray:
    columns = [equations.entry(f"{what}[{i}]", place) for i, place in enumerate(places)]
    return np.column_stack(columns) if columns else np.zeros((len(equations.mass), 0))


def _parameters(bearing: UnknownBearing) -> list[Parameter]:
    if bearing.force_per_current is not None:
        k_s = Parameter(f"k_s_{bearing.name}", -float(bearing.stiffness[0, 0]), unit="N/m")
        return [k_s, Parameter(f"k_i_{bearing.name}", bearing.force_per_current, unit="N/A")]
    coefficients = (("k", bearing.stiffness, "N/m"), ("c", bearing.damping, "N s/m"))
    return [
        Parameter(f"{letter}_{pair}_{bearing.name}", float(value), unit=unit)
        for letter, matrix, unit in coefficients
        for pair, value in zip(PAIRS, matrix.ravel(), strict=True)
    ]


def _matrices(
    equations: LateralMatrices,
    shapes: FloatArray,
    seen: FloatArray,
    driven: FloatArray,
    currents: Sequence[str | None],
) -> Any:
    """Return the function from the bearing coefficients to the state-space matrices.

    `currents` are the names of the magnetic bearings that the actuators drive; None for forces.
    """
    n = shapes.shape[1]
    stiffness, damping = (shapes.T @ matrix @ shapes for matrix in (equations.stiffness, equations.damping))
    at = {bearing.name: shapes.T @ bearing.entry for bearing in equations.bearings}
    magnetic = {bearing.name for bearing in equations.bearings if bearing.force_per_current is not None}
    held = stiffness + sum(at[b.name] @ b.stiffness @ at[b.name].T for b in equations.bearings)
    lowest = np.sort(np.abs(np.linalg.eigvals(held)))
    scale = float(np.sqrt(lowest[lowest > 1e-9 * lowest[-1]][0]))

    def matrices(p: Values) -> dict[str, Any]:
        k, c = ca.SX(ca.DM(stiffness)), ca.SX(ca.DM(damping))
        for name, entry in at.items():
            side = ca.DM(entry)
            if name in magnetic:
                k -= p[f"k_s_{name}"] * (side @ side.T)
                continue
            k += side @ _square(p, "k", name) @ side.T
            c += side @ _square(p, "c", name) @ side.T
        forces = ca.DM(shapes.T @ driven)
        columns = [forces[:, i] * (1.0 if name is None else p[f"k_i_{name}"]) for i, name in enumerate(currents)]
        return {
            "A": ca.blockcat([[ca.SX(n, n), scale * ca.SX.eye(n)], [-k / scale, -c]]),
            "B": ca.vertcat(ca.SX(n, len(columns)), ca.SX(ca.horzcat(*columns)) if columns else ca.SX(n, 0)),
            "C": ca.horzcat(ca.SX(ca.DM(seen.T @ shapes / scale)), ca.SX(seen.shape[1], n)),
        }

    return matrices


def _square(p: Values, letter: str, name: str) -> Any:
    xx, xy, yx, yy = (p[f"{letter}_{pair}_{name}"] for pair in PAIRS)
    return ca.blockcat([[ca.SX(xx), ca.SX(xy)], [ca.SX(yx), ca.SX(yy)]])
