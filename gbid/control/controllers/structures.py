"""Controllers of fixed structure, built-in or user-defined, with constant or scheduled gains, and their models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from math import isfinite
from typing import Any

from gbid.control.controllers.built_in import AXES, NOT_OPTIONS, PerAxis, PStructure, built_in_structures
from gbid.core.errors import UsageError
from gbid.lpv import Domain
from gbid.lpv.model import basis
from gbid.structure import LinearModel, LinearStructure, Parameter
from gbid.structure.linear import OnBase, Structure, model_function
from gbid.structure.parameter import Values
from gbid.structure.scheduling import SCHEDULING, exponents_of, term_name


def p_controller(kappa_x: float, kappa_y: float, lowpass_hz: float = 1000.0, order: int = 1) -> LinearModel:
    r"""Return a decentralised proportional controller with low-pass (paper, Eq. 21).

    .. math:: K_{pl}(s) = \mathrm{diag}(\kappa_x, \kappa_y) \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    Parameters
    ----------
    kappa_x, kappa_y : float
        Gains [m/m]. Positive gains are positive feedback (see `gbid.control.close_loop`), as in the paper.
    lowpass_hz : float
        Corner frequency of the low-pass [Hz]; ``p_lp = 2 pi lowpass_hz`` in rad/s.
    order : int
        Order n of the low-pass; 0 for none.

    Returns
    -------
    LinearModel
        Continuous; inputs p_x, p_y, outputs r_x, r_y [m]; n states per axis.

    Raises
    ------
    UsageError
        When gains are not finite, the corner frequency is not positive, or the order is negative.
    """
    structure = PStructure(lowpass_hz, order)
    model = controller_model(structure, {"kappa_x": kappa_x, "kappa_y": kappa_y})
    states = tuple(f"lowpass{i + 1}_{axis}" for axis in structure.axes for i in range(order))
    return replace(model, state_names=states, name="p_controller")


def controller_structure(kind: str | Structure, **options: Any) -> Structure:
    """Return the structure of a controller from the disc position p to the piezo reference r.

    Parameters
    ----------
    kind : str or Structure
        A built-in structure with one filter per axis, ``"P"``, ``"PD"``, ``"PI"``, ``"PID"``, ``"biquad"``,
        ``"filter"`` (any order), ``"lead-lag"``, ``"notch"``, ``"PPF"``, ``"observer"``, ``"resonant"``; one with
        cross-coupling, ``"full P"``, ``"full PD"``, ``"full biquad"``; or your own: a `gbid.LinearStructure` with its
        gains as parameters, and any number of inputs and outputs.
    **options
        Options of a built-in structure: ``lowpass_hz``, ``order``, ``tune_corner``, ``axes`` and bounds. The table of
        structures is in the documentation (control).

    Returns
    -------
    Structure
        It has `parameters` (the gains, with start values and bounds) and symbolic `matrices`.

    Raises
    ------
    UsageError
        When a kind or option is unknown, when options are given with your own structure, or when bounds do not fit.

    Notes
    -----
    The loop is closed as ``r = K p`` (Eq. 21): positive gains are positive feedback.
    """
    built_in = built_in_structures()
    if not isinstance(kind, str) and isinstance(kind, Structure):
        if options:
            raise UsageError(f"controller {kind.name!r}: options {', '.join(options)} belong to built-in structures")
        return kind
    if not isinstance(kind, str) or kind not in built_in:
        raise UsageError(f"controller = {kind!r}; choose {', '.join(map(repr, built_in))} or give a structure")
    known = [each.name for each in fields(built_in[kind]) if each.name not in NOT_OPTIONS]
    unknown = [name for name in options if name not in known]
    if unknown:
        raise UsageError(f"controller {kind!r}: unknown option {', '.join(unknown)}; choose from {', '.join(known)}")
    return built_in[kind](**options)


def controller_model(structure: Structure, gains: Mapping[str, float]) -> LinearModel:
    """Return the model of a controller structure for given gains.

    Parameters
    ----------
    structure : Structure
        Structure of the controller.
    gains : dict of str to float
        A value for every parameter.

    Returns
    -------
    LinearModel
        Continuous; inputs and outputs have the names that the structure gives them.

    Raises
    ------
    UsageError
        When a gain is missing, unknown or not finite.
    """
    names = [parameter.name for parameter in structure.parameters]
    unknown = [name for name in gains if name not in names]
    if unknown:
        raise UsageError(f"controller {structure.name!r}: no gain {', '.join(unknown)}; choose from {', '.join(names)}")
    for name in names:
        if name in gains and not isfinite(gains[name]):
            raise UsageError(f"controller {structure.name!r}: {name} = {gains[name]}; give a finite number")
    model = model_function(structure)(gains, (), ())
    (n_r, n_p), (inputs, outputs) = model.D.shape, (structure.inputs, structure.outputs)
    return replace(model, input_names=_channels(inputs, n_p), output_names=_channels(outputs, n_r))


def _channels(names: tuple[str, ...], count: int) -> tuple[str, ...]:
    """Return channel names; with several channels per signal they end with the axis or with a number."""
    if len(names) == count:
        return names
    ends = AXES if count == len(AXES) else range(1, count + 1)
    return tuple(f"{names[0] if names else 'channel'}_{end}" for end in ends)


# ---- Scheduled gains: polynomials in the scheduling variables.


@dataclass(frozen=True)
class Scheduled(OnBase):
    r"""Controller whose gains are polynomials in scheduling variables; by default pressure and speed (Eq. 16).

    .. math:: g(P, \Omega) = \sum_j c_j\, t_j(\tilde P, \tilde \Omega), \quad
              \tilde P = \frac{P - P_0}{\Delta P}, \quad \tilde \Omega = \frac{\Omega - \Omega_0}{\Delta \Omega}

    P_0 and Omega_0 are the middle of the domain, Delta P and Delta Omega its half widths. So the scaled pressure and
    speed lie between -1 and 1, and all coefficients of a gain have its order of magnitude. The parameters are the
    coefficients, ``kappa_x_1``, ``kappa_x_P``, ``kappa_x_Omega``, ... for the gain ``kappa_x``. Other variables are
    scaled alike, and have the names that the domain gives them: ``kappa_x_eccentricity2``.

    Parameters
    ----------
    base : Structure
        Structure of the controller at one operating point.
    terms : tuple of str
        Terms of `TERMS`, or of other variables such as ``"gap^2"``; ``"1"`` must be one of them.
    domain : Domain
        Scheduling variables with their ranges.
    """

    terms: tuple[str, ...]
    domain: Domain

    def __post_init__(self) -> None:
        known = self._exponents
        if "1" not in self.terms or not known.keys() >= set(self.terms) or len(set(self.terms)) != len(self.terms):
            raise UsageError(
                f"{self.name}: terms = {list(self.terms)}; choose from {', '.join(map(repr, known))}, "
                "each once and '1' among them"
            )

    @property
    def _exponents(self) -> dict[str, tuple[int, ...]]:
        """Powers of the variables by term, up to order 2."""
        variables = self.domain.variables
        return {term_name(powers, variables): powers for powers in exponents_of(2, len(variables))}

    @property
    def name(self) -> str:
        """Name of the base structure, followed by the terms of the schedule."""
        return f"{self.base.name} scheduled over {', '.join(self.terms)}"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Coefficients of all gains, sorted by gain.

        The constant term has the bounds of the gain, the other terms have plus and minus half their width. These
        bounds do not limit the gains themselves. Limit the values of `gains` at operating points for that.
        """
        return tuple(
            Parameter(self._coefficient(gain, term), *_range(gain, term), unit=gain.unit)
            for gain in self.base.parameters
            for term in self.terms
        )

    def gains(self, p: Mapping[str, Any], *point: Any) -> dict[str, Any]:
        """Return the gains at one operating point, for numbers or symbols.

        Parameters
        ----------
        p : dict of str to float or casadi.SX
            Coefficients by name.
        *point : float or casadi.SX
            Scheduling variables.

        Returns
        -------
        dict of str to float or casadi.SX
            Gains by the names of the parameters of the base structure.

        Raises
        ------
        UsageError
            When a coefficient is missing, or when numbers lie outside the domain.
        """
        missing = [parameter.name for parameter in self.parameters if parameter.name not in p]
        if missing:
            raise UsageError(f"{self.name}: no value for {', '.join(missing)}")
        self.domain.check(point, self.name)
        scaled = (
            (value - (high + low) / 2) / ((high - low) / 2 or 1.0)
            for value, (low, high) in zip(point, self.domain.bounds, strict=True)
        )
        powers = tuple(self._exponents[term] for term in self.terms)
        values = dict(zip(self.terms, basis(*scaled, exponents=powers), strict=True))
        return {
            gain.name: sum(p[self._coefficient(gain, term)] * values[term] for term in self.terms)
            for gain in self.base.parameters
        }

    def matrices(self, p: Values, *point: Any) -> Mapping[str, Any]:
        """Return A, B, C and D at one operating point; all arguments may be symbols.

        Parameters
        ----------
        p : Values
            Coefficients by name.
        *point : float or casadi.SX
            Scheduling variables.
        """
        return self.base_at(*point).matrices(Values(self.gains(p, *point)))

    def base_at(self, *point: Any) -> Structure:
        """Return the base structure at a point; it changes only if its matrices depend on the speed.

        Parameters
        ----------
        *point : float or casadi.SX
            Scheduling variables.

        Raises
        ------
        UsageError
            When the matrices depend on the speed, which is no scheduling variable.
        """
        if not (isinstance(self.base, PerAxis) and self.base.follows_speed):
            return self.base
        if "speed_rpm" not in self.domain.variables:
            text = f"{self.base.name} follows speed_rpm; the scheduling variables are"
            raise UsageError(f"{text} {', '.join(self.domain.variables)}")
        return self.base.at_speed(point[self.domain.variables.index("speed_rpm")])

    def at(self, *point: float) -> LinearStructure:
        """Return the structure at one operating point; its parameters are the coefficients of the schedule.

        Parameters
        ----------
        *point : float
            Scheduling variables.
        """
        self.domain.check(point, self.name)
        return LinearStructure(
            f"{self.name} at {self.domain.label(*point)}",
            self.parameters,
            lambda p: self.matrices(p, *point),
            self.inputs,
            self.outputs,
            self.intersample,
        )

    @property
    def uses(self) -> set[str]:
        """Names of the variables in the terms."""
        powers = [self._exponents[term] for term in self.terms]
        return {name for i, name in enumerate(self.domain.variables) if any(each[i] for each in powers)}

    def _coefficient(self, gain: Parameter, term: str) -> str:
        gap = "" if self.domain.variables == SCHEDULING else "_"
        return f"{gain.name}_{term.replace('^', '').replace(' ', gap)}"


def scheduled(
    structure: Structure, terms: Sequence[str] = ("1", "P", "Omega"), domain: Domain | None = None
) -> Scheduled:
    """Return a controller structure whose gains depend on scheduling variables, by default pressure and speed.

    Parameters
    ----------
    structure : Structure
        Structure of the controller at one operating point; see `controller_structure`.
    terms : sequence of str
        Terms of the polynomials up to order 2: those of `TERMS`, or of the variables of `domain`, as in `gbid.fit_lpv`.
    domain : Domain, optional
        Scheduling variables and the ranges that scale them, usually ``lpv.domain``. By default 3 to 7 bar and 0 to
        6000 rpm.

    Returns
    -------
    Scheduled

    Raises
    ------
    UsageError
        When a term is unknown or repeated, or when the constant term is missing.
    """
    return Scheduled(structure, tuple(terms), domain or Domain((3.0, 7.0), (0.0, 6000.0)))


def with_schedule(structure: Structure | Scheduled, domain: Domain | None = None) -> Structure | Scheduled:
    """Return a structure; if its matrices depend on the speed, with a schedule of constant gains.

    Parameters
    ----------
    structure : Structure or Scheduled
        Structure of the controller.
    domain : Domain, optional
        Scheduling variables with their ranges, as for `scheduled`.
    """
    if isinstance(structure, PerAxis) and structure.follows_speed:
        return scheduled(structure, ("1",), domain)
    return structure


def controller_at(structure: Structure | Scheduled, gains: Mapping[str, float], *point: float) -> LinearModel:
    """Return a controller, scheduled or not, at one operating point.

    Parameters
    ----------
    structure : Structure or Scheduled
        Structure of the controller.
    gains : dict of str to float
        A value for every parameter: gains, or coefficients of scheduled gains.
    *point : float
        Scheduling variables of a scheduled controller, such as pressure [bar] and speed [rpm].

    Returns
    -------
    LinearModel
        Continuous, from p to r.

    Raises
    ------
    UsageError
        As for `controller_model`; for a scheduled controller also when the point lies outside its domain.
    """
    if isinstance(structure, Scheduled):
        return controller_model(structure.base_at(*point), structure.gains(gains, *point))
    return controller_model(structure, gains)


def _range(gain: Parameter, term: str) -> tuple[float, float, float]:
    """Return start value and bounds of a coefficient of a scheduled gain."""
    if term == "1":
        return gain.start or 0.0, gain.lower, gain.upper
    half = (gain.upper - gain.lower) / 2
    return 0.0, -half, half
