"""Scatter of the true parameters from recording to recording (paper, Secs. 3.7 and 4)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.rig.machine.machine import RotorBearingTruth

_TRIES = 200


@dataclass(frozen=True)
class Scatter:
    r"""How much rotor and bearing differ between recordings at one operating point.

    The paper gives the scatter of its estimates as delays, natural frequencies, damping factors and static
    gains, so these are drawn, independent and normal, and the fourteen key parameters follow: with the
    eigenvectors of the rotor kept and its eigenvalues moved, :math:`[K\ D] = \Psi \Lambda^2 [\Psi; \Psi\Lambda]^{-1}`,
    and :math:`B = -K G_{dc}`.

    A draw that leaves a mode with less than `minimum_damping` (or half of what it had, if that is less) or a
    delay below `minimum_delay` (likewise) is thrown away and drawn again, so no draw is unstable; at points with
    little damping the mean then lies a little above the truth.

    Parameters
    ----------
    share : float
        Factor on all standard deviations. The paper's figures are those of estimates around a polynomial and
        hold lack of fit, so half of them is the default.
    delay : (2,) tuple
        Standard deviation of tau_x, tau_y [s]; 0.088 and 0.041 ms, Sec. 4.
    frequency_hz : (2,) tuple
        Of omega_1, omega_2 [Hz]; 1.13 and 0.58, Sec. 4.
    damping : (2,) tuple
        Of zeta_1, zeta_2; 0.0104 and 0.0063, Sec. 4.
    static_gain : (4,) tuple
        Of g_xx, g_xy, g_yx, g_yy [m/m]; Sec. 4.
    minimum_damping : float
    minimum_delay : float
        [s].
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
    """Source of a recording's draw: by seed, name and operating point.

    Parameters
    ----------
    seed : int
    name : str
        Of the recording.
    conditions : dict of str to float
        Its operating point.
    """
    point = ",".join(f"{key}={float(conditions[key])!r}" for key in sorted(conditions))
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=tuple(f"scatter {name} {point}".encode())))


def scattered(truth: RotorBearingTruth, scatter: Scatter, random: np.random.Generator) -> tuple[RotorBearingTruth, int]:
    """Draw rotor and bearing of one recording.

    Parameters
    ----------
    truth : RotorBearingTruth
        The machine without scatter.
    scatter : Scatter
        What is drawn, and how far.
    random : numpy.random.Generator
        Source of the draw; see `scatter_random`.

    Returns
    -------
    RotorBearingTruth
        Stable.
    int
        How many draws were thrown away.

    Raises
    ------
    UsageError
        When a mode does not oscillate, or no acceptable draw comes up.
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
    """Frequencies [Hz], damping factors and shapes (2, 4) of the two modes, lower first."""
    values, vectors = np.linalg.eig(np.block([[np.zeros((2, 2)), np.eye(2)], [truth.stiffness, truth.damping]]))
    upper = np.flatnonzero(values.imag > 0)
    if len(upper) != 2:
        raise UsageError("scatter: the rotor has a mode that does not oscillate; it cannot be scattered by frequency")
    upper = upper[np.argsort(np.abs(values[upper]))]
    half, shapes = values[upper], vectors[:2, upper]
    return np.abs(half) / (2 * np.pi), -half.real / np.abs(half), np.hstack([shapes, shapes.conj()])
