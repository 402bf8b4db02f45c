"""Low-pass filter in series with each axis of a controller (paper, Eq. 21)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from gbid.core.arrays import is_finite, is_whole
from gbid.core.errors import UsageError
from gbid.discretise import Hold
from gbid.structure import Parameter
from gbid.structure.parameter import Values


@dataclass(frozen=True)
class Lowpass:
    """Low-pass filter ``(p_lp / (s + p_lp))^n`` as a chain of first-order lags.

    Parameters
    ----------
    corner_hz : float or casadi.SX
        Corner frequency ``p_lp / 2 pi`` [Hz].
    order : int
        Order n; 0 for none.
    """

    corner_hz: Any = 1000.0
    order: int = 1

    def check(self, where: str) -> None:
        """Refuse a corner frequency that is not positive, and an order that is not a whole number of at least 0.

        Raises
        ------
        UsageError
            When one of them is wrong.
        """
        if not (is_finite(self.corner_hz) and self.corner_hz > 0):
            raise UsageError(f"{where}: lowpass_hz = {self.corner_hz!r}; give a positive number of Hz")
        if not is_whole(self.order, 0):
            raise UsageError(f"{where}: order = {self.order}; it must be a whole number, at least 0")

    def matrices(self) -> tuple[Any, Any, Any, Any]:
        """Return A (n, n), B (n, 1), C (1, n), D (1, 1) as casadi.SX."""
        n, corner = self.order, 2 * np.pi * self.corner_hz
        chain = ca.sparsify(
            ca.SX(ca.DM(np.eye(n, k=-1) - np.eye(n)))
        )  # the output of each stage is the input of the next
        first, last = ca.SX(n, 1), ca.SX(1, n)
        if n:
            first[0], last[n - 1] = corner, 1.0
        return corner * chain, first, last, ca.SX(1, 1) if n else ca.SX(1)


# ---- Controllers with a filter and a low-pass per axis, from disc position p to reference r.

AXES = ("x", "y")
INPUTS = ("p_x", "p_y")
OUTPUTS = ("r_x", "r_y")
NOT_OPTIONS = ("name", "inputs", "outputs", "intersample", "speed_rpm")
"""Fields of a structure that are no options of the user."""


class AxisGain(NamedTuple):
    """A gain that each axis has: name, start, bounds and unit."""

    name: str
    start: float
    lower: float
    upper: float
    unit: str


def gain_name(name: str, axis: str) -> str:
    """Return the name of a gain of an axis; an axis without name adds nothing."""
    return f"{name}_{axis}" if axis else name


def inside(value: float, bounds: tuple[float, float]) -> float:
    """Return the value within bounds that is nearest to a value."""
    return min(max(value, bounds[0]), bounds[1])


def pole_gains(frequency_khz: tuple[float, float], damping: tuple[float, float]) -> tuple[AxisGain, AxisGain]:
    """Return the gains of a pair of poles: its frequency [kHz] and its damping factor, within their bounds."""
    return (
        AxisGain("frequency", inside(0.15, frequency_khz), *frequency_khz, "kHz"),
        AxisGain("damping", inside(0.7, damping), *damping, ""),
    )


@dataclass(frozen=True)
class PerAxis(ABC):
    """Base class of the built-in structures: one filter per axis in series with a low-pass.

    A structure gives the gains of an axis (`_axis_gains`) and the filter that they make (`_filter`); the rest is here.

    Parameters
    ----------
    lowpass_hz : float
        Corner frequency of the low-pass ``(p_lp / (s + p_lp))^n`` of each axis [Hz].
    order : int
        Order n of the low-pass; 0 for none.
    tune_corner : bool
        Whether the corner frequency is a gain as well, ``lowpass_khz`` [kHz], common to all axes.
    axes : tuple of str
        Names of the axes, which end the names of gains, inputs and outputs. ``("",)`` is a controller of one input and
        one output, whose gains have plain names.
    """

    lowpass_hz: float = 1000.0
    order: int = 1
    tune_corner: bool = False
    name: str = ""
    inputs: tuple[str, ...] = INPUTS
    outputs: tuple[str, ...] = OUTPUTS
    intersample: Hold = "foh"
    axes: tuple[str, ...] = AXES

    def __post_init__(self) -> None:
        axes = tuple(self.axes) if isinstance(self.axes, Iterable) else ()
        if not axes or not all(isinstance(axis, str) for axis in axes) or len(set(axes)) < len(axes):
            raise UsageError(f"controller {self.name!r}: axes = {self.axes!r}; give each axis a name of its own")
        object.__setattr__(self, "axes", axes)
        if self.axes != AXES:
            object.__setattr__(self, "inputs", tuple(gain_name("p", axis) for axis in self.axes))
            object.__setattr__(self, "outputs", tuple(gain_name("r", axis) for axis in self.axes))
        Lowpass(self.lowpass_hz, self.order).check(f"controller {self.name!r}")
        if self.tune_corner and self.order == 0:
            raise UsageError(f"controller {self.name!r}: tune_corner needs a low-pass; give an order of at least 1")
        if self.tune_corner and not 0.05 <= self.lowpass_hz / 1e3 <= 2.5:
            raise UsageError(
                f"controller {self.name!r}: lowpass_hz = {self.lowpass_hz:g}; to be tuned it must start in 50 to 2500"
            )

    @abstractmethod
    def _axis_gains(self) -> tuple[AxisGain, ...]:
        """Return the gains of an axis."""

    @abstractmethod
    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        """Return A, B, C, D of one axis for its gains and its low-pass."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Gains of all axes, by kind; the corner frequency is last when it is tuned."""
        gains = [
            Parameter(gain_name(gain.name, axis), gain.start, gain.lower, gain.upper, unit=gain.unit)
            for gain in self._axis_gains()
            for axis in self.axes
        ]
        if self.tune_corner:
            gains.append(Parameter("lowpass_khz", self.lowpass_hz / 1e3, 0.05, 2.5, unit="kHz"))
        return tuple(gains)

    def matrices(self, p: Values) -> dict[str, Any]:
        """Return A, B, C and D for gains by name."""
        corner = p["lowpass_khz"] * 1e3 if self.tune_corner else self.lowpass_hz
        lowpass = Lowpass(corner, self.order).matrices()
        names = [gain.name for gain in self._axis_gains()]
        axes = [self._filter({name: p[gain_name(name, axis)] for name in names}, lowpass) for axis in self.axes]
        return {letter: ca.diagcat(*(axis[i] for axis in axes)) for i, letter in enumerate("ABCD")}

    def _check_bounds(self, lower: float, upper: float) -> None:
        for name, value in (("lower", lower), ("upper", upper)):
            if not is_finite(value):
                raise UsageError(f"controller {self.name!r}: {name} = {value!r}; give a finite number")
        if not lower < upper:
            raise UsageError(f"controller {self.name!r}: lower = {lower} must be below upper = {upper}")

    def _check_positive(self, **values: float) -> None:
        for name, value in values.items():
            if not (is_finite(value) and value > 0):
                raise UsageError(f"controller {self.name!r}: {name} = {value!r}; give a positive number")

    def _check_ranges(self, *names: str, positive: bool = True) -> None:
        """Refuse ranges that are empty, or not positive; store them as pairs of numbers."""
        for name in names:
            given = getattr(self, name)
            pair = tuple(given) if isinstance(given, Sequence | np.ndarray) else ()
            if len(pair) != 2 or not all(map(is_finite, pair)) or not pair[0] < pair[1] or (positive and pair[0] <= 0):
                kind = "positive " if positive else ""
                raise UsageError(f"controller {self.name!r}: {name} = {given!r}; give two {kind}numbers, lower first")
            object.__setattr__(self, name, (float(pair[0]), float(pair[1])))


# ---- Full controllers with cross-coupling: every output from the filters of all inputs.


@dataclass(frozen=True)
class Crossed(PerAxis):
    """Base class of the full structures: the filter of each input drives the references of all axes.

    `_axis_gains` are those of an input, once for each axis: ``frequency_x``. `_crossed_gains` are those from an input
    to an output, output first: ``kappa_xy`` goes from p_y to r_x.
    """

    @abstractmethod
    def _crossed_gains(self) -> tuple[AxisGain, ...]:
        """Return the gains from an input to an output."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Gains from inputs to outputs, then those of the inputs; the corner frequency is last when it is tuned."""
        pairs = [f"{to}{of}" for to in self.axes for of in self.axes]
        crossed = [
            Parameter(f"{gain.name}_{pair}", gain.start, gain.lower, gain.upper, unit=gain.unit)
            for gain in self._crossed_gains()
            for pair in pairs
        ]
        return (*crossed, *super().parameters)

    def matrices(self, p: Values) -> dict[str, Any]:
        """Return A, B, C and D for gains by name."""
        corner = p["lowpass_khz"] * 1e3 if self.tune_corner else self.lowpass_hz
        lowpass = Lowpass(corner, self.order).matrices()
        columns = []
        for of in self.axes:
            own = {gain.name: p[gain_name(gain.name, of)] for gain in self._axis_gains()}
            # the filters to all outputs have equal A and B
            rows = [
                self._filter({**own, **{g.name: p[f"{g.name}_{to}{of}"] for g in self._crossed_gains()}}, lowpass)
                for to in self.axes
            ]
            columns.append(
                (rows[0][0], rows[0][1], ca.vertcat(*(r[2] for r in rows)), ca.vertcat(*(r[3] for r in rows)))
            )
        A, B = (ca.diagcat(*(column[i] for column in columns)) for i in (0, 1))
        C, D = (ca.horzcat(*(column[i] for column in columns)) for i in (2, 3))
        return {"A": A, "B": B, "C": C, "D": D}


# ---- Sections of filters as symbolic state-space models, and their series connection.

System = tuple[Any, Any, Any, Any]
"""A, B, C, D as casadi.SX."""


def second_order(b: Sequence[Any], frequency_khz: Any, damping: Any) -> System:
    """Return ``(b2 s^2 + b1 w s + b0 w^2) / (s^2 + 2 damping w s + w^2)``.

    Parameters
    ----------
    b : (b0, b1, b2)
        Gains of the numerator.
    frequency_khz, damping : float or casadi.SX
        ``w / (2 pi 1000)`` [kHz] and damping factor.
    """
    w = 2e3 * np.pi * frequency_khz
    # states w^2/den and w s/den; s^2/den = 1 - 2 damping (second) - (first)
    A = ca.blockcat([[ca.SX(1, 1), ca.SX(w)], [ca.SX(-w), ca.SX(-2 * damping * w)]])
    C = ca.horzcat(ca.SX(b[0] - b[2]), ca.SX(b[1] - 2 * damping * b[2]))
    return A, ca.vertcat(ca.SX(1, 1), ca.SX(w)), C, ca.SX(b[2])


def first_order(low: Any, high: Any, corner_khz: Any) -> System:
    """Return ``(high s + low w) / (s + w)``: the gain `low` at rest and `high` at high frequency.

    Parameters
    ----------
    low, high : float or casadi.SX
        Gains.
    corner_khz : float or casadi.SX
        ``w / (2 pi 1000)`` [kHz].
    """
    w = 2e3 * np.pi * corner_khz
    return ca.SX(-w), ca.SX(w), ca.SX(low - high), ca.SX(high)


def in_series(first: Sequence[Any], second: Sequence[Any]) -> System:
    """Return the system whose input passes `first`, then `second`."""
    A, B, C, D = first
    a, b, c, d = second
    n, m = A.shape[0], a.shape[0]
    return ca.blockcat([[A, ca.SX(n, m)], [b @ C, a]]), ca.vertcat(B, b @ D), ca.horzcat(d @ C, c), d @ D


def in_parallel(first: Sequence[Any], second: Sequence[Any]) -> System:
    """Return the sum of two systems with one input."""
    A, B, C, D = first
    a, b, c, d = second
    return ca.diagcat(A, a), ca.vertcat(B, b), ca.horzcat(C, c), D + d
