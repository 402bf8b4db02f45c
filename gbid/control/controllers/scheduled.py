"""Gains that follow the operating point as polynomials in pressure and speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gbid.control.controllers.structures import controller_model
from gbid.discretise import Hold
from gbid.errors import UsageError
from gbid.lpv import TERMS, Domain, basis
from gbid.operating_point import point_label
from gbid.structure import LinearModel, LinearStructure, Parameter
from gbid.structure.linear import Structure
from gbid.structure.parameter import Values

_SUFFIX = dict(zip(TERMS, ("1", "P", "Omega", "OmegaP", "P2", "Omega2"), strict=True))


@dataclass(frozen=True)
class Scheduled:
    r"""A controller whose gains are polynomials in pressure and speed (terms of Eq. 16).

    .. math:: g(P, \Omega) = \sum_j c_j\, t_j(\tilde P, \tilde \Omega), \quad
              \tilde P = \frac{P - P_0}{\Delta P}, \quad \tilde \Omega = \frac{\Omega - \Omega_0}{\Delta \Omega}

    with the middle and the half width of the domain, so that pressure and speed run from -1 to 1 and all
    coefficients of a gain are of its own size. Its parameters are the coefficients, ``kappa_x_1``,
    ``kappa_x_P``, ``kappa_x_Omega``, ... for the gain ``kappa_x``.

    Parameters
    ----------
    base : Structure
        The controller at one operating point.
    terms : tuple of str
        Which of `gbid.lpv.TERMS`; ``"1"`` is among them.
    domain : Domain
        Range of pressure and speed.
    """

    base: Structure
    terms: tuple[str, ...]
    domain: Domain

    def __post_init__(self) -> None:
        unknown = [term for term in self.terms if term not in TERMS]
        if unknown or "1" not in self.terms or len(set(self.terms)) != len(self.terms):
            raise UsageError(
                f"{self.name}: terms = {list(self.terms)}; choose from {', '.join(map(repr, TERMS))}, "
                "each once and '1' among them"
            )

    @property
    def name(self) -> str:
        """Name of the base with the terms."""
        return f"{self.base.name} scheduled over {', '.join(self.terms)}"

    @property
    def inputs(self) -> tuple[str, ...]:
        """Those of the base."""
        return self.base.inputs

    @property
    def outputs(self) -> tuple[str, ...]:
        """Those of the base."""
        return self.base.outputs

    @property
    def intersample(self) -> Hold:
        """That of the base."""
        return self.base.intersample

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Coefficients, gain by gain: the constant within the gain's own bounds, the others within their half width.

        These bounds do not hold the gains themselves, which `gains` gives: constrain those at operating points.
        """
        return tuple(
            Parameter(self._coefficient(gain, term), *_range(gain, term), unit=gain.unit)
            for gain in self.base.parameters
            for term in self.terms
        )

    def gains(self, p: Mapping[str, Any], pressure_bar: Any, speed_rpm: Any) -> dict[str, Any]:
        """Gains at one operating point; coefficients and point may be numbers or symbols.

        Parameters
        ----------
        p : dict of str to float or casadi.SX
            Coefficients by name.
        pressure_bar, speed_rpm : float or casadi.SX

        Returns
        -------
        dict of str to float or casadi.SX
            By the names of the base's parameters.

        Raises
        ------
        UsageError
            When a coefficient is missing, or numbers lie outside the domain.
        """
        missing = [parameter.name for parameter in self.parameters if parameter.name not in p]
        if missing:
            raise UsageError(f"{self.name}: no value for {', '.join(missing)}")
        self.domain.check(pressure_bar, speed_rpm, self.name)
        scaled = (
            (value - (high + low) / 2) / ((high - low) / 2 or 1.0)
            for value, (low, high) in (
                (pressure_bar, self.domain.pressure_bar),
                (speed_rpm, self.domain.speed_rpm),
            )
        )
        values = dict(zip(TERMS, basis(*scaled), strict=True))
        return {
            gain.name: sum(p[self._coefficient(gain, term)] * values[term] for term in self.terms)
            for gain in self.base.parameters
        }

    def matrices(self, p: Values, pressure_bar: Any, speed_rpm: Any) -> Mapping[str, Any]:
        """Return A, B, C and D at one operating point; all arguments may be symbols.

        Parameters
        ----------
        p : Values
            Coefficients by name.
        pressure_bar, speed_rpm : float or casadi.SX
        """
        return self.base.matrices(Values(self.gains(p, pressure_bar, speed_rpm)))

    def at(self, pressure_bar: float, speed_rpm: float) -> LinearStructure:
        """Return the structure at one operating point, its parameters still the coefficients.

        Parameters
        ----------
        pressure_bar, speed_rpm : float
        """
        self.domain.check(pressure_bar, speed_rpm, self.name)
        return LinearStructure(
            f"{self.name} at {point_label(pressure_bar, speed_rpm)}",
            self.parameters,
            lambda p: self.matrices(p, pressure_bar, speed_rpm),
            self.inputs,
            self.outputs,
            self.intersample,
        )

    def _coefficient(self, gain: Parameter, term: str) -> str:
        return f"{gain.name}_{_SUFFIX[term]}"


def scheduled(
    structure: Structure, terms: Sequence[str] = ("1", "P", "Omega"), domain: Domain | None = None
) -> Scheduled:
    """Let a controller's gains follow pressure and speed.

    Parameters
    ----------
    structure : Structure
        The controller at one operating point; see `controller_structure`.
    terms : sequence of str
        Terms of the polynomials, from `gbid.lpv.TERMS`.
    domain : Domain, optional
        Range that scales pressure and speed: the model's own, ``lpv.domain``. 3 to 7 bar and 0 to 6000 rpm when
        not given.

    Returns
    -------
    Scheduled

    Raises
    ------
    UsageError
        For unknown or repeated terms, or without the constant one.
    """
    return Scheduled(structure, tuple(terms), domain or Domain((3.0, 7.0), (0.0, 6000.0)))


def controller_at(
    structure: Structure | Scheduled, gains: Mapping[str, float], pressure_bar: float, speed_rpm: float
) -> LinearModel:
    """Evaluate a controller at one operating point, whether its gains follow the point or not.

    Parameters
    ----------
    structure : Structure or Scheduled
    gains : dict of str to float
        A value for every parameter: gains, or the coefficients of scheduled ones.
    pressure_bar, speed_rpm : float

    Returns
    -------
    LinearModel
        Continuous, from p to r.

    Raises
    ------
    UsageError
        As `controller_model`; for a scheduled one also outside its domain.
    """
    if isinstance(structure, Scheduled):
        return controller_model(structure.base, structure.gains(gains, pressure_bar, speed_rpm))
    return controller_model(structure, gains)


def _range(gain: Parameter, term: str) -> tuple[float, float, float]:
    """Start and bounds of a coefficient."""
    if term == "1":
        return gain.start or 0.0, gain.lower, gain.upper
    half = (gain.upper - gain.lower) / 2
    return 0.0, -half, half
