"""Stationary recording and pseudo-random binary excitation of the piezo references (paper, Secs. 3.4 and 3.5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError


def whole_samples(what: str, seconds: float, sample_time: float) -> int:
    """Return the number of samples in a time, which must be a whole number of at least one.

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
class Stationary:
    """Recording without excitation, used to map run-out and unbalance over the shaft angle (Sec. 3.5).

    Parameters
    ----------
    duration_s : float
        Length of the recording [s].
    """

    duration_s: float = 5.0

    def reference(
        self, n_samples: int, sample_time: float, random: np.random.Generator, n_settle: int = 0
    ) -> FloatArray:
        """Return the references r, all zero, shape (n_samples, 2) [m]."""
        del sample_time, random, n_settle
        return np.zeros((n_samples, 2))


@dataclass(frozen=True)
class Prbs:
    """Pseudo-random binary sequences as references, independent in x and y (Sec. 3.4).

    At fixed instants each reference takes one of two levels. Both levels are equally likely. The choice does not
    depend on earlier levels or on the other axis.

    Parameters
    ----------
    duration_s : float
        Length of the recording [s].
    amplitude : float
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
    amplitude: float = 4.5e-6
    hold_s: float = 20e-3

    def __post_init__(self) -> None:
        if not (np.isfinite(self.amplitude) and self.amplitude > 0):
            raise UsageError(f"prbs: amplitude = {self.amplitude} m; it must be positive")

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
        return np.asarray(np.repeat((2.0 * levels - 1.0) * self.amplitude, hold, axis=0)[:n_samples])
