"""Runs of the rig: stationary, PRBS, given signal, hammer, run-up, changing pressure and speed, staircases."""

from __future__ import annotations

import hashlib
from dataclasses import InitVar, dataclass, field
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from annotated_types import Ge, Le

from gbid.core.arrays import FloatArray
from gbid.core.errors import UsageError
from gbid.core.option_types import Count, Exact, Finite, NotNegative, Positive, check_options


@dataclass(frozen=True)
class Impact:
    """One impact on the rotor: a half sine of force, without delay.

    Parameters
    ----------
    time : float
        Start of the impact, from the first sample [s].
    peak : float
        Largest force [N].
    duration : float
        Length of the half sine [s].
    direction : float
        Angle between the force and the x axis [rad]; pi/2 is along y.
    """

    time: NotNegative = 0.1
    peak: Positive = 8.0
    duration: Positive = 2e-3
    direction: Finite = 0.0

    def __post_init__(self) -> None:
        check_options(self, "impact")

    @classmethod
    def along(cls, axis: str, time: float = 0.1, peak: float = 8.0, duration: float = 2e-3) -> Impact:
        """Return an impact along the axis ``"x"`` or ``"y"``.

        Parameters
        ----------
        axis : {"x", "y"}
            Direction of the force.
        time, peak, duration : float
            Start [s], largest force [N] and length [s] of the impact.

        Raises
        ------
        UsageError
            When `axis` is neither ``"x"`` nor ``"y"``.
        """
        if axis not in ("x", "y"):
            raise UsageError(f"impact: axis = {axis!r}; choose 'x' or 'y'")
        return cls(time, peak, duration, 0.0 if axis == "x" else np.pi / 2)

    def force(self, time: FloatArray) -> FloatArray:
        """Return the force of the impact along x and y, shape (n, 2) [N].

        Parameters
        ----------
        time : (n,) array
            Times from the first sample [s].
        """
        since = time - self.time
        inside = (since > 0) & (since < self.duration)
        size = np.where(inside, self.peak * np.sin(np.pi * since / self.duration), 0.0)
        along = np.array([np.cos(self.direction), np.sin(self.direction)])
        along[np.abs(along) < 1e-15] = 0.0
        return np.outer(size, along)


class AtRest:
    """Base of runs in which the references of the pairs are zero."""

    def reference(
        self, n_samples: int, sample_time: float, random: np.random.Generator, n_settle: int = 0
    ) -> FloatArray:
        """Return the references r, all zero, shape (n_samples, 2) [m]."""
        del sample_time, random, n_settle
        return np.zeros((n_samples, 2))


@dataclass(frozen=True)
class Hammer(AtRest):
    """Hammer test: impacts on the rotor while the references of the piezos are zero.

    Parameters
    ----------
    impacts : tuple of Impact
        The impacts.
    duration_s : float
        Length of the recording [s].

    Raises
    ------
    UsageError
        When there are no impacts, or when an impact starts after the end of the recording.
    """

    impacts: tuple[Impact, ...] = (Impact(),)
    duration_s: Positive = 1.0

    def __post_init__(self) -> None:
        check_options(self, "hammer")
        beyond = [impact.time for impact in self.impacts if impact.time >= self.duration_s]
        if beyond or not self.impacts:
            what = f"an impact at {beyond[0]} s" if beyond else "no impacts"
            raise UsageError(f"hammer: {what}; give some that begin before duration_s = {self.duration_s} s")

    def force(self, time: FloatArray) -> FloatArray:
        """Return the force of all impacts along x and y, shape (n, 2) [N].

        Parameters
        ----------
        time : (n,) array
            Times from the first sample [s].
        """
        return np.asarray(sum((impact.force(time) for impact in self.impacts), np.zeros((len(time), 2))))


def whole_samples(what: str, seconds: float, sample_time: float) -> int:
    """Return a time as a number of samples; refuse less than one sample and fractions of a sample.

    Raises
    ------
    UsageError
        When the time is not a whole number of samples.
    """
    count = round(seconds / sample_time) if np.isfinite(seconds) else 0
    if count < 1 or abs(count * sample_time - seconds) > 1e-6 * sample_time:
        raise UsageError(
            f"{what} = {seconds} s is not a whole number of samples of {sample_time} s; references "
            "change on the sampling grid"
        )
    return count


@dataclass(frozen=True)
class Stationary(AtRest):
    """Recording without excitation, for maps of run-out and unbalance over the shaft angle (paper, Sec. 3.5).

    Parameters
    ----------
    duration_s : float
        Length of the recording [s].
    """

    duration_s: float = 5.0


@dataclass(frozen=True)
class Prbs:
    """Pseudo-random binary sequences as references, independent in x and y (paper, Sec. 3.4).

    At fixed instants each reference takes one of two levels. Both levels are equally likely. The choice does not
    depend on earlier levels or on the other axis.

    Parameters
    ----------
    duration_s : float
        Length of the recording [s].
    amplitude_m : float
        The levels are plus and minus this value [m]. The paper steps from -1 V to 1 V; 10 V are 45 um.
    hold_s : float
        Time between the instants [s], a whole number of samples. The paper does not give it. On the published
        model at 1 V, steps every 5 ms excite the resonances near 125 Hz until the disc reaches the clearance of
        25 um (it moves 26 um at 5 bar, 29 um at 7 bar, 6000 rpm). Steps every 20 ms move it by 11 to 16 um at
        the 15 operating points, and by 11 to 19 um with the default unbalance.

    Raises
    ------
    UsageError
        When the amplitude is not positive.
    """

    duration_s: float = 5.0
    amplitude_m: Positive = 4.5e-6
    hold_s: Positive = 20e-3

    def __post_init__(self) -> None:
        check_options(self, "prbs")

    def reference(
        self, n_samples: int, sample_time: float, random: np.random.Generator, n_settle: int = 0
    ) -> FloatArray:
        """Return random references r, shape (n_samples, 2) [m].

        Parameters
        ----------
        n_samples : int
            Number of samples.
        sample_time : float
            Time between samples [s].
        random : numpy.random.Generator
            Seeded source of the levels.
        n_settle : int
            Number of these samples that come before the logger starts. The sequence does not depend on it.

        Raises
        ------
        UsageError
            When `hold_s` is not a whole number of samples.
        """
        del n_settle
        hold = whole_samples("prbs: hold_s", self.hold_s, sample_time)
        levels = random.integers(0, 2, size=(-(-n_samples // hold), 2))
        return np.asarray(np.repeat((2.0 * levels - 1.0) * self.amplitude_m, hold, axis=0)[:n_samples])


@dataclass(frozen=True)
class Played:
    """Given references, played from the first sample of the recording.

    Before it, while the motion settles, the end of the signal is faded in. So a periodic signal is in its steady state
    when the recording begins, and no step excites more than the signal itself.

    Parameters
    ----------
    samples : (n_samples, 2) array
        References r of x and y [m].
    sample_time : float
        Time between samples [s], that of the rig.
    source : str
        Where the signal comes from, for the provenance.

    Attributes
    ----------
    sha256 : str
        Digest of the samples, which stands for them in the provenance.

    Raises
    ------
    UsageError
        When the samples are not finite numbers of two axes.
    """

    samples: InitVar[npt.ArrayLike]
    sample_time: float
    source: str = "given"
    sha256: str = field(init=False)

    def __post_init__(self, samples: npt.ArrayLike) -> None:
        values = np.array(samples, dtype=float)
        if values.ndim != 2 or values.shape[1] != 2 or not len(values) or not np.isfinite(values).all():
            raise UsageError(f"played: samples of shape {values.shape}; give (n_samples, 2) finite numbers, x and y")
        values.setflags(write=False)
        object.__setattr__(self, "_values", values)
        object.__setattr__(self, "sha256", hashlib.sha256(values.tobytes()).hexdigest())

    @property
    def values(self) -> FloatArray:
        """References r, (n_samples, 2) [m]."""
        values: FloatArray = self.__dict__["_values"]
        return values

    @property
    def duration_s(self) -> float:
        """Length of the recording [s]."""
        return len(self.values) * self.sample_time

    def reference(
        self, n_samples: int, sample_time: float, random: np.random.Generator, n_settle: int = 0
    ) -> FloatArray:
        """Return the references r, shape (n_samples, 2) [m].

        Raises
        ------
        UsageError
            When the rig has another sample time.
        """
        del random
        if abs(sample_time - self.sample_time) > 1e-9 * sample_time:
            raise UsageError(
                f"played: the signal has a sample every {self.sample_time:g} s, the rig every {sample_time:g} s; "
                "design it for the sample time of the rig"
            )
        whole_samples("played: duration_s", self.duration_s, sample_time)
        at = np.arange(n_samples) - n_settle
        faded = np.where(at < 0, np.sin(np.pi / 2 * (at + n_settle) / max(n_settle, 1)) ** 2, 1.0)
        return np.asarray(self.values[at % len(self.values)] * faded[:, None])


RPM = np.pi / 30


@dataclass(frozen=True)
class RunUp(AtRest):
    """Run-up: the speed changes at a constant rate, and the references are zero.

    The parameters of rotor and bearing do not follow the speed: they stay those of the machine. In a `ScheduledRun`
    they do.

    Parameters
    ----------
    from_rpm, to_rpm : float
        Speeds at the first sample and at the end [rpm]; the speed may rise or fall.
    duration_s : float
        Length of the recording [s].
    """

    from_rpm: NotNegative = 0.0
    to_rpm: NotNegative = 6000.0
    duration_s: Positive = 5.0

    def __post_init__(self) -> None:
        check_options(self, "run-up")

    def turning(self) -> Turning:
        """Return the shaft angle, speed and acceleration over time."""
        return Turning((0.0, self.duration_s), (self.from_rpm * RPM, self.to_rpm * RPM))


@dataclass(frozen=True)
class Turning:
    """Rotation of the shaft: angle, speed and acceleration over time.

    The speed is linear between given times, the first of which is zero (the first sample), and constant before the
    first and after the last.

    Parameters
    ----------
    times : tuple of float
        Times from the first sample [s], ascending from 0.
    speeds : tuple of float
        Speeds at these times [rad/s].
    start : float
        Angle at the first sample [rad].
    """

    times: tuple[float, ...]
    speeds: tuple[float, ...]
    start: float = 0.0

    @property
    def speed(self) -> float:
        """Speed before the first sample [rad/s]."""
        return self.speeds[0]

    def angle(self, time: FloatArray) -> FloatArray:
        """Return the shaft angle at times from the first sample [rad], not wrapped, shape of `time`."""
        times, speeds = np.array(self.times), np.array(self.speeds)
        turned = np.concatenate([[0.0], np.cumsum(0.5 * (speeds[1:] + speeds[:-1]) * np.diff(times))])
        piece, slope = self._pieces(time)
        since = time - times[piece]
        return np.asarray(self.start + turned[piece] + speeds[piece] * since + 0.5 * slope * since**2)

    def speed_at(self, time: FloatArray) -> FloatArray:
        """Return the speed at times from the first sample [rad/s], shape of `time`."""
        return np.asarray(np.interp(time, self.times, self.speeds))

    def acceleration_at(self, time: FloatArray) -> FloatArray:
        """Return the angular acceleration at times from the first sample [rad/s^2], shape of `time`."""
        return self._pieces(time)[1]

    def _pieces(self, time: FloatArray) -> tuple[np.ndarray, FloatArray]:
        """Return for each time the index of the last breakpoint before it, and the acceleration from there on."""
        piece = np.maximum(np.searchsorted(self.times, time, side="left") - 1, 0)
        slopes = np.append(np.diff(self.speeds) / np.diff(self.times), 0.0)
        return piece, np.where(np.asarray(time) > self.times[0], slopes[piece], 0.0)


_PARTS = 64  # straight pieces of a coast-down


@dataclass(frozen=True)
class Course:
    """Pressure and speed over time: linear between breakpoints, constant before and after.

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
        """Return a linear change of pressure and speed.

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
        """Return an exponential decrease of the speed, as by viscous friction.

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
        """Time from the first to the last breakpoint [s]."""
        return self.times_s[-1]

    def at(self, time: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return pressure [bar] and speed [rpm] at times from the first sample [s], each of the shape of `time`."""
        return np.interp(time, self.times_s, self.pressure_bar), np.interp(time, self.times_s, self.speed_rpm)


@dataclass(frozen=True)
class ScheduledRun:
    """Recording with changing pressure and speed; rotor and bearing follow the surfaces of the machine.

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


def up_and_down(lowest: float, step: float, n_steps: int) -> FloatArray:
    """Return the levels of n steps up and n steps down, shape (2 n + 1,)."""
    up = lowest + step * np.arange(n_steps + 1)
    return np.concatenate([up, up[-2::-1]])


@dataclass(frozen=True)
class Staircase:
    """Staircase of one axis from -n steps to +n steps and back, with the other axis at zero (Sec. 3.1, Fig. 5).

    Parameters
    ----------
    axis : {"x", "y"}
        The axis that moves.
    step_m : float
        Height of a step [m].
    steps : int
        n, the number of steps from the middle to either end.
    hold_s : float
        Time on each level [s], a whole number of samples.
    """

    axis: Literal["x", "y"] = "x"
    step_m: Positive = 2.25e-6
    steps: Count = 6
    hold_s: Positive = 0.5

    def __post_init__(self) -> None:
        check_options(self, "staircase")

    @property
    def levels(self) -> FloatArray:
        """Levels in time order [m], shape (4 n + 1,)."""
        return up_and_down(-self.steps * self.step_m, self.step_m, 2 * self.steps)

    @property
    def duration_s(self) -> float:
        """Length of the recording [s]."""
        return len(self.levels) * self.hold_s

    def reference(
        self, n_samples: int, sample_time: float, random: np.random.Generator, n_settle: int = 0
    ) -> FloatArray:
        """Return the references r, shape (n_samples, 2) [m]; the first level also holds before the recording."""
        del random
        r = np.zeros((n_samples, 2))
        r[:, "xy".index(self.axis)] = held_levels(self.levels, self.hold_s, sample_time, n_samples, n_settle)
        return r


@dataclass(frozen=True)
class StackStaircase(AtRest):
    """Staircase of one stack over its whole range and back, with all other stacks at r_0 (Figs. A.28 and A.29).

    In open loop the voltage of the stack goes from zero to its limit. With the PD controller on, its reference goes
    from zero to its stroke. The machine must have `PiezoStacks`. The recording has the signals v, y_p and r_p.

    Parameters
    ----------
    stack : int
        Number of the stack, 1 to 4.
    controlled : bool
        Whether the PD controller of the stack is on.
    steps : int
        Number of steps from zero to the end. An even number has a level in the middle.
    hold_s : float
        Time on each level [s], a whole number of samples.
    """

    stack: Annotated[int, Exact(), Ge(1), Le(4)] = 4
    controlled: bool = False
    steps: Count = 10
    hold_s: Positive = 1.0

    def __post_init__(self) -> None:
        check_options(self, "stack staircase")

    @property
    def duration_s(self) -> float:
        """Length of the recording [s]."""
        return (2 * self.steps + 1) * self.hold_s

    def command(self, top: float, n_samples: int, sample_time: float, n_settle: int) -> FloatArray:
        """Return the command of the stack, from zero to `top` and back, shape (n_samples,) [V or m].

        Parameters
        ----------
        top : float
            Highest level [V or m].
        n_samples : int
            Number of samples.
        sample_time : float
            Time between samples [s].
        n_settle : int
            Number of samples before the logger starts.
        """
        return held_levels(
            up_and_down(0.0, top / self.steps, self.steps), self.hold_s, sample_time, n_samples, n_settle
        )


def held_levels(levels: FloatArray, hold_s: float, sample_time: float, n_samples: int, n_settle: int) -> FloatArray:
    """Return levels over time, each held for `hold_s`, shape (n_samples,).

    The first level also holds before the logger starts, the last one until the end.

    Raises
    ------
    UsageError
        When `hold_s` is not a whole number of samples.
    """
    hold = whole_samples("staircase: hold_s", hold_s, sample_time)
    held = np.concatenate([np.full(n_settle, levels[0]), np.repeat(levels, hold)])
    return np.concatenate([held, np.full(max(n_samples - len(held), 0), levels[-1])])[:n_samples]
