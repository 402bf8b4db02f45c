"""Recording during which pressure and speed change: run-up, coast-down, pressure ramp, or any other course."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.rig.excitation.prbs import Prbs, Stationary
from gbid.rig.excitation.run_up import RPM, Turning

_PARTS = 64  # straight pieces of a coast-down


@dataclass(frozen=True)
class Course:
    """Course of pressure and speed over time: straight between given times, constant before and after.

    Parameters
    ----------
    times_s : sequence of float
        Times from the first sample [s], ascending from 0; at least two.
    pressure_bar, speed_rpm : sequence of float, or float
        Injection pressure [bar] and speed [rpm] at these times; a number is constant.

    Raises
    ------
    UsageError
        When times do not ascend from 0, numbers of values differ, or a value is negative or not finite.
    """

    times_s: tuple[float, ...]
    pressure_bar: tuple[float, ...] | float
    speed_rpm: tuple[float, ...] | float

    def __post_init__(self) -> None:
        times = tuple(float(t) for t in self.times_s)
        object.__setattr__(self, "times_s", times)
        if len(times) < 2 or times[0] != 0.0 or not (np.diff(times) > 0).all():
            raise UsageError(f"course: times_s = {list(times)}; give at least two times that ascend from 0")
        for name in ("pressure_bar", "speed_rpm"):
            given = getattr(self, name)
            values = tuple(float(v) for v in (given if np.ndim(given) else [given] * len(times)))
            if len(values) != len(times) or not np.isfinite(values).all() or min(values) < 0:
                raise UsageError(
                    f"course: {name} = {given}; give one number, or {len(times)} numbers of at least zero, one for "
                    "each time"
                )
            object.__setattr__(self, name, values)

    @classmethod
    def ramp(
        cls, duration_s: float, pressure_bar: tuple[float, float] | float, speed_rpm: tuple[float, float] | float
    ) -> Course:
        """Return a straight change of pressure and speed.

        Parameters
        ----------
        duration_s : float
            Time of the change [s].
        pressure_bar, speed_rpm : (float, float) or float
            First and last value; one number stays [bar, rpm].
        """
        return cls((0.0, duration_s), pressure_bar, speed_rpm)

    @classmethod
    def coast_down(cls, duration_s: float, pressure_bar: float, from_rpm: float, to_rpm: float) -> Course:
        """Return the fall of the speed against a torque of viscous friction, exponential in time.

        Parameters
        ----------
        duration_s : float
            Time from the first speed to the second [s].
        pressure_bar : float
            Injection pressure [bar].
        from_rpm, to_rpm : float
            Speeds at the first sample and at the end [rpm], above zero.
        """
        if min(from_rpm, to_rpm) <= 0:
            raise UsageError(f"coast-down from {from_rpm:g} to {to_rpm:g} rpm: it ends above zero; give the last speed")
        part = np.linspace(0.0, 1.0, _PARTS + 1)
        speeds = from_rpm * (to_rpm / from_rpm) ** part
        return cls(tuple((duration_s * part).tolist()), pressure_bar, tuple(speeds.tolist()))

    @property
    def duration_s(self) -> float:
        """Time from the first to the last of the given times [s]."""
        return self.times_s[-1]

    def at(self, time: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return pressure [bar] and speed [rpm] at times from the first sample [s], each of the shape of `time`."""
        return np.interp(time, self.times_s, self.pressure_bar), np.interp(time, self.times_s, self.speed_rpm)


@dataclass(frozen=True)
class ScheduledRun:
    """Recording along a course of pressure and speed; rotor and bearing follow the surfaces of the machine.

    Parameters
    ----------
    course : Course
        Pressure and speed over time.
    excitation : Prbs or Stationary
        References during the run. Its `duration_s` is the length of the recording.
    """

    course: Course
    excitation: Prbs | Stationary = field(default_factory=Prbs)

    @property
    def duration_s(self) -> float:
        """Length of the recording [s]."""
        return self.excitation.duration_s

    def reference(
        self, n_samples: int, sample_time: float, random: np.random.Generator, n_settle: int = 0
    ) -> FloatArray:
        """Return the references r of the excitation, shape (n_samples, 2) [m]."""
        return self.excitation.reference(n_samples, sample_time, random, n_settle)

    def turning(self) -> Turning:
        """Return the shaft angle, speed and acceleration over time."""
        return Turning(self.course.times_s, tuple(rpm * RPM for rpm in np.atleast_1d(self.course.speed_rpm).tolist()))
