"""Experiments of the virtual rig: what the piezo references do (paper, Secs. 3.4 and 3.5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError


def whole_samples(what: str, seconds: float, sample_time: float) -> int:
    """Count the samples in a time that must be a whole number of them, at least one.

    Raises
    ------
    UsageError
        When it is not.
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
    """Piezos kept still, to map run-out and unbalance over the shaft angle (Sec. 3.5).

    Parameters
    ----------
    duration_s : float
        Length of the recording [s].
    """

    duration_s: float = 5.0

    def reference(
        self, n_samples: int, sample_time: float, random: np.random.Generator, n_settle: int = 0
    ) -> FloatArray:
        """Give the references r, all zero, shape (n_samples, 2) [m]."""
        del sample_time, random, n_settle
        return np.zeros((n_samples, 2))


@dataclass(frozen=True)
class Prbs:
    """Pseudo-random binary references, mutually independent in x and y (Sec. 3.4).

    At fixed instants each reference takes one of two levels, both equally likely, whatever it was before and
    whatever the other one does.

    Parameters
    ----------
    duration_s : float
        Length of the recording [s].
    amplitude : float
        The levels are +- this [m]. The paper steps from -1 V to 1 V; 10 V are 45 um.
    hold_s : float
        Time between the instants [s], a whole number of samples. The paper does not give it. On the published
        model at 1 V, steps every 5 ms feed the resonances near 125 Hz until the disc uses up the clearance of
        25 um (it moves 26 um at 5 bar, 29 um at 7 bar, 6000 rpm); steps every 20 ms move it by 11 to 16 um at
        the 15 operating points, 11 to 19 um with the default unbalance.

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
        """Draw the references r, shape (n_samples, 2) [m].

        Parameters
        ----------
        n_samples : int
            Number of samples.
        sample_time : float
            Time between them [s].
        random : numpy.random.Generator
            Seeded source of the levels.
        n_settle : int
            How many of the samples come before the logger starts; the sequence runs through.

        Raises
        ------
        UsageError
            When `hold_s` is not a whole number of samples.
        """
        del n_settle
        hold = whole_samples("prbs: hold_s", self.hold_s, sample_time)
        levels = random.integers(0, 2, size=(-(-n_samples // hold), 2))
        return np.asarray(np.repeat((2.0 * levels - 1.0) * self.amplitude, hold, axis=0)[:n_samples])
