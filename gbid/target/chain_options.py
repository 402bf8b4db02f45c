"""Options of a control chain: limits, ramps, guards and watchdog."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import Literal

from gbid.errors import UsageError

Number = Literal["double", "float"]
STACKS = ((0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0))
"""Factors of r_x and r_y in the references of the stacks 1 to 4 (Eq. 1)."""


@dataclass(frozen=True)
class ChainOptions:
    """Options of a control chain.

    Parameters
    ----------
    limit_m : float
        Limit of the magnitude of r_x and r_y [m].
    offset_m : float
        r_0, position of each stack at rest [m].
    stroke_m : float
        Largest reference of a stack [m].
    zero_m : tuple of float
        p_0, subtracted from the position after the run-out map [m]; zero for the mean of the map.
    median : {1, 3}
        Size of the median. 3 removes single wrong samples and delays the position by a sample.
    spike_limit_m : float or None
        Largest deviation of a sample from the straight line through the two before it [m]. Up to three such samples
        in a row are replaced by this line, without delay. None for no guard.
    disc_limit_m : float
        Distance of the disc from its zero position at which the watchdog ends the control [m].
    beyond_samples, bad_samples, stuck_samples : int
        Samples in a row after which the watchdog acts: beyond the limit, not finite, or without any change.
    stuck_speed_rpm : float
        Speed above which the shaft angle must change as well [rpm].
    ramp_s : float
        Time in which the stacks go from zero to r_0 and back [s].
    fade_s : float
        Time in which the control is faded in and out [s].
    pressure_rate, speed_rate : float
        Fastest change of pressure [bar/s] and speed [rpm/s] that a schedule follows.
    number : {"double", "float"}
        Type of the numbers in the source.

    Raises
    ------
    UsageError
        When a value has no meaning.
    """

    limit_m: float = 22.5e-6
    offset_m: float = 22.5e-6
    stroke_m: float = 45e-6
    zero_m: tuple[float, float] = (0.0, 0.0)
    median: int = 1
    spike_limit_m: float | None = 8e-6
    disc_limit_m: float = 20e-6
    beyond_samples: int = 3
    bad_samples: int = 5
    stuck_samples: int = 50
    stuck_speed_rpm: float = 300.0
    ramp_s: float = 1.0
    fade_s: float = 0.5
    pressure_rate: float = 2.0
    speed_rate: float = 2000.0
    number: Number = "double"

    def __post_init__(self) -> None:
        for name in ("limit_m", "stroke_m", "disc_limit_m", "ramp_s", "fade_s", "pressure_rate", "speed_rate"):
            value = getattr(self, name)
            if not (isfinite(value) and value > 0):
                raise UsageError(f"target: {name} = {value}; give a positive number")
        for name in ("beyond_samples", "bad_samples", "stuck_samples"):
            value = getattr(self, name)
            if not 1 <= value <= 30000:
                raise UsageError(f"target: {name} = {value}; give a whole number from 1 to 30000")
        if self.median not in (1, 3):
            raise UsageError(f"target: median = {self.median}; choose 1 (none) or 3")
        if self.spike_limit_m is not None and not (isfinite(self.spike_limit_m) and self.spike_limit_m > 0):
            raise UsageError(f"target: spike_limit_m = {self.spike_limit_m}; give a positive number, or null for none")
        if self.number not in ("double", "float"):
            raise UsageError(f"target: number = {self.number!r}; choose 'double' or 'float'")
        if not (len(self.zero_m) == 2 and all(isfinite(v) for v in self.zero_m)):
            raise UsageError(f"target: zero_m = {self.zero_m}; give two finite numbers, x and y")
        if not (isfinite(self.stuck_speed_rpm) and self.stuck_speed_rpm >= 0):
            raise UsageError(f"target: stuck_speed_rpm = {self.stuck_speed_rpm}; give a number of at least zero")
        room = min(self.offset_m, self.stroke_m - self.offset_m)
        if not self.limit_m <= room + 1e-12:
            raise UsageError(
                f"target: limit_m = {self.limit_m:g} m around offset_m = {self.offset_m:g} m leaves the stroke of "
                f"{self.stroke_m:g} m; at most {max(room, 0.0):g} m fit"
            )

    def samples(self, seconds: float, sample_time: float) -> int:
        """Return a time as a whole number of samples, at least one.

        Parameters
        ----------
        seconds, sample_time : float
            Time and time between samples [s].
        """
        return max(1, round(seconds / sample_time))
