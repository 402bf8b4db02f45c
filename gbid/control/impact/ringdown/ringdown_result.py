"""Result of a ring-down fit."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated

import numpy as np
from scipy.special import ndtri

from gbid.arrays import FloatArray
from gbid.brief import Brief
from gbid.control.impact.ringdown.basis import Scale
from gbid.control.impact.ringdown.start import eigenvalues_of
from gbid.errors import UsageError
from gbid.hdf5 import Stored
from gbid.poles import oscillatory_modes


class RingDownStatus(StrEnum):
    """Why a fit to ring-downs ended."""

    CONVERGED = "converged"
    NOT_CONVERGED = "not converged"
    NO_OSCILLATIONS = "no two oscillations: at least one pair of poles is real"
    """The response is damped so much that it does not oscillate."""


@dataclass(frozen=True, eq=False)
class RingDown(Brief):
    """Two modes from ring-downs, as `fit_ringdown` returns them.

    Attributes
    ----------
    frequency_hz, damping : (2,) array
        Natural frequencies [Hz] and damping factors, by rising frequency; nan when K and D have real poles.
    frequency_std, damping_std : (2,) array
        Standard deviations [Hz, 1], for residuals that are correlated in time and between x and y.
    covariance : (4, 4) array
        Covariance of frequency 1, damping 1, frequency 2, damping 2.
    stiffness, damping_matrix : (2, 2) array
        K [1/s^2] and D [1/s].
    lag_rates : (n_lags,) array
        Rates of the fitted lags [1/s].
    residual_rms : (2,) array
        Rms residuals of x and y [m].
    n_impacts : int
        Number of impacts.
    recordings : tuple of str
        Names of the recordings.
    harmonics : int
        Number of estimated harmonics of the shaft angle.
    status : RingDownStatus
        Why the fit ended.
    notes : tuple of str
        Remarks for the reader of the result.
    oscillations : (n, 2) array
        Natural frequency [Hz] and damping factor of decays that oscillate and were fitted beside the modes. They stand
        for all further modes of the loop and need not be one of them.
    """

    frequency_hz: Annotated[FloatArray, Stored("Hz", "natural frequencies from the ring-down", "2")]
    damping: Annotated[FloatArray, Stored("1", "damping factors from the ring-down", "2")]
    frequency_std: Annotated[FloatArray, Stored("Hz", "standard deviations of the frequencies", "2")]
    damping_std: Annotated[FloatArray, Stored("1", "standard deviations of the damping factors", "2")]
    covariance: Annotated[FloatArray, Stored("", "covariance of frequency 1, damping 1, frequency 2, damping 2", "4 4")]
    stiffness: Annotated[FloatArray, Stored("1/s^2", "K of the free response", "2 2")]
    damping_matrix: Annotated[FloatArray, Stored("1/s", "D of the free response", "2 2")]
    lag_rates: Annotated[FloatArray, Stored("1/s", "rates of the decays beside the modes", "lags")]
    residual_rms: Annotated[FloatArray, Stored("m", "what the fit leaves of x and y", "2")]
    n_impacts: int
    recordings: tuple[str, ...]
    harmonics: int
    status: RingDownStatus
    notes: tuple[str, ...] = ()
    oscillations: Annotated[FloatArray, Stored("Hz, 1", "decays that oscillate, beside the modes", "n 2")] = field(
        default_factory=lambda: np.zeros((0, 2))
    )

    def modes(self) -> list[tuple[float, float]]:
        """Return natural frequency [Hz] and damping factor of each mode, as `LinearModel.modes` does."""
        return [(float(f), float(z)) for f, z in zip(self.frequency_hz, self.damping, strict=True)]

    @property
    def success(self) -> bool:
        """Whether the status is ``CONVERGED``."""
        return self.status is RingDownStatus.CONVERGED

    @property
    def aperiodic(self) -> bool:
        """Whether the response is so strongly damped that it has no two oscillations; then the fit cannot succeed."""
        return self.status is RingDownStatus.NO_OSCILLATIONS

    def interval(self, level: float = 0.95) -> FloatArray:
        """Return confidence intervals, shape (4, 2): frequency 1, damping 1, frequency 2, damping 2.

        Parameters
        ----------
        level : float
            Confidence level between 0 and 1.
        """
        if not 0 < level < 1:
            raise UsageError(f"level = {level}; give a number between 0 and 1")
        centre = np.column_stack([self.frequency_hz, self.damping]).ravel()
        half = ndtri(0.5 + level / 2) * np.sqrt(np.diag(self.covariance))
        return np.column_stack([centre - half, centre + half])


def two_modes(theta: FloatArray, scale: Scale) -> FloatArray:
    """Return frequency 1, damping 1, frequency 2, damping 2; nan when a pair of poles is real."""
    mechanical = np.hstack([-theta[:4].reshape(2, 2) * scale.rate**2, -theta[4:8].reshape(2, 2) * scale.rate])
    modes = oscillatory_modes(eigenvalues_of(mechanical))
    return modes.ravel() if len(modes) == 2 else np.full(4, np.nan)
