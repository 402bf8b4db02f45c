"""Linear parameter-varying model: parameters of a structure as polynomials in scheduling variables (paper, Sec. 4)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from gbid.core.arrays import FloatArray, oscillatory_modes, point_label
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import ExtrapolationWarning, UsageError
from gbid.core.option_types import Positive, check_options, checks_arguments
from gbid.discretise.exact import check_holds
from gbid.structure import KEY_PARAMETERS, LinearModel, PiezoPair, Plant, RotorBearing
from gbid.structure.delay import with_pade
from gbid.structure.linear import Structure, model_function
from gbid.structure.scheduling import EXPONENTS, SCHEDULING, TERMS, Exponents, monomials, term_name

__all__ = ["EXPONENTS", "SCHEDULING", "TERMS", "basis", "polynomial", "regressors"]


def basis(*point: Any, exponents: Exponents = EXPONENTS) -> tuple[Any, ...]:
    """Return the values of the polynomial terms at a point, by default the six terms of Eq. 16.

    Parameters
    ----------
    *point : float, array or CasADi symbol
        Scheduling variables; for a gas bearing injection pressure P [bar] and rotational speed Omega [rpm]. Arrays
        broadcast against each other.
    exponents : tuple of tuple of int
        Powers of the variables in each term.

    Returns
    -------
    tuple
        Terms in the order of `exponents`, each of the type of the arguments; the constant is the number 1.
    """
    return tuple(_product(point, powers) for powers in exponents)


def _product(point: Sequence[Any], powers: Sequence[int]) -> Any:
    """Return one term as a product, which keeps the type of the variables; the float 1 for the constant term."""
    result: Any = 1.0
    for variable, power in zip(point, powers, strict=True):
        for _ in range(power):
            result = result * variable
    return result


def regressors(*point: npt.ArrayLike, exponents: Exponents = EXPONENTS) -> FloatArray:
    """Return the values of the terms at operating points as columns of the regression matrix of Eq. 16.

    Parameters
    ----------
    *point : float or array
        Scheduling variables; for a gas bearing [bar], [rpm]. Arrays broadcast against each other.
    exponents : tuple of tuple of int
        Powers of the variables in each term.

    Returns
    -------
    (..., n_terms) array
        Columns in the order of `exponents`.
    """
    values = np.broadcast_arrays(*(np.asarray(variable, float) for variable in point))
    return monomials(np.stack(values, axis=-1), exponents)


def polynomial(coefficients: Sequence[Any] | FloatArray, terms: Sequence[Any]) -> Any:
    """Return the value of a polynomial: the sum of coefficients times terms.

    Parameters
    ----------
    coefficients : sequence
        Coefficients in the order of the terms; numbers or symbols.
    terms : sequence
        Terms from `basis`.

    Returns
    -------
    float, array or CasADi expression
        Value of the polynomial.

    Raises
    ------
    UsageError
        When the numbers of coefficients and terms differ.
    """
    if len(coefficients) != len(terms):
        raise UsageError(f"{len(coefficients)} coefficients for {len(terms)} terms; give one for each term")
    return sum(c * t for c, t in zip(coefficients, terms, strict=True))


@dataclass(frozen=True, init=False)
class Domain:
    """Range of each scheduling variable; for a gas bearing a rectangle of pressures and speeds.

    Parameters
    ----------
    *bounds : (lowest, highest)
        Range of each variable; for a gas bearing injection pressure [bar] and rotational speed [rpm].
    variables : tuple of str
        Names of the variables.

    Raises
    ------
    UsageError
        When a bound is not finite or a range is empty.

    Examples
    --------
    >>> Domain((3, 7), (0, 6000)).contains(5, 2000)
    True
    """

    bounds: tuple[tuple[float, float], ...]
    variables: tuple[str, ...]

    @checks_arguments
    def __init__(self, *bounds: tuple[float, float], variables: tuple[str, ...] = SCHEDULING) -> None:
        if len(bounds) != len(variables):
            raise UsageError(f"domain: give the range of {', '.join(variables)}; got {len(bounds)} ranges")
        ranges = [(float(low), float(high)) for low, high in bounds]
        for name, (low, high) in zip(variables, ranges, strict=True):
            if not (np.isfinite([low, high]).all() and low <= high):
                raise UsageError(f"domain: {name} = [{low:g}, {high:g}]; give two finite numbers, lower first")
        object.__setattr__(self, "bounds", tuple(ranges))
        object.__setattr__(self, "variables", tuple(variables))

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Range of each scheduling variable, by name."""
        return dict(zip(self.variables, self.bounds, strict=True))

    @property
    def pressure_bar(self) -> tuple[float, float]:
        """Lowest and highest injection pressure [bar]."""
        return self.ranges["pressure_bar"]

    @property
    def speed_rpm(self) -> tuple[float, float]:
        """Lowest and highest rotational speed [rpm]."""
        return self.ranges["speed_rpm"]

    def label(self, *point: float) -> str:
        """Return the label of an operating point, see `gbid.core.arrays.point_label`.

        Parameters
        ----------
        *point : float
            Scheduling variables.
        """
        return point_label(*point, variables=self.variables)

    @property
    def corners(self) -> FloatArray:
        """Corners of the domain, (2^n_variables, n_variables)."""
        return np.array(np.meshgrid(*self.bounds, indexing="ij")).reshape(len(self.bounds), -1).T

    def contains(self, *point: npt.ArrayLike) -> bool:
        """Return whether all given points are inside the domain or on its border.

        Parameters
        ----------
        *point : float or array
            Scheduling variables; for a gas bearing [bar], [rpm].
        """
        values = [np.asarray(variable, float) for variable in point]
        return all(bool(((low <= v) & (v <= high)).all()) for v, (low, high) in zip(values, self.bounds, strict=True))

    def check(self, point: Sequence[Any], owner: str, extrapolate: bool = False, stacklevel: int = 3) -> None:
        """Refuse operating points outside the domain, or warn when extrapolation is allowed.

        Parameters
        ----------
        point : sequence of float or array
            Scheduling variables. CasADi symbols are not checked, because they have no values.
        owner : str
            What is evaluated, for the message.
        extrapolate : bool
            Whether points outside are allowed.
        stacklevel : int
            Number of calls between this method and the call that the warning shows, as in `warnings.warn`.

        Raises
        ------
        UsageError
            When a value is not a finite number, or when it lies outside and `extrapolate` is not set.

        Warns
        -----
        ExtrapolationWarning
            When a value lies outside and `extrapolate` is set.
        """
        if len(point) != len(self.variables):
            raise UsageError(f"{owner}: give {', '.join(self.variables)}; got {len(point)} values")
        for name, value, (low, high) in zip(self.variables, point, self.bounds, strict=True):
            if isinstance(value, ca.SX | ca.MX):
                continue
            values = _numbers(name, value, owner)
            outside = values[(values < low) | (values > high)]
            if not outside.size:
                continue
            text = f"{owner}: {name} = {outside[0]:g} lies outside its domain [{low:g}, {high:g}]"
            if not extrapolate:
                raise UsageError(f"{text}; choose a point inside or set extrapolate=True")
            warnings.warn(f"{text}: extrapolated", ExtrapolationWarning, stacklevel=stacklevel)


def _numbers(name: str, value: Any, owner: str) -> FloatArray:
    """Return finite numbers as a flat array."""
    raw = np.asarray(value)
    if raw.dtype.kind not in "fiu":
        raise UsageError(f"{owner}: {name} = {value!r} is not a number")
    values = raw.astype(float).ravel()
    if not np.isfinite(values).all():
        bad = values[~np.isfinite(values)][0]
        raise UsageError(f"{owner}: {name} = {bad:g} is not finite; give a finite number")
    return values


@dataclass(frozen=True)
class MachineData:
    """Machine data that no recording shows: moving mass, piezo travel, clearance; None where unknown.

    Parameters
    ----------
    moving_mass_kg : float, optional
        Mass that an impact accelerates [kg], to which the coefficients per kg refer.
    piezo_travel_m : float, optional
        Whole travel of a piezo stack [m].
    clearance_m : float, optional
        Radial clearance between rotor and bearing [m].

    Raises
    ------
    UsageError
        When a number is not positive.
    """

    moving_mass_kg: Positive | None = None
    piezo_travel_m: Positive | None = None
    clearance_m: Positive | None = None

    def __post_init__(self) -> None:
        check_options(self, "machine")

    def filled(self, other: MachineData) -> MachineData:
        """Return these machine data, with unknown values taken from others.

        Parameters
        ----------
        other : MachineData
            Numbers that take the places of those that are None.
        """
        return MachineData(*(a if a is not None else b for a, b in zip(astuple(self), astuple(other), strict=True)))


ACTUATOR_PARAMETERS = tuple(parameter.name for parameter in PiezoPair().parameters)
"""Names of the actuators' parameters: p1, p2 [rad/s] and kappa [m/m] of each axis (Eq. 12)."""


@dataclass(frozen=True)
class LPVModel(Brief):
    """LPV model: parameters of a structure as polynomials in scheduling variables.

    By default the structure is the rotor on its gas bearing, over injection pressure and speed.

    Parameters
    ----------
    name : str
        Name of the model.
    coefficients : dict of str to floats
        Coefficients of the terms for each parameter that is a surface. For a gas bearing six for each of the fourteen
        key parameters (`gbid.structure.KEY_PARAMETERS`), in the order of `TERMS` (Eq. 16), in SI per kg: k and
        b [N/(kg m)], d [N s/(kg m)], tau [s], per bar and rpm.
    domain : Domain
        Scheduling variables, and their range in which the model is valid.
    actuators : dict of str to float
        p1_x, p2_x, p1_y, p2_y [rad/s], kappa_x, kappa_y [m/m] (Eq. 12) in front of a gas bearing; empty when not known.
    pade_order : int
        Order of the approximation of the delays of a gas bearing in `at` and `plant_at`; the paper uses 1.
    operating_points : tuple of tuple of float
        Operating points at which models were identified.
    structure : Structure, optional
        Equations of a machine other than the gas bearing.
    exponents : tuple of tuple of int
        Powers of the scheduling variables in each term.
    held : dict of str to float
        Values of the parameters that are no surfaces.
    input_names, output_names : tuple of str
        Names of the channels.
    machine : MachineData
        Moving mass, travel of the piezos and clearance, as far as they are known.
    title, source : str
        Title, and publication or origin of the model.
    notes : tuple of str
        What a user should know about the file from which it was loaded: that it was changed by hand.

    Raises
    ------
    UsageError
        When a coefficient, value or actuator parameter is missing, unknown or not finite.
    """

    name: str
    coefficients: Mapping[str, tuple[float, ...]]
    domain: Domain
    actuators: Mapping[str, float] = field(default_factory=dict)
    pade_order: int = 1
    operating_points: tuple[tuple[Any, ...], ...] = ()
    structure: Structure | None = None
    exponents: Exponents = EXPONENTS
    held: Mapping[str, float] = field(default_factory=dict)
    input_names: tuple[str, ...] = ("u_x", "u_y")
    output_names: tuple[str, ...] = ("p_x", "p_y")
    title: str = ""
    source: str = ""
    notes: tuple[str, ...] = field(default=(), compare=False)
    machine: MachineData = MachineData()

    def __post_init__(self) -> None:
        check_options(self, "LPVModel")
        where = f"model {self.name!r}"
        names = tuple(parameter.name for parameter in self.equations.parameters)
        given = [*self.coefficients, *self.held]
        _check_names(f"{where}: coefficients", given, names)
        coefficients = {key: tuple(map(float, self.coefficients[key])) for key in names if key in self.coefficients}
        for key, values in coefficients.items():
            if len(values) != len(self.exponents) or not np.isfinite(values).all():
                raise UsageError(
                    f"{where}: coefficients of {key} = {list(values)}; give {len(self.exponents)} finite numbers "
                    f"for {', '.join(self.terms)}"
                )
        if self.actuators:
            _check_names(f"{where}: actuators", list(self.actuators), ACTUATOR_PARAMETERS)
        actuators = {}
        for key in ACTUATOR_PARAMETERS if self.actuators else ():
            value = self.actuators[key]
            is_number = isinstance(value, float | int | np.number) and bool(np.isfinite(value))
            if not is_number or (key.startswith("p") and value <= 0):
                raise UsageError(f"{where}: actuators: {key} = {value!r}; give a finite number, poles positive")
            actuators[key] = float(value)
        for name, mapping in (("coefficients", coefficients), ("actuators", actuators), ("held", dict(self.held))):
            object.__setattr__(self, name, MappingProxyType(mapping))

    def _brief(self) -> Description:
        ranges = [f"{name} {low:g} to {high:g}" for name, (low, high) in self.domain.ranges.items()]
        return brief(
            self,
            self.title or self.name,
            name=self.name,
            structure="" if self.structure is None else self.structure.name,
            domain=", ".join(ranges),
            coefficients=f"of {', '.join(self.coefficients)}",
            held=dict(self.held),
            actuators=self.actuators,
            operating_points=f"{len(self.operating_points)}",
            source=self.source,
            notes="; ".join(self.notes),
        )

    @property
    def equations(self) -> Structure:
        """Structure of the model, with scheduled and constant parameters."""
        return _bearing(self.pade_order) if self.structure is None else self.structure

    @property
    def scheduling(self) -> tuple[str, ...]:
        """Names of the scheduling variables."""
        return self.domain.variables

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the terms of the polynomials; for a gas bearing `TERMS`."""
        return tuple(term_name(exponent, self.scheduling) for exponent in self.exponents)

    def key_parameters(self, *point: Any, extrapolate: bool = False, **variables: Any) -> dict[str, Any]:
        """Return the parameters of the structure at operating points (Eq. 16).

        For a gas bearing these are the fourteen key parameters.

        Parameters
        ----------
        *point, **variables : float, array or CasADi symbol
            Scheduling variables in order or by name; for a gas bearing pressure_bar and speed_rpm. Arrays broadcast
            against each other. Numbers are checked against the domain, symbols are not.
        extrapolate : bool
            Whether numbers outside the domain are allowed.

        Returns
        -------
        dict of str to float, array or CasADi expression
            Of a gas bearing k and b [N/(kg m)], d [N s/(kg m)], tau [s].

        Raises
        ------
        UsageError
            When a point lies outside the domain and `extrapolate` is not set, or when a number is not finite.

        Warns
        -----
        ExtrapolationWarning
            When a point lies outside the domain and `extrapolate` is set.
        """
        return self._values(self._in_order(point, variables), extrapolate)

    def at(
        self, *point: float, pade_order: int | None = None, extrapolate: bool = False, **variables: float
    ) -> LinearModel:
        """Return the linear model at one operating point; for a gas bearing ``G_rb`` from u to p (Eq. 19).

        Parameters
        ----------
        *point, **variables : float
            Scheduling variables in order or by name; for a gas bearing pressure_bar [bar] and speed_rpm [rpm].
        pade_order : int, optional
            Order of the approximation of the delays of a gas bearing; by default that of the model.
        extrapolate : bool
            Whether a point outside the domain is allowed.

        Returns
        -------
        LinearModel
            Model in continuous time; of a gas bearing with inputs u_x, u_y and outputs p_x, p_y [m]. Its inter-sample
            behaviour is that of the structure: the piezo positions go linearly from sample to sample.

        Raises
        ------
        UsageError
            As for `key_parameters`; also when a delay is not positive.

        Warns
        -----
        ExtrapolationWarning
            When the point lies outside the domain and `extrapolate` is set.
        """
        place = self._in_order(point, variables, scalar=True)
        values = self._values(place, extrapolate)
        structure = self.structure or _bearing(self.pade_order if pade_order is None else pade_order)
        model = self._evaluate(structure, values, place, self.input_names, self.output_names)
        return replace(model, intersample=check_holds(structure.intersample, len(self.input_names)))

    def plant_at(
        self, *point: float, pade_order: int | None = None, extrapolate: bool = False, **variables: float
    ) -> LinearModel:
        """Return the plant at one operating point; of a gas bearing ``G = G_rb G_act``, from r to p (Eq. 20).

        Parameters, errors and warnings are those of `at`. A gas bearing without actuators is refused.

        Parameters
        ----------
        *point, pade_order, extrapolate, **variables
            As for `at`.

        Returns
        -------
        LinearModel
            Model in continuous time; of a gas bearing with inputs r_x, r_y and outputs p_x, p_y [m].
        """
        place = self._in_order(point, variables, scalar=True)
        values = {**self.actuators, **self._values(place, extrapolate)}
        structure = self.plant_structure(self.pade_order if pade_order is None else pade_order)
        return with_pade(self._evaluate(structure, values, place, *self.channels(structure)))

    def channels(self, plant: Structure) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the names of the inputs and outputs of a plant.

        Parameters
        ----------
        plant : Structure
            Equations from `plant_structure`.
        """
        piezos = (("r_x", "r_y"), ("p_x", "p_y"))
        return piezos if isinstance(plant, Plant) else (self.input_names, self.output_names)

    def plant_structure(self, pade_order: int | None) -> Structure:
        """Return the equations of `plant_at`.

        Parameters
        ----------
        pade_order : int, optional
            Order of the approximation of the delays of a gas bearing; exact delays for None.

        Raises
        ------
        UsageError
            When a gas bearing has no actuators.
        """
        if isinstance(self.structure, Plant):
            return Plant(_bearing(pade_order), self.structure.actuators, outputs=("p",))
        if self.structure is not None and not isinstance(self.structure, RotorBearing):
            return self.structure
        if not self.actuators:
            raise UsageError(f"model {self.name!r} has no actuators; give them in its file under 'actuators'")
        return Plant(_bearing(pade_order), PiezoPair(), outputs=("p",))

    def need_bearing(self, scheduling: tuple[str, ...] | None = SCHEDULING) -> None:
        """Refuse a model that is no gas bearing over pressure and speed.

        Parameters
        ----------
        scheduling : tuple of str, optional
            Needed scheduling variables; None for any.

        Raises
        ------
        UsageError
            When the model has a structure of its user, or other scheduling variables.
        """
        over = f"over {' and '.join(scheduling or self.scheduling)}; give model.at(...), which is linear"
        if self.structure is not None:
            text = f"model {self.name!r} is one of {self.structure.name!r}; this needs the model of a gas bearing"
            raise UsageError(f"{text} {over}")
        if scheduling not in (None, self.scheduling):
            text = f"model {self.name!r} is over {' and '.join(self.scheduling)}; this needs a model"
            raise UsageError(f"{text} {over}")

    def _in_order(self, point: Sequence[Any], variables: Mapping[str, Any], scalar: bool = False) -> tuple[Any, ...]:
        """Return scheduling variables, given by position or name, in the order of the domain."""
        later = self.scheduling[len(point) :]
        if unknown := [name for name in variables if name not in later]:
            raise UsageError(f"model {self.name!r}: {unknown[0]} given, too; give {', '.join(self.scheduling)}")
        place = (*point, *(variables[name] for name in later if name in variables))
        if len(place) != len(self.scheduling):
            raise UsageError(f"model {self.name!r}: give {', '.join(self.scheduling)}; got {len(place)} values")
        if scalar and any(np.ndim(value) != 0 for value in place):
            raise UsageError(f"model {self.name!r}: {place}; give one operating point")
        return place

    def _values(self, place: tuple[Any, ...], extrapolate: bool) -> dict[str, Any]:
        """Return the structure's parameter values at operating points, all in the shape of the points."""
        self.domain.check(place, f"model {self.name!r}", extrapolate, stacklevel=4)
        numbers = [_as_float(value) for value in place]
        terms = basis(*numbers, exponents=self.exponents)
        values = {key: polynomial(row, terms) for key, row in self.coefficients.items()} | dict(self.held)
        arrays = [value for value in numbers if isinstance(value, np.ndarray)]
        if not arrays:
            return values
        shape = np.zeros(np.broadcast_shapes(*(value.shape for value in arrays)))
        return {key: value + shape for key, value in values.items()}

    def _evaluate(
        self, structure: Any, values: Mapping[str, float], place: tuple[float, ...], *channels: tuple[str, ...]
    ) -> LinearModel:
        label = self.domain.label(*place)
        for key in ("tau_x", "tau_y"):
            if values.get(key, 1.0) <= 0:
                raise UsageError(
                    f"model {self.name!r}: {key} = {values[key]:g} s at {label}; "
                    "the polynomials do not hold where a delay is not positive"
                )
        return replace(model_function(structure)(values, *channels), name=f"{self.name} at {label}")


@lru_cache(maxsize=8)
def _bearing(pade_order: int | None) -> RotorBearing:
    """Return the rotor on its gas bearing without disturbance gains; refuses a Padé order below one."""
    return RotorBearing(pade_order, disturbance_gain="none")


def _check_names(where: str, given: Sequence[str], expected: tuple[str, ...]) -> None:
    """Refuse missing, unknown or repeated names."""
    missing = [name for name in expected if name not in given]
    unknown = [name for name in given if name not in expected]
    if missing:
        raise UsageError(f"{where}: {', '.join(missing)} missing; give a value for each of {', '.join(expected)}")
    if unknown:
        raise UsageError(f"{where}: {', '.join(unknown)} unknown; choose from {', '.join(expected)}")
    if len(given) > len(expected):
        raise UsageError(f"{where}: a parameter has both coefficients and a value; give one of the two")


def _as_float(value: Any) -> Any:
    """Return integers and lists as floats, so that powers cannot overflow; symbols are unchanged."""
    if isinstance(value, list | tuple | np.ndarray):
        return np.asarray(value, float)
    return float(value) if isinstance(value, int | float | np.integer | np.floating) else value


UNITS = {"tau": "s", "omega": "Hz", "zeta": "1", "g": "m/m"}
"""Unit by the name's first part."""

PUBLISHED_RMS = {
    "tau_x": 0.088e-3,
    "tau_y": 0.041e-3,
    "omega_1": 1.13,
    "omega_2": 0.58,
    "zeta_1": 0.0104,
    "zeta_2": 0.0063,
    "g_xx": 0.0031,
    "g_xy": 0.0022,
    "g_yx": 0.0027,
    "g_yy": 0.0031,
}
"""Rms deviations of the paper's 86 recordings from its surfaces (Sec. 4), in the units of `UNITS`."""

CHARACTERISTICS = tuple(PUBLISHED_RMS)
"""Names in order: delays [s], natural frequencies [Hz], damping factors, static gains [m/m]."""


def characteristics(values: npt.ArrayLike) -> FloatArray:
    """Return delays, modes and static gains from key parameters.

    Parameters
    ----------
    values : (n, 14) array
        Key parameters in the order of `gbid.structure.KEY_PARAMETERS`, SI per kg.

    Returns
    -------
    (n, 10) array
        Characteristics in the order of `CHARACTERISTICS`. Modes are by rising frequency. They are nan when there are
        not exactly two oscillatory modes.
    """
    values = np.atleast_2d(np.asarray(values, float))
    if values.shape[1:] != (len(KEY_PARAMETERS),):
        raise UsageError(f"values has shape {values.shape}; give (n, {len(KEY_PARAMETERS)}), a row for each point")
    column = {key: values[:, i] for i, key in enumerate(KEY_PARAMETERS)}
    K, D, B = (
        np.stack([column[f"{letter}_{pair}"] for pair in ("xx", "xy", "yx", "yy")], axis=-1).reshape(-1, 2, 2)
        for letter in "kdb"
    )
    A = np.zeros((len(values), 4, 4))
    A[:, :2, 2:], A[:, 2:, :2], A[:, 2:, 2:] = np.eye(2), K, D
    poles = np.linalg.eigvals(A)
    modes = np.full((len(values), 4), np.nan)
    for i, p in enumerate(poles):
        pairs = oscillatory_modes(p)
        if len(pairs) == 2:
            modes[i] = pairs.T.ravel()
    gains = -np.linalg.solve(K, B).reshape(-1, 4)
    return np.column_stack([column["tau_x"], column["tau_y"], modes, gains])


@dataclass(frozen=True)
class Deviation:
    """Deviation of recordings from the surfaces in one characteristic.

    Attributes
    ----------
    name, unit : str
        Name and unit of the characteristic.
    rms, largest : float
        Root mean square and largest absolute value of estimate minus surface, in `unit`.
    recording : str
        Recording with the largest deviation.
    published_rms : float
        Rms deviation in the paper, for its machine.
    """

    name: str
    unit: str
    rms: float
    largest: float
    recording: str
    published_rms: float


def deviations(estimated: FloatArray, surface: FloatArray, recordings: tuple[str, ...]) -> tuple[Deviation, ...]:
    """Deviations of the estimates' characteristics (n, 10) from the surfaces' characteristics (n, 10).

    Rows without two modes do not count for the modes.
    """
    rows = []
    for j, name in enumerate(CHARACTERISTICS):
        away = estimated[:, j] - surface[:, j]
        known = np.flatnonzero(np.isfinite(away))
        worst = known[int(np.argmax(np.abs(away[known])))] if len(known) else None
        rows.append(
            Deviation(
                name,
                UNITS[name.partition("_")[0]],
                float(np.sqrt(np.mean(away[known] ** 2))) if len(known) else np.nan,
                float(np.abs(away[worst])) if worst is not None else np.nan,
                recordings[worst] if worst is not None else "",
                PUBLISHED_RMS[name],
            )
        )
    return tuple(rows)
