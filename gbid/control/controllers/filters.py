"""Built-in controller structures: a filter and a low-pass per axis, from disc position p to reference r."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf, isfinite
from typing import Any

import casadi as ca
import numpy as np

from gbid.control.controllers.lowpass import Lowpass
from gbid.discretise import Hold
from gbid.errors import UsageError
from gbid.structure import Parameter
from gbid.structure.parameter import Values

AXES = ("x", "y")
INPUTS = ("p_x", "p_y")
OUTPUTS = ("r_x", "r_y")


@dataclass(frozen=True)
class PerAxis:
    """Base class of the built-in structures: one filter per axis in series with a low-pass.

    Parameters
    ----------
    lowpass_hz : float
        Corner frequency of the low-pass ``(p_lp / (s + p_lp))^n`` of each axis [Hz].
    order : int
        Order n of the low-pass; 0 for none.
    tune_corner : bool
        Whether the corner frequency is a gain as well, ``lowpass_khz`` [kHz], common to both axes.
    """

    lowpass_hz: float = 1000.0
    order: int = 1
    tune_corner: bool = False
    name: str = ""
    inputs: tuple[str, ...] = INPUTS
    outputs: tuple[str, ...] = OUTPUTS
    intersample: Hold = "foh"

    def __post_init__(self) -> None:
        Lowpass(self.lowpass_hz, self.order).check(f"controller {self.name!r}")
        if self.tune_corner and self.order == 0:
            raise UsageError(f"controller {self.name!r}: tune_corner needs a low-pass; give an order of at least 1")
        if self.tune_corner and not 0.05 <= self.lowpass_hz / 1e3 <= 2.5:
            raise UsageError(
                f"controller {self.name!r}: lowpass_hz = {self.lowpass_hz:g}; to be tuned it must start in 50 to 2500"
            )

    def _axis_gains(self) -> tuple[tuple[str, float, float, float, str], ...]:
        """Return name, start, lower, upper and unit of each gain of an axis."""
        raise NotImplementedError

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        """Return A, B, C, D of one axis for its gains and its low-pass."""
        raise NotImplementedError

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Gains of x and y, by kind; the corner frequency is last when it is tuned."""
        gains = [
            Parameter(f"{name}_{axis}", start, lower, upper, unit=unit)
            for name, start, lower, upper, unit in self._axis_gains()
            for axis in AXES
        ]
        if self.tune_corner:
            gains.append(Parameter("lowpass_khz", self.lowpass_hz / 1e3, 0.05, 2.5, unit="kHz"))
        return tuple(gains)

    def matrices(self, p: Values) -> dict[str, Any]:
        """Return A, B, C and D for gains by name."""
        corner = p["lowpass_khz"] * 1e3 if self.tune_corner else self.lowpass_hz
        lowpass = Lowpass(corner, self.order).matrices()
        names = [gain[0] for gain in self._axis_gains()]
        axes = [self._filter({name: p[f"{name}_{axis}"] for name in names}, lowpass) for axis in AXES]
        return {letter: ca.diagcat(*(axis[i] for axis in axes)) for i, letter in enumerate("ABCD")}

    def _check_bounds(self, **bounds: float) -> None:
        for name, value in bounds.items():
            if not isfinite(value):
                raise UsageError(f"controller {self.name!r}: {name} = {value}; give a finite number")


@dataclass(frozen=True)
class PStructure(PerAxis):
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
    """

    lower: float = 0.0
    upper: float = 3.0
    name: str = "P"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_bounds(lower=self.lower, upper=self.upper)

    def _axis_gains(self) -> tuple[tuple[str, float, float, float, str], ...]:
        return (("kappa", min(max(0.0, self.lower), self.upper), self.lower, self.upper, "m/m"),)

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        A, B, C, D = lowpass
        return A, B, gain["kappa"] * C, gain["kappa"] * D


@dataclass(frozen=True)
class PDStructure(PerAxis):
    r"""Decentralised proportional and derivative controller; the low-pass makes it proper.

    .. math:: K_i(s) = (\kappa_i + k_{d,i} s) \left(\frac{p_{lp}}{s + p_{lp}}\right)^n, \quad n \ge 1

    The gains are ``kappa_x``, ``kappa_y`` [m/m], ``kd_x``, ``kd_y`` [ms].

    Parameters
    ----------
    lowpass_hz, order, tune_corner
        As in `PStructure`; the order is at least 1.
    lower, upper : float
        Bounds of the proportional gains [m/m].
    kd_limit_ms : float
        Bound on the magnitude of the derivative gains [ms].
    """

    lower: float = -3.0
    upper: float = 3.0
    kd_limit_ms: float = 3.0
    name: str = "PD"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_bounds(lower=self.lower, upper=self.upper, kd_limit_ms=self.kd_limit_ms)
        if self.order == 0:
            raise UsageError("controller 'PD': order = 0; without a low-pass it is not proper, give at least 1")

    def _axis_gains(self) -> tuple[tuple[str, float, float, float, str], ...]:
        start = min(max(0.0, self.lower), self.upper)
        return (
            ("kappa", start, self.lower, self.upper, "m/m"),
            ("kd", 0.0, -self.kd_limit_ms, self.kd_limit_ms, "ms"),
        )

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        A, B, C, _ = lowpass
        seconds = 1e-3 * gain["kd"]  # D = 0: the derivative of the last stage is C (A x + B p)
        return A, B, gain["kappa"] * C + seconds * (C @ A), seconds * (C @ B)


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
    lowpass_hz, order, tune_corner
        As in `PStructure`; by default there is no low-pass.
    gain_limit : float
        Bound on the magnitude of b0, b1 and b2 [m/m].
    frequency_khz, damping : (lowest, highest)
        Bounds of the frequency [kHz] and damping factor of the filter.
    """

    order: int = 0
    gain_limit: float = 5.0
    frequency_khz: tuple[float, float] = (0.02, 1.5)
    damping: tuple[float, float] = (0.05, 3.0)
    name: str = "biquad"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.gain_limit < inf:
            raise UsageError(f"controller 'biquad': gain_limit = {self.gain_limit}; give a positive number")
        for name in ("frequency_khz", "damping"):
            low, high = (float(bound) for bound in getattr(self, name))
            if not 0 < low < high < inf:
                raise UsageError(
                    f"controller 'biquad': {name} = ({low:g}, {high:g}); give two positive numbers, lower first"
                )
            object.__setattr__(self, name, (low, high))

    def _axis_gains(self) -> tuple[tuple[str, float, float, float, str], ...]:
        limit = self.gain_limit
        frequency, damping = (
            min(max(middle, low), high) for middle, (low, high) in ((0.15, self.frequency_khz), (0.7, self.damping))
        )
        return (
            *((f"b{i}", 0.0, -limit, limit, "m/m") for i in range(3)),
            ("frequency", frequency, *self.frequency_khz, "kHz"),
            ("damping", damping, *self.damping, ""),
        )

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        w, z = 2e3 * np.pi * gain["frequency"], gain["damping"]
        # states w^2/den and w s/den; s^2/den = 1 - 2 z (second) - (first)
        A = ca.blockcat([[ca.SX(1, 1), ca.SX(w)], [ca.SX(-w), ca.SX(-2 * z * w)]])
        B = ca.vertcat(0, w)
        C = ca.horzcat(gain["b0"] - gain["b2"], gain["b1"] - 2 * z * gain["b2"])
        A_lp, B_lp, C_lp, D_lp = lowpass
        n = A_lp.shape[0]
        series = ca.blockcat([[A_lp, ca.SX(n, 2)], [B @ C_lp, A]])
        return series, ca.vertcat(B_lp, B @ D_lp), ca.horzcat(gain["b2"] * C_lp, C), gain["b2"] * D_lp
