"""Hammer impacts with a measured force (paper, Sec. 5.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.rig.machine.rotor_effects import need_finite


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

    time: float = 0.1
    peak: float = 8.0
    duration: float = 2e-3
    direction: float = 0.0

    def __post_init__(self) -> None:
        need_finite("impact", self, ("peak", "duration"), ("time",))
        if not np.isfinite(self.direction):
            raise UsageError(f"impact: direction = {self.direction} rad; give a finite angle")

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


@dataclass(frozen=True)
class Hammer:
    """Hammer test: impacts on the rotor, with the excitation of the piezos at zero.

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
    duration_s: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "impacts", tuple(self.impacts))
        need_finite("hammer", self, ("duration_s",))
        late = [impact.time for impact in self.impacts if impact.time >= self.duration_s]
        if late or not self.impacts:
            what = f"an impact at {late[0]} s" if late else "no impacts"
            raise UsageError(f"hammer: {what}; give some that begin before duration_s = {self.duration_s} s")

    def reference(
        self, n_samples: int, sample_time: float, random: np.random.Generator, n_settle: int = 0
    ) -> FloatArray:
        """Return the references r, all zero, shape (n_samples, 2) [m]."""
        del sample_time, random, n_settle
        return np.zeros((n_samples, 2))

    def force(self, time: FloatArray) -> FloatArray:
        """Return the force of all impacts along x and y, shape (n, 2) [N].

        Parameters
        ----------
        time : (n,) array
            Times from the first sample [s].
        """
        return np.asarray(sum((impact.force(time) for impact in self.impacts), np.zeros((len(time), 2))))
