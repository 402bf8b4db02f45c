"""Domain: the range of pressure and speed in which a model was identified."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.errors import ExtrapolationWarning, UsageError


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
