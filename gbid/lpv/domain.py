"""The range of pressure and speed on which a model was identified, and its guard."""

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
    """A rectangle of operating points.

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
        """Whether all given points lie inside; the borders do.

        Parameters
        ----------
        pressure_bar, speed_rpm : float or array
        """
        return all(
            bool(((low <= np.asarray(v, float)) & (np.asarray(v, float) <= high)).all())
            for v, (low, high) in ((pressure_bar, self.pressure_bar), (speed_rpm, self.speed_rpm))
        )

    def check(
        self, pressure_bar: Any, speed_rpm: Any, owner: str, extrapolate: bool = False, stacklevel: int = 3
    ) -> None:
        """Refuse operating points outside, or warn when they are asked for.

        Parameters
        ----------
        pressure_bar, speed_rpm : float or array
            CasADi symbols pass: nothing is known of their values.
        owner : str
            What is evaluated, for the message.
        extrapolate : bool
            Whether points outside are wanted.
        stacklevel : int
            Calls between the one to blame in a warning and here, as in `warnings.warn`.

        Raises
        ------
        UsageError
            For values that are no finite numbers, and for those outside unless `extrapolate` is set.

        Warns
        -----
        ExtrapolationWarning
            For values outside, when `extrapolate` is set.
        """
        for name, value in (("pressure_bar", pressure_bar), ("speed_rpm", speed_rpm)):
            if isinstance(value, ca.SX | ca.MX):
                continue
            low, high = getattr(self, name)
            values = _numbers(name, value, owner)
            outside = values[(values < low) | (values > high)]
            if outside.size == 0:
                continue
            text = f"{owner}: {name} = {outside[0]:g} lies outside its domain [{low:g}, {high:g}]"
            if not extrapolate:
                raise UsageError(f"{text}; choose a point inside or ask for it with extrapolate=True")
            warnings.warn(f"{text}: extrapolated", ExtrapolationWarning, stacklevel=stacklevel)


def _numbers(name: str, value: Any, owner: str) -> FloatArray:
    """Return finite numbers as a flat array."""
    raw = np.asarray(value)
    if raw.dtype.kind not in "fiu":
        raise UsageError(f"{owner}: {name} = {value!r} is no number")
    values = raw.astype(float).ravel()
    if not np.isfinite(values).all():
        bad = values[~np.isfinite(values)][0]
        raise UsageError(f"{owner}: {name} = {bad:g} is not finite; give a finite number")
    return values
