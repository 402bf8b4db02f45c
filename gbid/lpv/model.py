"""Linear parameter-varying model of rotor, gas bearing and actuators (paper, Sec. 4)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal

import casadi as ca
import numpy as np
import numpy.typing as npt
from pydantic import AllowInfNan, ConfigDict, Field, Strict

from gbid.core.arrays import FloatArray, oscillatory_modes, point_label
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import ExtrapolationWarning, UsageError
from gbid.core.units import conversion_factor
from gbid.structure import KEY_PARAMETERS, LinearModel, PiezoPair, Plant, RotorBearing, evaluate
from gbid.structure.linear import Structure, model_function
from gbid.structure.scheduled import EXPONENTS, SCHEDULING, TERMS, monomials

# ---- Polynomial in pressure and speed for each key parameter (paper, Eq. 16).

__all__ = ["EXPONENTS", "SCHEDULING", "TERMS", "basis", "polynomial", "regressors"]


def basis(pressure_bar: Any, speed_rpm: Any) -> tuple[Any, ...]:
    """Return the values of the six terms of Eq. 16.

    Parameters
    ----------
    pressure_bar, speed_rpm : float, array or CasADi symbol
        Injection pressure P [bar] and rotational speed Omega [rpm]; arrays broadcast against each other.

    Returns
    -------
    tuple
        Terms in the order of `TERMS`, each of the type of the arguments; the first is the number 1.
    """
    return tuple(_power(pressure_bar, i) * _power(speed_rpm, j) for i, j in EXPONENTS)


def regressors(pressure_bar: npt.ArrayLike, speed_rpm: npt.ArrayLike) -> FloatArray:
    """Return the terms as columns of the regression matrix of Eq. 16.

    Parameters
    ----------
    pressure_bar, speed_rpm : (n_points,) array
        Operating points [bar], [rpm].

    Returns
    -------
    (n_points, 6) array
        Columns in the order of `TERMS`.
    """
    P, Omega = np.broadcast_arrays(np.asarray(pressure_bar, float), np.asarray(speed_rpm, float))
    return np.stack([term * np.ones(P.shape) for term in basis(P, Omega)], axis=-1)


def polynomial(coefficients: Sequence[Any] | FloatArray, terms: Sequence[Any]) -> Any:
    """Return the sum of coefficients times terms.

    Parameters
    ----------
    coefficients : sequence of 6
        Coefficients in the order of `TERMS`; numbers or symbols.
    terms : sequence of 6
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
        raise UsageError(f"{len(coefficients)} coefficients for {len(terms)} terms ({', '.join(TERMS)})")
    return sum(c * t for c, t in zip(coefficients, terms, strict=True))


def _power(variable: Any, exponent: int) -> Any:
    """Return a small power by products, which keep the type of the variable; exponent 0 gives the float 1."""
    result: Any = 1.0
    for _ in range(exponent):
        result = result * variable
    return result


# ---- Domain: the range of pressure and speed in which a model was identified.


@dataclass(frozen=True)
class Domain:
    """Rectangle of operating points.

    Parameters
    ----------
    pressure_bar : (lowest, highest)
        Injection pressure [bar].
    speed_rpm : (lowest, highest)
        Rotational speed [rpm].

    Raises
    ------
    UsageError
        When a bound is not finite or a range is empty.
    """

    pressure_bar: tuple[float, float]
    speed_rpm: tuple[float, float]

    def __post_init__(self) -> None:
        for name in ("pressure_bar", "speed_rpm"):
            low, high = (float(bound) for bound in getattr(self, name))
            if not (np.isfinite([low, high]).all() and low <= high):
                raise UsageError(f"domain: {name} = [{low:g}, {high:g}]; give two finite numbers, lower first")
            object.__setattr__(self, name, (low, high))

    def contains(self, pressure_bar: npt.ArrayLike, speed_rpm: npt.ArrayLike) -> bool:
        """Return whether all given points lie inside or on the border.

        Parameters
        ----------
        pressure_bar, speed_rpm : float or array
            Operating points [bar], [rpm].
        """
        return all(
            bool(((low <= np.asarray(v, float)) & (np.asarray(v, float) <= high)).all())
            for v, (low, high) in ((pressure_bar, self.pressure_bar), (speed_rpm, self.speed_rpm))
        )

    def check(
        self, pressure_bar: Any, speed_rpm: Any, owner: str, extrapolate: bool = False, stacklevel: int = 3
    ) -> None:
        """Refuse operating points outside, or warn when extrapolation is allowed.

        Parameters
        ----------
        pressure_bar, speed_rpm : float or array
            Operating points [bar], [rpm]. CasADi symbols are not checked, because they have no values.
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
        for name, value in (("pressure_bar", pressure_bar), ("speed_rpm", speed_rpm)):
            if isinstance(value, ca.SX | ca.MX):
                continue
            check_range(name, _numbers(name, value, owner), getattr(self, name), owner, extrapolate, stacklevel + 1)


def check_range(
    name: str, values: FloatArray, bounds: tuple[float, float], owner: str, extrapolate: bool, stacklevel: int
) -> None:
    """Refuse values of a scheduling variable outside its range, or warn when extrapolation is allowed.

    Parameters
    ----------
    name, owner : str
        Name of the variable, and what is evaluated, for the message.
    values : array
        Finite values.
    bounds : (lowest, highest)
        Range.
    extrapolate : bool
        Whether values outside are allowed.
    stacklevel : int
        Number of calls between this function and the call that the warning shows, as in `warnings.warn`.

    Raises
    ------
    UsageError
        When a value lies outside and `extrapolate` is not set.

    Warns
    -----
    ExtrapolationWarning
        When a value lies outside and `extrapolate` is set.
    """
    low, high = bounds
    outside = values[(values < low) | (values > high)]
    if outside.size == 0:
        return
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


# ---- Data of a machine in a model file besides the coefficients: values with unit and source.

Number = Annotated[float, Strict(), AllowInfNan(False)]
"""A finite number; text and booleans are refused when a file is read."""


class FileTable:
    """Base class of values that are read from a file; unknown keys are refused."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")


@dataclass(frozen=True)
class Quantity(FileTable):
    """Physical value as printed in its source.

    Attributes
    ----------
    value : float
        Number in `unit`.
    unit : str
        Unit as pint reads it.
    source : str
        Place in the publication.
    """

    value: Number
    unit: str
    source: str = ""

    def to(self, unit: str) -> float:
        """Return the value in another unit.

        Parameters
        ----------
        unit : str
            Unit as pint reads it.

        Raises
        ------
        UsageError
            When the units measure different quantities.
        """
        return self.value * conversion_factor(self.unit, unit)


@dataclass(frozen=True)
class Correction(FileTable):
    """Correction of one wrong entry of a published table.

    Parameters
    ----------
    entry : str
        ``name[term]`` for a coefficient, ``scale[letter]`` for a unit, or the name of an actuator parameter.
    printed, corrected : float
        Printed value and value that is used.
    reason : str
        Evidence for the error.
    """

    entry: str
    printed: Number
    corrected: Number
    reason: Annotated[str, Field(min_length=1)]


@dataclass(frozen=True)
class ProportionalDesign(FileTable):
    """Decentralised P controller with low-pass filter (Eq. 21); see `gbid.control.p_controller`.

    Attributes
    ----------
    kappa_x, kappa_y : float
        Gains [m/m].
    lowpass_hz : float
        Corner frequency of the low-pass filter [Hz].
    lowpass_order : int
        Order of the low-pass filter.
    source : str
        Place in the publication.
    """

    kappa_x: Number
    kappa_y: Number
    lowpass_hz: Number = 1000.0
    lowpass_order: Annotated[int, Strict(), Field(ge=0)] = 1
    source: str = ""


@dataclass(frozen=True)
class ReferenceModes(FileTable):
    """Modes that a source gives for one operating point.

    Attributes
    ----------
    pressure_bar, speed_rpm : float
        Operating point.
    loop : {"open", "closed"}
        Without or with the controller.
    kind : {"expected", "measured", "computed"}
        Origin of the modes: the model of the source, its recordings, or a computation.
    modes : tuple of (float, float)
        Natural frequency [Hz] and damping factor.
    source : str
        Place in the publication.
    """

    pressure_bar: Number
    speed_rpm: Number
    loop: Literal["open", "closed"]
    kind: Literal["expected", "measured", "computed"]
    modes: tuple[tuple[Number, Number], ...]
    source: str = ""


@dataclass(frozen=True)
class PiezoController(FileTable):
    """PD controller ``gain (s + zero)/(s + pole)`` of one piezo (Eq. A.1)."""

    gain: Number
    zero: Number
    pole: Number


@dataclass(frozen=True)
class PiezoControllers(FileTable):
    """PD controllers of the piezos 1 to n, with the units as printed."""

    unit: dict[str, str]
    piezos: tuple[PiezoController, ...]
    source: str = ""


ACTUATOR_PARAMETERS = tuple(parameter.name for parameter in PiezoPair().parameters)
"""Names of the actuators' parameters: p1, p2 [rad/s] and kappa [m/m] of each axis (Eq. 12)."""


@dataclass(frozen=True)
class LPVModel(Brief):
    """LPV model: key parameters as polynomials in injection pressure and speed, and the actuators.

    Parameters
    ----------
    name : str
        Name of the model.
    coefficients : dict of str to 6 floats
        Coefficients of Eq. 16 for each of the fourteen key parameters (`gbid.structure.KEY_PARAMETERS`), in the order
        of `gbid.lpv.TERMS`, in SI per kg: k and b [N/(kg m)], d [N s/(kg m)], tau [s], per bar and rpm.
    domain : Domain
        Operating points at which the model is valid.
    actuators : dict of str to float
        p1_x, p2_x, p1_y, p2_y [rad/s], kappa_x, kappa_y [m/m] (Eq. 12); empty when not known.
    pade_order : int
        Order of the approximation of the delays in `at` and `plant_at`; the paper uses 1.
    operating_points : tuple of (pressure_bar, speed_rpm)
        Operating points at which models were identified.
    controller : ProportionalDesign, optional
        Published controller of the machine.
    rig : dict of str to Quantity
        Dimensions and limits of the machine.
    piezo_controllers : PiezoControllers, optional
        Inner control loops of the piezos (Eq. A.1).
    reference_modes : tuple of ReferenceModes
        Modes that the source gives.
    corrections : tuple of Correction
        Corrections of the tables of the source; they are already applied to the coefficients.
    title, source : str
        Title, and publication or origin of the model.
    notes : tuple of str
        What a user should know about the file from which it was loaded: that it was changed by hand.

    Raises
    ------
    UsageError
        When a coefficient or actuator parameter is missing, unknown or not finite.
    """

    name: str
    coefficients: Mapping[str, tuple[float, ...]]
    domain: Domain
    actuators: Mapping[str, float] = field(default_factory=dict)
    pade_order: int = 1
    operating_points: tuple[tuple[float, float], ...] = ()
    controller: ProportionalDesign | None = None
    rig: Mapping[str, Quantity] = field(default_factory=dict)
    piezo_controllers: PiezoControllers | None = None
    reference_modes: tuple[ReferenceModes, ...] = ()
    corrections: tuple[Correction, ...] = ()
    title: str = ""
    source: str = ""
    notes: tuple[str, ...] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        where = f"model {self.name!r}"
        _check_names(f"{where}: coefficients", self.coefficients, KEY_PARAMETERS)
        coefficients = {key: tuple(float(c) for c in self.coefficients[key]) for key in KEY_PARAMETERS}
        for key, values in coefficients.items():
            if len(values) != len(TERMS) or not np.isfinite(values).all():
                raise UsageError(
                    f"{where}: coefficients of {key} = {list(values)}; give {len(TERMS)} finite numbers "
                    f"for {', '.join(TERMS)}"
                )
        if self.actuators:
            _check_names(f"{where}: actuators", self.actuators, ACTUATOR_PARAMETERS)
        actuators = {}
        for key in ACTUATOR_PARAMETERS if self.actuators else ():
            value = self.actuators[key]
            is_number = isinstance(value, float | int | np.number) and bool(np.isfinite(value))
            if not is_number or (key.startswith("p") and value <= 0):
                raise UsageError(f"{where}: actuators: {key} = {value!r}; give a finite number, poles positive")
            actuators[key] = float(value)
        for name, mapping in (("coefficients", coefficients), ("actuators", actuators), ("rig", dict(self.rig))):
            object.__setattr__(self, name, MappingProxyType(mapping))
        RotorBearing(pade_order=self.pade_order)  # raises an error for an order below one

    def _brief(self) -> Description:
        low, high = zip(self.domain.pressure_bar, self.domain.speed_rpm, strict=True)
        return brief(
            self,
            self.title or self.name,
            name=self.name,
            domain=f"{low[0]:g} to {high[0]:g} bar, {low[1]:g} to {high[1]:g} rpm",
            coefficients=f"of {', '.join(self.coefficients)}",
            actuators=self.actuators,
            operating_points=f"{len(self.operating_points)}",
            source=self.source,
            notes="; ".join(self.notes),
        )

    def key_parameters(self, pressure_bar: Any, speed_rpm: Any, *, extrapolate: bool = False) -> dict[str, Any]:
        """Return the fourteen key parameters at operating points (Eq. 16).

        Parameters
        ----------
        pressure_bar, speed_rpm : float, array or CasADi symbol
            Operating points [bar], [rpm]. Arrays broadcast against each other. Numbers are checked against the domain,
            symbols are not.
        extrapolate : bool
            Whether numbers outside the domain are allowed.

        Returns
        -------
        dict of str to float, array or CasADi expression
            k and b [N/(kg m)], d [N s/(kg m)], tau [s].

        Raises
        ------
        UsageError
            When a point lies outside the domain and `extrapolate` is not set, or when a number is not finite.

        Warns
        -----
        ExtrapolationWarning
            When a point lies outside the domain and `extrapolate` is set.
        """
        self.domain.check(pressure_bar, speed_rpm, f"model {self.name!r}", extrapolate)
        terms = basis(_as_float(pressure_bar), _as_float(speed_rpm))
        return {key: polynomial(self.coefficients[key], terms) for key in KEY_PARAMETERS}

    def at(
        self,
        pressure_bar: float,
        speed_rpm: float,
        *,
        pade_order: int | None = None,
        extrapolate: bool = False,
    ) -> LinearModel:
        """Return the rotor-bearing model ``G_rb`` at one operating point, from u to p (Eq. 19).

        Parameters
        ----------
        pressure_bar, speed_rpm : float
            Operating point [bar], [rpm].
        pade_order : int, optional
            Order of the approximation of the delays; by default that of the model.
        extrapolate : bool
            Whether a point outside the domain is allowed.

        Returns
        -------
        LinearModel
            Model in continuous time with inputs u_x, u_y and outputs p_x, p_y [m].

        Raises
        ------
        UsageError
            As for `key_parameters`; also when a delay is not positive.

        Warns
        -----
        ExtrapolationWarning
            When the point lies outside the domain and `extrapolate` is set.
        """
        values = self._numbers_at(pressure_bar, speed_rpm, extrapolate)
        return self._evaluate(self._bearing(pade_order), values, "u", (pressure_bar, speed_rpm))

    def plant_at(
        self,
        pressure_bar: float,
        speed_rpm: float,
        *,
        pade_order: int | None = None,
        extrapolate: bool = False,
    ) -> LinearModel:
        """Return the whole plant ``G = G_rb G_act`` at one operating point, from r to p (Eq. 20).

        Parameters, errors and warnings are those of `at`. A model without actuators is refused.

        Parameters
        ----------
        pressure_bar, speed_rpm, pade_order, extrapolate
            As for `at`.

        Returns
        -------
        LinearModel
            Model in continuous time with inputs r_x, r_y and outputs p_x, p_y [m].
        """
        if not self.actuators:
            raise UsageError(f"model {self.name!r} has no actuators; give them in its file under 'actuators'")
        values = {**self.actuators, **self._numbers_at(pressure_bar, speed_rpm, extrapolate)}
        plant = Plant(self._bearing(pade_order), PiezoPair(), outputs=("p",))
        return self._evaluate(plant, values, "r", (pressure_bar, speed_rpm))

    def _bearing(self, pade_order: int | None) -> RotorBearing:
        return RotorBearing(self.pade_order if pade_order is None else pade_order, disturbance_gain="none")

    def _numbers_at(self, pressure_bar: float, speed_rpm: float, extrapolate: bool) -> dict[str, float]:
        for name, value in (("pressure_bar", pressure_bar), ("speed_rpm", speed_rpm)):
            if np.ndim(value) != 0:
                raise UsageError(f"model {self.name!r}: {name} = {value!r}; give one operating point")
        self.domain.check(pressure_bar, speed_rpm, f"model {self.name!r}", extrapolate, stacklevel=4)
        terms = basis(float(pressure_bar), float(speed_rpm))
        values = {key: float(polynomial(self.coefficients[key], terms)) for key in KEY_PARAMETERS}
        for key in ("tau_x", "tau_y"):
            if values[key] <= 0:
                raise UsageError(
                    f"model {self.name!r}: {key} = {values[key]:g} s at {point_label(pressure_bar, speed_rpm)}; "
                    "the polynomials do not hold where a delay is not positive"
                )
        return values

    def _evaluate(
        self, structure: RotorBearing | Plant, values: Mapping[str, float], letter: str, point: tuple[float, float]
    ) -> LinearModel:
        names = tuple(f"{letter}_{axis}" for axis in "xy")
        model = _model_function(structure)(values, names, ("p_x", "p_y"))
        return replace(model, name=f"{self.name} at {point_label(*point)}")

    # pickle cannot store the read-only views, so plain dicts are sent to worker processes.
    def __getstate__(self) -> dict[str, Any]:
        return {k: dict(v) if isinstance(v, MappingProxyType) else v for k, v in self.__dict__.items()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        for key, value in state.items():
            object.__setattr__(self, key, MappingProxyType(value) if isinstance(value, dict) else value)


@lru_cache(maxsize=8)
def _model_function(structure: RotorBearing | Plant) -> Callable[..., LinearModel]:
    """Return the models of a structure for values; making its symbolic matrices takes longer than evaluating them."""
    return model_function(structure)


def _check_names(where: str, given: Mapping[str, Any], expected: tuple[str, ...]) -> None:
    """Refuse missing and unknown names."""
    missing = [name for name in expected if name not in given]
    unknown = [name for name in given if name not in expected]
    if missing:
        raise UsageError(f"{where}: {', '.join(missing)} missing")
    if unknown:
        raise UsageError(f"{where}: {', '.join(unknown)} unknown; there are {', '.join(expected)}")


def _as_float(value: Any) -> Any:
    """Return integers and lists as floats, because powers of integers could overflow; symbols are unchanged."""
    if isinstance(value, list | tuple | np.ndarray):
        return np.asarray(value, float)
    return float(value) if isinstance(value, int | float | np.integer | np.floating) else value


# ---- Characteristics of the machine from its key parameters: delays, modes and static gains.

CHARACTERISTICS = (
    *("tau_x", "tau_y"),
    *("omega_1", "omega_2", "zeta_1", "zeta_2"),
    *("g_xx", "g_xy", "g_yx", "g_yy"),
)
"""Names in order: delays [s], natural frequencies [Hz], damping factors, static gains [m/m]."""

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
"""Rms deviations that the paper gives for its 86 recordings (Sec. 4)."""

PUBLISHED_LARGEST_GAIN = 0.016
"""Largest deviation of a static gain in the paper [m/m] (Sec. 4)."""


def characteristics(values: npt.ArrayLike) -> FloatArray:
    """Return the delays, modes and static gains of key parameters.

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
        found = oscillatory_modes(p)
        if len(found) == 2:
            modes[i] = found.T.ravel()
    gains = -np.linalg.solve(K, B).reshape(-1, 4)
    return np.column_stack([column["tau_x"], column["tau_y"], modes, gains])


@dataclass(frozen=True)
class Deviation:
    """Deviation of the recordings from the surfaces in one characteristic.

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
    """Return the deviations of estimated characteristics from those of the surfaces, both (n, 10), by recording.

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


# ---- Model of any structure whose parameters are polynomials in scheduling variables.


@dataclass(frozen=True)
class ScheduledModel(Brief):
    """Linear parameter-varying model of any structure.

    Parameters
    ----------
    name : str
        Name of the model.
    structure : Structure
        Equations.
    scheduling : tuple of str
        Names of the scheduling variables.
    exponents : tuple of tuple of int
        Powers of the scheduling variables in each term.
    coefficients : dict of str to floats
        Coefficients of the terms for each parameter that is a surface, in the units of the structure and of the
        scheduling variables.
    domain : dict of str to (lowest, highest)
        Range of each scheduling variable in which the model is valid.
    held : dict of str to float
        Values of the other parameters.
    operating_points : tuple of tuple of float
        Operating points at which models were identified.
    input_names, output_names : tuple of str
        Names of the channels.

    Raises
    ------
    UsageError
        When a parameter of the structure has no value, or when there is one that the structure does not have.
    """

    name: str
    structure: Structure
    scheduling: tuple[str, ...]
    exponents: tuple[tuple[int, ...], ...]
    coefficients: Mapping[str, tuple[float, ...]]
    domain: Mapping[str, tuple[float, float]]
    held: Mapping[str, float] = field(default_factory=dict)
    operating_points: tuple[tuple[float, ...], ...] = ()
    input_names: tuple[str, ...] = ()
    output_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        expected = [parameter.name for parameter in self.structure.parameters]
        given = [*self.coefficients, *self.held]
        wrong = sorted(set(expected) ^ set(given))
        if wrong or len(given) > len(set(given)):
            raise UsageError(f"model {self.name!r}: give coefficients or a value for each of {', '.join(expected)}")
        for key in ("coefficients", "domain", "held"):
            object.__setattr__(self, key, dict(getattr(self, key)))

    def _brief(self) -> Description:
        ranges = [f"{name} {low:g} to {high:g}" for name, (low, high) in self.domain.items()]
        return brief(
            self,
            f"{self.structure.name}",
            name=self.name,
            domain=", ".join(ranges),
            coefficients=f"of {', '.join(self.coefficients)}",
            held=self.held,
        )

    def parameters_at(self, *point: npt.ArrayLike, extrapolate: bool = False) -> dict[str, FloatArray]:
        """Return the parameters at operating points.

        Parameters
        ----------
        *point : float or array
            Scheduling variables in the order of `scheduling`; arrays broadcast against each other.
        extrapolate : bool
            Whether points outside the domain are allowed.

        Returns
        -------
        dict of str to array
            Values of all parameters of the structure, each of the broadcast shape.

        Raises
        ------
        UsageError
            When the number of variables is wrong, a value is not finite, or a point lies outside the domain and
            `extrapolate` is not set.

        Warns
        -----
        ExtrapolationWarning
            When a point lies outside the domain and `extrapolate` is set.
        """
        values = self.checked(point, extrapolate)
        terms = self.terms(values)
        found = {name: np.asarray(terms @ np.asarray(row)) for name, row in self.coefficients.items()}
        shape = terms.shape[:-1]
        return {
            p.name: found[p.name] if p.name in found else np.full(shape, self.held[p.name])
            for p in self.structure.parameters
        }

    def at(self, *point: float, extrapolate: bool = False) -> LinearModel:
        """Return the linear model at one operating point.

        Parameters
        ----------
        *point : float
            Scheduling variables in the order of `scheduling`.
        extrapolate : bool
            Whether a point outside the domain is allowed.

        Returns
        -------
        LinearModel
            In continuous time.

        Raises
        ------
        UsageError
            As for `parameters_at`, and when the point is not one point.
        """
        if any(np.ndim(value) for value in point):
            raise UsageError(f"model {self.name!r}: give one operating point, a number for each scheduling variable")
        values = {name: float(value) for name, value in self.parameters_at(*point, extrapolate=extrapolate).items()}
        return evaluate(self.structure, values, self.input_names, self.output_names)

    def terms(self, values: FloatArray) -> FloatArray:
        """Return the terms of the polynomials at points `values`, (..., n_variables), as an array (..., n_terms)."""
        return monomials(values, self.exponents)

    def checked(self, point: tuple[npt.ArrayLike, ...], extrapolate: bool) -> FloatArray:
        """Return `point` as an array (..., n_variables); outside of the domain it is refused unless `extrapolate`."""
        if len(point) != len(self.scheduling):
            raise UsageError(f"model {self.name!r}: give {', '.join(self.scheduling)}; got {len(point)} values")
        values = np.stack(np.broadcast_arrays(*(np.asarray(each, float) for each in point)), axis=-1)
        if not np.isfinite(values).all():
            raise UsageError(f"model {self.name!r}: a scheduling variable is not finite")
        for i, name in enumerate(self.scheduling):
            check_range(name, values[..., i], self.domain[name], f"model {self.name!r}", extrapolate, stacklevel=5)
        return values
