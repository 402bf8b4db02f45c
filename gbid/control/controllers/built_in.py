"""Built-in controller structures: P, PD, PI, PID, notch, PPF, lead-lag, biquad, filter, observer, resonant, full ones.

A subclass of `gbid.control.controllers.parts.PerAxis` in this file is a built-in structure. The default of its field
`name` is its name in Python, YAML, controller files and messages. Nothing else has to know it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from types import MappingProxyType
from typing import Annotated, Any, ClassVar

import casadi as ca
import numpy as np
from annotated_types import Ge, Le

from gbid.control.controllers.parts import (
    AxisGain,
    PerAxis,
    PositiveRange,
    Range,
    System,
    first_order,
    gain_within,
    in_parallel,
    in_series,
    inside,
    pole_gains,
    second_order,
    symmetric_gain,
)
from gbid.core.errors import UsageError
from gbid.core.option_types import Allowed, CountOrZero, Exact, Finite, Positive

ProperOrder = Annotated[int, Exact(), Ge(1), Allowed("at least 1: without a low-pass it is not proper")]
FilterOrder = Annotated[int, Exact(), Ge(1), Le(8), Allowed("a whole number, 1 to 8")]


@dataclass(frozen=True)
class Proportional(PerAxis):
    """Base class of the structures with a gain kappa per axis, and a proportional controller themselves."""

    lower: Finite = -3.0
    upper: Finite = 3.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.lower < self.upper:
            raise UsageError(
                f"controller {self.name!r}: lower = {self.lower} must be below upper = {self.upper}", "lower"
            )

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return (gain_within("kappa", 0.0, (self.lower, self.upper), "m/m"),)

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        A, B, C, D = lowpass
        return A, B, gain["kappa"] * C, gain["kappa"] * D


@dataclass(frozen=True)
class Derivative(Proportional):
    """Base class of the structures with a derivative gain kd per axis, which the low-pass makes proper."""

    order: ProperOrder = 1
    kd_limit_ms: Positive = 3.0

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return (*super()._axis_gains(), symmetric_gain("kd", self.kd_limit_ms, "ms"))

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        A, B, C, D = super()._filter(gain, lowpass)
        n, seconds = lowpass[0].shape[0], 1e-3 * gain["kd"]
        # D = 0 of the low-pass: the derivative of its last stage is C (A x + B p)
        rate = ca.horzcat(lowpass[2] @ lowpass[0], ca.SX(1, A.shape[0] - n))
        return A, B, C + seconds * rate, D + seconds * (lowpass[2] @ lowpass[1])


@dataclass(frozen=True)
class PStructure(Proportional):
    r"""Decentralised proportional controller with low-pass (paper, Eq. 21).

    .. math:: K_i(s) = \kappa_i \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    The gains are ``kappa_x``, ``kappa_y`` [m/m].

    Parameters
    ----------
    lowpass_hz : float
        Corner frequency of the low-pass [Hz].
    order : int
        Order n of the low-pass; 0 for none.
    tune_corner : bool
        Whether the corner frequency is a gain as well, ``lowpass_khz`` [kHz].
    lower, upper : float
        Bounds of the gains [m/m].
    axes : tuple of str
        Names of the axes; ``("",)`` for one input and one output with plain names.
    """

    lower: Finite = 0.0
    name: str = "P"


@dataclass(frozen=True)
class PDStructure(Derivative):
    r"""Decentralised proportional and derivative controller; the low-pass makes it proper.

    .. math:: K_i(s) = (\kappa_i + k_{d,i} s) \left(\frac{p_{lp}}{s + p_{lp}}\right)^n, \quad n \ge 1

    The gains are ``kappa_x``, ``kappa_y`` [m/m], ``kd_x``, ``kd_y`` [ms].

    Parameters
    ----------
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`; the order is at least 1.
    lower, upper : float
        Bounds of the proportional gains [m/m].
    kd_limit_ms : float
        Bound on the magnitude of the derivative gains [ms].
    """

    name: str = "PD"


@dataclass(frozen=True)
class PIStructure(Proportional):
    r"""Proportional and integral controller with low-pass.

    .. math:: K_i(s) = \left(\kappa_i + \frac{k_{I,i}}{s}\right) \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    The gains per axis are ``kappa`` [m/m] and ``ki`` [1/s]. Feedback is positive, so a negative ``ki`` is stable, and
    the disc then returns to its set point under a steady force.

    Parameters
    ----------
    lower, upper : float
        Bounds of kappa [m/m].
    ki : (lowest, highest)
        Bounds of the integral gain [1/s], below zero.
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`.
    """

    ki: Range = (-1000.0, -1.0)
    name: str = "PI"

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return (*super()._axis_gains(), gain_within("ki", -20.0, self.ki, "1/s"))

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        return in_series(lowpass, (ca.SX(1, 1), ca.SX(1), ca.SX(gain["ki"]), ca.SX(gain["kappa"])))


@dataclass(frozen=True)
class PIDStructure(Derivative, PIStructure):
    r"""Proportional, integral and derivative controller; the low-pass makes it proper.

    .. math:: K_i(s) = \left(\kappa_i + \frac{k_{I,i}}{s} + k_{d,i} s\right)
                       \left(\frac{p_{lp}}{s + p_{lp}}\right)^n, \quad n \ge 1

    The gains per axis are ``kappa`` [m/m], ``ki`` [1/s] and ``kd`` [ms].

    Parameters
    ----------
    kd_limit_ms : float
        Bound on the magnitude of the derivative gains [ms].
    lower, upper, ki, lowpass_hz, order, tune_corner, axes
        As in `PIStructure`; the order is at least 1.
    """

    name: str = "PID"


@dataclass(frozen=True)
class NotchStructure(Proportional):
    r"""Proportional controller with a notch per axis.

    .. math:: K_i(s) = \kappa_i \frac{s^2 + 2 d_i \zeta_i \omega_i s + \omega_i^2}
                                     {s^2 + 2 \zeta_i \omega_i s + \omega_i^2}
                       \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    The gains per axis are ``kappa`` [m/m], ``frequency`` [kHz], ``width`` (zeta) and ``depth`` (d, the gain at the
    frequency: 0 blocks it, 1 is no notch, above 1 is a peak).

    Parameters
    ----------
    lower, upper : float
        Bounds of kappa [m/m].
    frequency_khz, width, depth : (lowest, highest)
        Bounds of frequency [kHz], width and depth.
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`.
    """

    frequency_khz: PositiveRange = (0.02, 1.5)
    width: PositiveRange = (0.05, 3.0)
    depth: PositiveRange = (0.01, 4.0)
    name: str = "notch"

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return (
            *super()._axis_gains(),
            gain_within("frequency", 0.15, self.frequency_khz, "kHz"),
            gain_within("width", 0.7, self.width, ""),
            gain_within("depth", 0.5, self.depth, ""),
        )

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        kappa, zeta = gain["kappa"], gain["width"]
        b = (kappa, 2 * gain["depth"] * zeta * kappa, kappa)
        return in_series(lowpass, second_order(b, gain["frequency"], zeta))


@dataclass(frozen=True)
class PPFStructure(Proportional):
    r"""Positive position feedback: a second-order low-pass per axis (Goh and Caughey 1985).

    .. math:: K_i(s) = \frac{\kappa_i \omega_i^2}{s^2 + 2 \zeta_i \omega_i s + \omega_i^2}

    The gains per axis are ``kappa`` [m/m], ``frequency`` [kHz] and ``damping``. It falls by 40 dB per decade, so that
    modes above its frequency are hardly excited.

    Parameters
    ----------
    lower, upper : float
        Bounds of kappa [m/m].
    frequency_khz, damping : (lowest, highest)
        Bounds of frequency [kHz] and damping factor of the filter.
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`; by default there is no further low-pass.
    """

    order: CountOrZero = 0
    lower: Finite = 0.0
    frequency_khz: PositiveRange = (0.02, 1.5)
    damping: PositiveRange = (0.05, 3.0)
    name: str = "PPF"

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return (*super()._axis_gains(), *pole_gains(self.frequency_khz, self.damping))

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        return in_series(lowpass, second_order((gain["kappa"], 0.0, 0.0), gain["frequency"], gain["damping"]))


@dataclass(frozen=True)
class LeadLagStructure(PerAxis):
    r"""Lead-lag controller: one first-order section per axis.

    .. math:: K_i(s) = \frac{\kappa_{\infty,i}\, s + \kappa_{0,i}\, \omega_i}{s + \omega_i}
                       \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    The gains per axis are ``low`` (at rest) and ``high`` (at high frequency) [m/m], and ``corner`` [kHz]. With high
    above low it leads, below low it lags.

    Parameters
    ----------
    gain_limit : float
        Bound on the magnitude of the gains [m/m].
    corner_khz : (lowest, highest)
        Bounds of the corner [kHz].
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`.
    """

    gain_limit: Positive = 5.0
    corner_khz: PositiveRange = (0.02, 1.5)
    name: str = "lead-lag"

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        low, high = (symmetric_gain(name, self.gain_limit) for name in ("low", "high"))
        return (low, high, gain_within("corner", 0.15, self.corner_khz, "kHz"))

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        return in_series(lowpass, first_order(gain["low"], gain["high"], gain["corner"]))


@dataclass(frozen=True)
class BiquadStructure(PerAxis):
    r"""Biquad controller: one second-order filter per axis.

    .. math:: K_i(s) = \frac{b_{2,i} s^2 + b_{1,i} \omega_i s + b_{0,i} \omega_i^2}
                            {s^2 + 2 \zeta_i \omega_i s + \omega_i^2}
                       \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    The numerator is scaled by the frequency of the filter, so that all gains are of order one: ``b0`` is the static
    gain and ``b2`` the gain at high frequency. The gains per axis are ``b0``, ``b1``, ``b2`` [m/m], ``frequency``
    [kHz] (``omega = 2 pi 1000 frequency``) and ``damping`` [-]. The bounds of the last two keep the filter stable.

    Parameters
    ----------
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`; by default there is no low-pass.
    gain_limit : float
        Bound on the magnitude of b0, b1 and b2 [m/m].
    frequency_khz, damping : (lowest, highest)
        Bounds of the frequency [kHz] and damping factor of the filter.
    """

    order: CountOrZero = 0
    gain_limit: Positive = 5.0
    frequency_khz: PositiveRange = (0.02, 1.5)
    damping: PositiveRange = (0.05, 3.0)
    name: str = "biquad"

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        numerator = (symmetric_gain(f"b{i}", self.gain_limit) for i in range(3))
        return (*numerator, *pole_gains(self.frequency_khz, self.damping))

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        b = [gain[f"b{i}"] for i in range(3)]
        return in_series(lowpass, second_order(b, gain["frequency"], gain["damping"]))


@dataclass(frozen=True)
class FilterStructure(PerAxis):
    r"""Filter of order n per axis, as a product of second-order sections.

    .. math:: K_i(s) = \prod_k \frac{b_{2,k} s^2 + b_{1,k} \omega_k s + b_{0,k} \omega_k^2}
                                    {s^2 + 2 \zeta_k \omega_k s + \omega_k^2}

    Numerators are scaled by the frequency of their section, so that all gains are of order one. ``b0`` of the first
    section is the static gain, that of the others is 1. At the start they are 1 at all frequencies. An odd order adds a
    section ``(c s + omega) / (s + omega)``. The gains of section k end in ``k``: ``b0_1_x``, ``frequency_2_y`` [kHz].

    Parameters
    ----------
    filter_order : int
        Order n per axis, 1 to 8.
    gain_limit : float
        Bound on the magnitude of the numerators' gains [m/m].
    frequency_khz, damping : (lowest, highest)
        Bounds of frequency [kHz] and damping factor of each section, which keep it stable.
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`; by default there is no low-pass.
    """

    order: CountOrZero = 0
    filter_order: FilterOrder = 4
    gain_limit: Positive = 5.0
    frequency_khz: PositiveRange = (0.02, 1.5)
    damping: PositiveRange = (0.05, 3.0)
    name: str = "filter"

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        limit, gains = self.gain_limit, [symmetric_gain("b0_1", self.gain_limit)]
        for k in range(1, self.filter_order // 2 + 1):
            zeta = inside(0.7, self.damping)
            gains += [
                symmetric_gain(f"b1_{k}", limit, start=0.0 if k == 1 else 2 * zeta),
                symmetric_gain(f"b2_{k}", limit, start=0.0 if k == 1 else 1.0),
                gain_within(f"frequency_{k}", 0.15 * 1.6 ** (k - 1), self.frequency_khz, "kHz"),
                gain_within(f"damping_{k}", zeta, self.damping, ""),
            ]
        if self.filter_order % 2:
            c = AxisGain("c", 0.0 if self.filter_order == 1 else 1.0, -limit, limit, "m/m")
            gains += [c, gain_within("corner", 0.3, self.frequency_khz, "kHz")]
        return tuple(gains)

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        system = lowpass
        for k in range(1, self.filter_order // 2 + 1):
            b = [gain["b0_1"] if k == 1 else 1.0, gain[f"b1_{k}"], gain[f"b2_{k}"]]
            system = in_series(system, second_order(b, gain[f"frequency_{k}"], gain[f"damping_{k}"]))
        if self.filter_order % 2:
            low = gain["b0_1"] if self.filter_order == 1 else 1.0
            system = in_series(system, first_order(low, gain["c"], gain["corner"]))
        return system


@dataclass(frozen=True)
class ObserverStructure(PerAxis):
    r"""State feedback from an observer that models one mode per axis.

    .. math:: \dot{\hat x} = \omega \begin{pmatrix} 0 & 1 \\ -1 & -2 \zeta_m \end{pmatrix} \hat x
              + \omega \begin{pmatrix} 0 \\ 1 \end{pmatrix} r
              + \omega \begin{pmatrix} l_1 \\ l_2 \end{pmatrix} (p - \hat x_1), \quad
              r = f_1 \hat x_1 + f_2 \hat x_2

    The states are position and velocity over omega. The gains per axis are ``l1``, ``l2`` of the observer, ``f1``,
    ``f2`` of the feedback [m/m], and ``frequency`` of the modelled mode [kHz]. Observer and feedback alone are stable
    within the bounds.

    Parameters
    ----------
    observer_limit, feedback_limit : float
        Bounds on l (from 0) and on the magnitude of f.
    frequency_khz : (lowest, highest)
        Bounds of the frequency of the mode [kHz].
    model_damping : float
        Damping factor of the modelled mode.
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`; by default there is no low-pass.
    """

    order: CountOrZero = 0
    observer_limit: Positive = 8.0
    feedback_limit: Positive = 3.0
    frequency_khz: PositiveRange = (0.02, 1.0)
    model_damping: Positive = 0.1
    name: str = "observer"

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        return (
            gain_within("l1", 1.0, (0.0, self.observer_limit), ""),
            gain_within("l2", 0.5, (-1.0, self.observer_limit), ""),
            symmetric_gain("f1", self.feedback_limit),
            symmetric_gain("f2", self.feedback_limit),
            gain_within("frequency", 0.12, self.frequency_khz, "kHz"),
        )

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        w = 2e3 * np.pi * gain["frequency"]
        l1, l2, f1, f2 = (gain[name] for name in ("l1", "l2", "f1", "f2"))
        A = ca.blockcat([[ca.SX(-w * l1), ca.SX(w)], [w * (f1 - 1 - l2), w * (f2 - 2 * self.model_damping)]])
        observer = A, ca.vertcat(ca.SX(w * l1), ca.SX(w * l2)), ca.horzcat(ca.SX(f1), ca.SX(f2)), ca.SX(1, 1)
        return in_series(lowpass, observer)


@dataclass(frozen=True)
class ResonantStructure(PerAxis):
    r"""Proportional controller with a resonant term at the speed, against synchronous vibration.

    .. math:: K_i(s) = \kappa_i L(s) + \frac{c_i \omega s + s_i \omega^2}{s^2 + 2 w_i \omega s + \omega^2}, \quad
              \omega^2 = \Omega^2 + \omega_0^2

    L is the low-pass. The gains per axis are ``kappa``, ``sine`` (s) and ``cosine`` (c) [m/m], and ``width`` (w). The
    frequency follows the speed: `gbid.tune` schedules this structure, and at each operating point it is another filter.
    A narrow term is a slow mode of the loop, whose damping counts like that of others.

    Parameters
    ----------
    lowest_hz : float
        Frequency of the term at rest, ``omega_0 / 2 pi`` [Hz].
    gain_limit : float
        Bound on the magnitude of the gains [m/m].
    width : (lowest, highest)
        Bounds of the damping factor of the term.
    speed_rpm : float or casadi.SX
        Speed of rotation; set by the schedule.
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`; the low-pass acts on kappa.
    """

    lowest_hz: Positive = 20.0
    gain_limit: Positive = 3.0
    width: PositiveRange = (0.02, 2.0)
    speed_rpm: Any = 0.0
    name: str = "resonant"

    def at_speed(self, speed_rpm: Any) -> ResonantStructure:
        """Return the structure at a speed, a number or a symbol [rpm]."""
        return replace(self, speed_rpm=speed_rpm)

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        gains = (symmetric_gain(name, self.gain_limit) for name in ("kappa", "sine", "cosine"))
        return (*gains, gain_within("width", 0.7, self.width, ""))

    def _filter(self, gain: Mapping[str, Any], lowpass: System) -> System:
        hz = ca.sqrt((self.speed_rpm / 60) ** 2 + self.lowest_hz**2)
        term = second_order((gain["sine"], gain["cosine"], 0.0), hz / 1e3, gain["width"])
        straight = in_series(lowpass, (ca.SX(0, 0), ca.SX(0, 1), ca.SX(1, 0), ca.SX(gain["kappa"])))
        return in_parallel(straight, term)


@dataclass(frozen=True)
class FullPStructure(Proportional):
    r"""Proportional controller with cross-coupling and low-pass.

    .. math:: K(s) = \begin{pmatrix} \kappa_{xx} & \kappa_{xy} \\ \kappa_{yx} & \kappa_{yy} \end{pmatrix}
                     \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    Parameters
    ----------
    lower, upper : float
        Bounds of the gains [m/m].
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`.
    """

    name: str = "full P"
    crossed: ClassVar[bool] = True


@dataclass(frozen=True)
class FullPDStructure(Derivative):
    r"""Proportional and derivative controller with cross-coupling; the low-pass makes it proper.

    .. math:: K_{ij}(s) = (\kappa_{ij} + k_{d,ij} s) \left(\frac{p_{lp}}{s + p_{lp}}\right)^n, \quad n \ge 1

    Parameters
    ----------
    lower, upper : float
        Bounds of kappa [m/m].
    kd_limit_ms : float
        Bound on the magnitude of the derivative gains [ms].
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`; the order is at least 1.
    """

    name: str = "full PD"
    crossed: ClassVar[bool] = True


@dataclass(frozen=True)
class FullBiquadStructure(BiquadStructure):
    r"""Biquad controller with cross-coupling: the filters of an input share their denominator.

    .. math:: K_{ij}(s) = \frac{b_{2,ij} s^2 + b_{1,ij} \omega_j s + b_{0,ij} \omega_j^2}
                               {s^2 + 2 \zeta_j \omega_j s + \omega_j^2} \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    The gains are ``b0_xx`` ... ``b2_yy`` [m/m], and ``frequency`` [kHz] and ``damping`` of each input.

    Parameters
    ----------
    gain_limit : float
        Bound on the magnitude of the numerators' gains [m/m].
    frequency_khz, damping : (lowest, highest)
        Bounds of frequency [kHz] and damping factor, which keep the filters stable.
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`; by default there is no low-pass.
    """

    name: str = "full biquad"
    crossed: ClassVar[bool] = True


@cache
def built_in_structures() -> Mapping[str, type[PerAxis]]:
    """Built-in structures by name: the classes of this file that have one."""
    classes = [c for c in globals().values() if isinstance(c, type) and issubclass(c, PerAxis) and c.name]
    return MappingProxyType({c.name: c for c in sorted(classes, key=lambda c: c.name)})
