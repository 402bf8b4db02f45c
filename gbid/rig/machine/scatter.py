"""Scatter of the true parameters from recording to recording (paper, Secs. 3.7 and 4)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.poles import frequencies_and_dampings
from gbid.rig.machine.machine import RotorBearingTruth

_TRIES = 200


@dataclass(frozen=True)
class Scatter:
    r"""Random differences of rotor and bearing between recordings at one operating point.

    The paper gives the scatter of its estimates for delays, natural frequencies, damping factors and static gains.
    These quantities are drawn from independent normal distributions. The fourteen key parameters follow from them: the
    eigenvectors of the rotor are kept and its eigenvalues are moved,
    :math:`[K\ D] = \Psi \Lambda^2 [\Psi; \Psi\Lambda]^{-1}`, and :math:`B = -K G_{dc}`.

    A draw is rejected and repeated when a mode has less damping than `minimum_damping` (or than half of its true
    damping, if that is less), or when a delay is below `minimum_delay` (same rule). So no draw is unstable. At points
    with little damping this puts the mean slightly above the truth.

    Parameters
    ----------
    share : float
        Factor on all standard deviations. The figures of the paper are deviations of estimates from a polynomial and
        contain its lack of fit, so the default is one half.
    delay : (2,) tuple
        Standard deviations of tau_x, tau_y [s]; 0.088 and 0.041 ms, Sec. 4.
    frequency_hz : (2,) tuple
        Standard deviations of omega_1, omega_2 [Hz]; 1.13 and 0.58, Sec. 4.
    damping : (2,) tuple
        Standard deviations of zeta_1, zeta_2; 0.0104 and 0.0063, Sec. 4.
    static_gain : (4,) tuple
        Standard deviations of g_xx, g_xy, g_yx, g_yy [m/m]; Sec. 4.
    minimum_damping : float
        Smallest damping factor of a draw.
    minimum_delay : float
        Smallest delay of a draw [s].
    """

    share: float = 0.5
    delay: tuple[float, float] = (0.088e-3, 0.041e-3)
    frequency_hz: tuple[float, float] = (1.13, 0.58)
    damping: tuple[float, float] = (0.0104, 0.0063)
    static_gain: tuple[float, float, float, float] = (0.0031, 0.0022, 0.0027, 0.0031)
    minimum_damping: float = 0.01
    minimum_delay: float = 20e-6

    def __post_init__(self) -> None:
        for name, n in (("delay", 2), ("frequency_hz", 2), ("damping", 2), ("static_gain", 4)):
            value = tuple(float(v) for v in getattr(self, name))
            if len(value) != n or not np.isfinite(value).all() or min(value) < 0:
                raise UsageError(f"scatter: {name} = {value}; give {n} finite numbers of at least zero")
            object.__setattr__(self, name, value)
        for name in ("share", "minimum_damping", "minimum_delay"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise UsageError(f"scatter: {name} = {value}; give a finite number of at least zero")


def scatter_random(seed: int, name: str, conditions: Mapping[str, float]) -> np.random.Generator:
    """Return the random generator of a recording, which depends on seed, name and operating point.

    Parameters
    ----------
    seed : int
        Seed of the recording.
    name : str
        Name of the recording.
    conditions : dict of str to float
        Operating point of the recording.
    """
    point = ",".join(f"{key}={float(conditions[key])!r}" for key in sorted(conditions))
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=tuple(f"scatter {name} {point}".encode())))


def scattered(truth: RotorBearingTruth, scatter: Scatter, random: np.random.Generator) -> tuple[RotorBearingTruth, int]:
    """Return the random rotor and bearing of one recording.

    Parameters
    ----------
    truth : RotorBearingTruth
        The machine without scatter.
    scatter : Scatter
        Standard deviations and limits.
    random : numpy.random.Generator
        Source of random numbers; see `scatter_random`.

    Returns
    -------
    RotorBearingTruth
        Stable rotor and bearing.
    int
        Number of rejected draws.

    Raises
    ------
    UsageError
        When a mode does not oscillate, or when all draws are rejected.
    """
    frequency, damping, shapes = _modes(truth)
    gain = -np.linalg.solve(truth.stiffness, truth.input_gain)
    floor = np.minimum(scatter.minimum_damping, 0.5 * damping)
    floor_delay = np.minimum(scatter.minimum_delay, 0.5 * truth.delay)
    for thrown in range(_TRIES):
        z = scatter.share * random.standard_normal(10)
        new_frequency = frequency + z[:2] * scatter.frequency_hz
        new_damping = damping + z[2:4] * scatter.damping
        delay = truth.delay + z[4:6] * scatter.delay
        if (new_damping < floor).any() or (new_damping >= 1).any() or (new_frequency <= 0).any():
            continue
        if (delay < floor_delay).any():
            continue
        omega = 2 * np.pi * new_frequency
        half = omega * (-new_damping + 1j * np.sqrt(1 - new_damping**2))
        values = np.concatenate([half, half.conj()])
        KD = (shapes * values**2) @ np.linalg.inv(np.vstack([shapes, shapes * values]))
        K, D = KD.real[:, :2], KD.real[:, 2:]
        G = gain + np.reshape(z[6:] * scatter.static_gain, (2, 2))
        return replace(truth, stiffness=K, damping=D, input_gain=-K @ G, delay=delay), thrown
    raise UsageError(f"scatter: no acceptable draw in {_TRIES}; lower share = {scatter.share}")


def _modes(truth: RotorBearingTruth) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Return natural frequencies [Hz], damping factors and mode shapes (2, 4) of both modes, lower frequency first."""
    values, vectors = np.linalg.eig(np.block([[np.zeros((2, 2)), np.eye(2)], [truth.stiffness, truth.damping]]))
    upper = np.flatnonzero(values.imag > 0)
    if len(upper) != 2:
        raise UsageError("scatter: the rotor has a mode that does not oscillate; it cannot be scattered by frequency")
    upper = upper[np.argsort(np.abs(values[upper]))]
    half, shapes = values[upper], vectors[:2, upper]
    return *frequencies_and_dampings(half).T, np.hstack([shapes, shapes.conj()])
