"""Linear parameter-varying model of rotor, gas bearing and actuators (paper, Sec. 4)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np

from gbid.brief import Brief, Description, brief
from gbid.errors import UsageError
from gbid.lpv.basis import TERMS, basis, polynomial
from gbid.lpv.domain import Domain
from gbid.lpv.machine_data import Correction, PiezoControllers, ProportionalDesign, Quantity, ReferenceModes
from gbid.operating_point import point_label
from gbid.structure import KEY_PARAMETERS, LinearModel, PiezoPair, Plant, RotorBearing
from gbid.structure.linear import model_function

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
