"""Stability margins of a loop: disk margins, classical margins, and static amplification."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan, degrees, inf, nan, pi
from typing import Literal

import numpy as np
import scipy

from gbid.arrays import ComplexArray, FloatArray
from gbid.control.loop.force_entry import static_force_gain
from gbid.control.loop.norm import larger_of_two, largest_singular_values, refine_maxima
from gbid.control.loop.sensitivity import Sensitivities
from gbid.errors import UsageError

Side = Literal["output", "input"]


@dataclass(frozen=True)
class DiskMargin:
    """Balanced disk margin: simultaneous changes of gain and phase that a loop tolerates.

    Attributes
    ----------
    alpha : float
        Size of the disk, 0 for an unstable loop; at most 2 for a strictly proper loop gain.
    gain : (float, float)
        Tolerated factors on the loop gain, ``(2 - alpha)/(2 + alpha)`` and its inverse.
    phase_deg : float
        Tolerated phase of either sign [degrees]: ``2 arctan(alpha / 2)``.
    frequency_hz : float
        Frequency at which the loop is closest to instability [Hz].
    """

    alpha: float
    gain: tuple[float, float]
    phase_deg: float
    frequency_hz: float


@dataclass(frozen=True)
class LoopMargins:
    """Classical margins of one loop while the others stay closed.

    Attributes
    ----------
    gain : (float, float)
        Range of factors on the loop gain around 1 that keep it stable; 0 and infinity when there is no limit.
    phase_deg : float
        Smallest phase of either sign that makes it unstable [degrees]; infinite when there is none.
    delay_s : float
        Smallest additional delay that makes it unstable [s].
    """

    gain: tuple[float, float]
    phase_deg: float
    delay_s: float


def disk_margin(loop: Sensitivities, at: Side = "output") -> DiskMargin:
    r"""Return the disk margin against independent changes of all loops at once.

    Parameters
    ----------
    loop : Sensitivities
        The loop.
    at : {"output", "input"}
        Place of the changes: the positions p or the references r.

    Returns
    -------
    DiskMargin

    Notes
    -----
    Seiler, Packard and Gahinet (2020), balanced (skew 0): the loop tolerates every
    :math:`f_i = (1 + \delta_i / 2)/(1 - \delta_i / 2)`, :math:`|\delta_i| < \alpha`, in each channel,

    .. math:: \alpha = 2 \big/ \max_\omega \mu(S - T), \quad T = I - S.

    For two channels the structured singular value of a diagonal change equals its upper bound :math:`\min_D
    \bar\sigma(D M D^{-1})`, which has a closed form: the determinant does not depend on D, and the sum of squares has
    its minimum :math:`|m_{11}|^2 + |m_{22}|^2 + 2 |m_{12} m_{21}|` when both scaled off-diagonal entries have equal
    magnitude. For more than two channels the largest singular value is used, which is conservative.
    """
    return _disk(loop, lambda f: structured_singular_values(_balanced(loop, f, at)))


def disk_margins_by_loop(loop: Sensitivities, at: Side = "output") -> tuple[DiskMargin, ...]:
    """Return the disk margin of each loop alone, with the others unchanged.

    Parameters
    ----------
    loop : Sensitivities
        The loop.
    at : {"output", "input"}
        Place of the changes: the positions p or the references r.

    Returns
    -------
    tuple of DiskMargin
        One per channel.
    """
    n = _channels(loop, at)
    return tuple(_disk(loop, lambda f, i=i: np.abs(_balanced(loop, f, at)[:, i, i])) for i in range(n))


def loop_margins(loop: Sensitivities, at: Side = "output") -> tuple[LoopMargins, ...]:
    r"""Return the gain, phase and delay margins of each loop, with the others closed.

    Parameters
    ----------
    loop : Sensitivities
        The loop.
    at : {"output", "input"}
        Place where each loop is opened.

    Returns
    -------
    tuple of LoopMargins
        One per channel; for an unstable loop the gains are (1, 1) and the others 0.

    Notes
    -----
    Opened at channel i, the loop gain is :math:`L_i = 1 - 1/S_{ii}`. With the sign of the paper the loop becomes
    unstable where :math:`g\, e^{\mathrm i\varphi} L_i = 1`.
    """
    if not loop.is_stable():
        return (LoopMargins((1.0, 1.0), 0.0, 0.0),) * _channels(loop, at)
    grid = loop.grid(1500)
    S = loop.response(at, grid)
    return tuple(_margins_of(loop, at, i, grid, S[:, i, i]) for i in range(S.shape[-1]))


def static_amplification(loop: Sensitivities) -> float:
    """Return the largest singular value of S_o at zero frequency: the amplification of a static disturbance of p.

    Parameters
    ----------
    loop : Sensitivities
        The loop.
    """
    return float(np.linalg.norm(loop.response("output", 0.0)[0].real, 2))


def static_stiffness_ratio(loop: Sensitivities) -> FloatArray:
    """Return the static stiffness of the closed loop over that of the open loop, axis by axis.

    A static force on the rotor (without delay and actuators) moves the open loop by :math:`p = G_f f` and the closed
    loop by :math:`S_o(0) G_f f`. The ratio is that of the diagonals, open over closed. Below 1 the closed loop is
    softer.

    Parameters
    ----------
    loop : Sensitivities
        Loop with a continuous plant.

    Returns
    -------
    (n_outputs,) array
        Stiffness ratios; infinite with integral action, after which a steady force leaves no deflection.

    Raises
    ------
    UsageError
        When the plant does not show where a force enters (see `gbid.control.force_entry`).
    """
    G_f = static_force_gain(loop.plant)
    opened, closed = np.diag(G_f), np.diag(loop.response("output", 0.0)[0].real @ G_f)
    stiff = np.abs(closed) <= 1e-9 * np.abs(opened)
    return np.asarray(np.where(stiff, np.inf, opened / np.where(stiff, 1.0, closed)))


def slow_poles(loop: Sensitivities, slower_than_hz: float = 20.0) -> FloatArray:
    """Return slow poles: real poles and well damped pairs whose decay rate is below a bound.

    Near static instability positive feedback has cancelled the stiffness, and the rotor returns slowly. A damping
    factor does not show this: it is not defined for real poles, and it is close to 1 where two real poles become a
    complex pair.

    Parameters
    ----------
    loop : Sensitivities
        The loop.
    slower_than_hz : float
        The bound on the decay rate is ``2 pi slower_than_hz`` [rad/s].

    Returns
    -------
    (n_found,) array
        Rates ``-Re(pole)`` [rad/s], slowest first, of the poles with ``|Im| <= |Re|`` below the bound, a pair once;
        negative for an unstable pole.
    """
    poles = loop.poles
    creeping = poles[(poles.imag >= 0) & (poles.imag <= np.abs(poles.real))]
    return np.sort(-creeping.real[-creeping.real < 2 * pi * slower_than_hz])


def structured_singular_values(matrices: ComplexArray) -> FloatArray:
    """Return mu of each matrix (..., n, n) for a diagonal complex change; for n > 2 an upper bound."""
    if matrices.shape[-1] == 1:
        return np.asarray(np.abs(matrices[..., 0, 0]))
    if matrices.shape[-1] > 2:
        return largest_singular_values(matrices)
    a, b, c, d = (matrices[..., i, j] for i in (0, 1) for j in (0, 1))
    return larger_of_two(np.abs(a) ** 2 + np.abs(d) ** 2 + 2 * np.abs(b * c), np.abs(a * d - b * c))


def _balanced(loop: Sensitivities, frequency_hz: FloatArray, at: Side) -> ComplexArray:
    """Return ``S - T = 2 S - I``."""
    S = loop.response(at, frequency_hz)
    return np.asarray(2 * S - np.eye(S.shape[-1]))


def _disk(loop: Sensitivities, gain: object) -> DiskMargin:
    if not loop.is_stable():
        return DiskMargin(0.0, (1.0, 1.0), 0.0, nan)
    value, place = refine_maxima(gain, loop.grid(), rounds=5)  # type: ignore[arg-type]
    alpha = 2.0 / value
    low = (2 - alpha) / (2 + alpha)
    return DiskMargin(alpha, (low, 1 / low if low > 0 else inf), degrees(2 * atan(alpha / 2)), place)


def _channels(loop: Sensitivities, at: Side) -> int:
    if at not in ("output", "input"):
        raise UsageError(f"margins at {at!r}; choose 'output' or 'input'")
    return int(loop.plant.C.shape[0] if at == "output" else loop.plant.B.shape[1])


def _margins_of(loop: Sensitivities, at: Side, i: int, grid: FloatArray, S: ComplexArray) -> LoopMargins:
    def gain_at(f: float) -> complex:
        return complex(1 - 1 / loop.response(at, f)[0, i, i])

    L = 1 - 1 / S
    factors = [1 / L[0].real] if L[0].real > 0 else []
    for f in _zeros(lambda f: gain_at(f).imag, grid, L.imag):
        value = gain_at(f).real
        if value > 0:
            factors.append(1 / value)
    low = max((g for g in factors if g < 1), default=0.0)
    high = min((g for g in factors if g >= 1), default=inf)
    phases, delays = [inf], [inf]
    for f in _zeros(lambda f: abs(gain_at(f)) - 1, grid, np.abs(L) - 1):
        angle = np.angle(gain_at(f))
        phases.append(abs(degrees(angle)))
        if f > 0:
            delays.append((angle % (2 * pi)) / (2 * pi * f))
    return LoopMargins((low, high), min(phases), min(delays))


def _zeros(function: object, grid: FloatArray, values: FloatArray) -> list[float]:
    """Return the places between grid points where a real function changes its sign."""
    signs = np.sign(values)
    changes = np.flatnonzero(signs[1:] * signs[:-1] < 0)
    return [float(scipy.optimize.brentq(function, grid[k], grid[k + 1], xtol=1e-12, rtol=1e-14)) for k in changes]
