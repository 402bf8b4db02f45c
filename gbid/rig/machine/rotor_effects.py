"""Effects of a real rotor beyond Eq. 5: flexible shaft, stiffening film, whirl, noise and contact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError


def need_finite(owner: str, part: object, positive: tuple[str, ...] = (), not_negative: tuple[str, ...] = ()) -> None:
    """Check that fields of a value are finite and have the right sign.

    Raises
    ------
    UsageError
        When a field is not finite, or is negative, or is zero although it must be positive.
    """
    for name in (*positive, *not_negative):
        value = getattr(part, name)
        if not np.isfinite(value) or value < 0 or (value == 0 and name in positive):
            words = "positive" if name in positive else "at least zero"
            raise UsageError(f"{owner}: {name} = {value}; give a finite number, {words}")


@dataclass(frozen=True)
class FlexibleMode:
    r"""Bending mode of the shaft that the model of Eq. 5 does not have, equal in x and y.

    .. math:: \ddot \eta + 2 \zeta \omega \dot\eta + \omega^2 \eta = m\, a, \qquad p = q + \eta

    Here a is the sum of all forces per moving mass (film, unbalance, impacts). Below omega the mode only adds
    compliance.

    Parameters
    ----------
    frequency_hz : float
        Natural frequency [Hz].
    damping : float
        Damping ratio zeta.
    share : float
        Modal participation m: acceleration of the disc by this mode over that by the mode of the model.
    """

    frequency_hz: float = 480.0
    damping: float = 0.01
    share: float = 0.3

    def __post_init__(self) -> None:
        need_finite("flexible mode", self, ("frequency_hz", "damping"), ("share",))


@dataclass(frozen=True)
class FilmStiffening:
    """Gas film whose stiffness grows with the distance from the centre: ``K (1 + |q|^2/l^2)`` in place of ``K``.

    It is given by the deviation that a staircase shows (Sec. 3.1). Where a linear film would let the disc rest at
    `at`, the disc rests short of it by `deviation`. The best straight line through a staircase has smaller errors.
    The static error in the paper is below 0.95 um.

    Parameters
    ----------
    deviation, at : float
        Deviation from the linear position, and the linear position itself [m].

    Raises
    ------
    UsageError
        When the deviation is not below `at`.
    """

    deviation: float = 0.9e-6
    at: float = 8e-6

    def __post_init__(self) -> None:
        need_finite("stiffening", self, ("at",), ("deviation",))
        if self.deviation >= self.at:
            raise UsageError(f"stiffening: deviation = {self.deviation} m; it must lie below at = {self.at} m")

    @property
    def inverse_square_length(self) -> float:
        """1/l^2 [1/m^2], the coefficient of the stiffening."""
        rest = self.at - self.deviation
        return self.deviation / rest**3


@dataclass(frozen=True)
class NonSynchronous:
    r"""Non-synchronous whirl: small slow deviations of the orbit near 4000 rpm (Sec. 4).

    A force per mass -K w(t) acts on the rotor. It would move the disc quasi-statically by

    .. math:: w = s(n)\, \mathrm{Re}/\mathrm{Im}\left(z(t) e^{i \rho \phi}\right), \quad
              s(n) = \text{size} \cdot e^{-(n - n_0)^2 / (2 \Delta n^2)}

    Here z is a complex first-order random process of unit variance and the given bandwidth.

    Parameters
    ----------
    size : float
        Largest rms value of ``|w|`` over the speed [m].
    peak_rpm, width_rpm : float
        n_0 and Delta n, centre and width of the speed range [rpm].
    ratio : float
        rho, whirl frequency over shaft frequency.
    bandwidth_hz : float
        Corner frequency of z [Hz].
    """

    size: float = 0.3e-6
    peak_rpm: float = 4000.0
    width_rpm: float = 500.0
    ratio: float = 0.95
    bandwidth_hz: float = 1.0

    def __post_init__(self) -> None:
        need_finite("non-synchronous", self, ("width_rpm", "bandwidth_hz"), ("size", "peak_rpm", "ratio"))

    def size_at(self, speed: FloatArray) -> FloatArray:
        """Return s at given speeds [rad/s], shape of `speed` [m]."""
        rpm = np.abs(speed) * (30.0 / np.pi)
        return np.asarray(self.size * np.exp(-0.5 * ((rpm - self.peak_rpm) / self.width_rpm) ** 2))


@dataclass(frozen=True)
class ProcessNoise:
    """Broadband force noise on the rotor, white up to about the sampling frequency, independent in x and y.

    Parameters
    ----------
    density : float
        Square root of the one-sided power density of the acceleration [m/s^2 per sqrt(Hz)].
    """

    density: float = 0.01

    def __post_init__(self) -> None:
        need_finite("process noise", self, (), ("density",))


@dataclass(frozen=True)
class Contact:
    """Contact of disc and bearing beyond the clearance: a stiff wall without friction.

    Parameters
    ----------
    stiffness : float
        Contact force per depth [N/m].
    damping : float
        Contact force per speed into the wall [N s/m]. The wall never pulls.
    """

    stiffness: float = 1e8
    damping: float = 5e3

    def __post_init__(self) -> None:
        need_finite("contact", self, ("stiffness",), ("damping",))
