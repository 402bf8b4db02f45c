"""How far a loop is from instability: disk margins, classical margins; what it amplifies at rest."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan, degrees, inf, nan, pi
from typing import Literal

import numpy as np
from scipy.optimize import brentq

from gbid.arrays import ComplexArray, FloatArray
from gbid.control.loop.force_entry import static_force_gain
from gbid.control.loop.norm import larger_of_two, largest_singular_values, refine_maxima
from gbid.control.loop.sensitivity import Sensitivities
from gbid.errors import UsageError

Side = Literal["output", "input"]


@dataclass(frozen=True)
class DiskMargin:
    """Balanced disk margin: how much every loop gain may change, in size and phase.

    Attributes
    ----------
    alpha : float
        Size of the disk, 0 for an unstable loop; 2 is the largest possible with a plant that falls off.
    gain : (float, float)
        Factors on the loop gain that the loop survives, ``(2 - alpha)/(2 + alpha)`` and its inverse.
    phase_deg : float
        Phase, of either sign, that it survives [degrees]: ``2 arctan(alpha / 2)``.
    frequency_hz : float
        Where the loop is closest to instability.
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
        Range of factors on the loop gain around 1 that keep it stable; 0 and infinity where there is no limit.
    phase_deg : float
        Smallest phase, of either sign, that makes it unstable [degrees]; infinite where none does.
    delay_s : float
        Smallest extra delay that makes it unstable [s].
    """

    gain: tuple[float, float]
    phase_deg: float
    delay_s: float


def disk_margin(loop: Sensitivities, at: Side = "output") -> DiskMargin:
    r"""Find the disk margin against changes of all loops at once, each with its own.

    Parameters
    ----------
    loop : Sensitivities
    at : {"output", "input"}
        Whether the changes are at the positions p or at the references r.

    Returns
    -------
    DiskMargin

    Notes
    -----
    Seiler, Packard and Gahinet (2020), balanced (skew 0): the loop withstands every
    :math:`f_i = (1 + \delta_i / 2)/(1 - \delta_i / 2)`, :math:`|\delta_i| < \alpha`, in each channel,

    .. math:: \alpha = 2 \big/ \max_\omega \mu(S - T), \quad T = I - S.

    For two channels the structured singular value of a diagonal change is its upper bound
    :math:`\min_D \bar\sigma(D M D^{-1})`, which has a closed form: the determinant does not change with D and the
    sum of squares is least, :math:`|m_{11}|^2 + |m_{22}|^2 + 2 |m_{12} m_{21}|`, where both off-diagonal entries
    weigh the same. For more than two the largest singular value is taken, which is on the safe side.
    """
    return _disk(loop, lambda f: structured_singular_values(_balanced(loop, f, at)))


def disk_margins_by_loop(loop: Sensitivities, at: Side = "output") -> tuple[DiskMargin, ...]:
    """Find the disk margin of each loop alone, the others unchanged.

    Parameters
    ----------
    loop : Sensitivities
    at : {"output", "input"}
        Whether the changes are at the positions p or at the references r.

    Returns
    -------
    tuple of DiskMargin
        One per channel.
    """
    n = _channels(loop, at)
    return tuple(_disk(loop, lambda f, i=i: np.abs(_balanced(loop, f, at)[:, i, i])) for i in range(n))


def loop_margins(loop: Sensitivities, at: Side = "output") -> tuple[LoopMargins, ...]:
    r"""Find gain, phase and delay margins of each loop, the others closed.

    Parameters
    ----------
    loop : Sensitivities
    at : {"output", "input"}
        Where each loop is opened.

    Returns
    -------
    tuple of LoopMargins
        One per channel; of an unstable loop the gains are (1, 1) and the others 0.

    Notes
    -----
    Opened at channel i, the loop gain is :math:`L_i = 1 - 1/S_{ii}`; in the paper's sign the loop is unstable
    where :math:`g\, e^{\mathrm i\varphi} L_i = 1`.
    """
    if not loop.is_stable():
        return (LoopMargins((1.0, 1.0), 0.0, 0.0),) * _channels(loop, at)
    grid = loop.grid(1500)
    S = loop.response(at, grid)
    return tuple(_margins_of(loop, at, i, grid, S[:, i, i]) for i in range(S.shape[-1]))


def static_amplification(loop: Sensitivities) -> float:
    """Return the largest singular value of S_o at rest: how much a steady disturbance of p grows by the loop.

    Parameters
    ----------
    loop : Sensitivities
    """
    return float(np.linalg.norm(loop.response("output", 0.0)[0].real, 2))


def static_stiffness_ratio(loop: Sensitivities) -> FloatArray:
    r"""Compare the static stiffness of the closed loop with that of the open one, axis by axis.

    A steady force on the rotor (without delay and actuators) moves the open loop by :math:`p = G_f f` and the closed
    one by :math:`S_o(0) G_f f`. The ratio is that of the diagonals, open over closed: the force per motion along its
    own axis that is left; below 1 the loop is softer.

    Parameters
    ----------
    loop : Sensitivities
        Of a continuous plant.

    Returns
    -------
    (n_outputs,) array

    Raises
    ------
    UsageError
        When the plant does not show where a force enters (see `gbid.control.force_entry`).
    """
    G_f = static_force_gain(loop.plant)
    return np.asarray(np.diag(G_f) / np.diag(loop.response("output", 0.0)[0].real @ G_f))


def slow_poles(loop: Sensitivities, slower_than_hz: float = 20.0) -> FloatArray:
    """Find poles that creep: real ones and well damped pairs that decay slower than a bound.

    Near static instability positive feedback has cancelled the stiffness, and the rotor creeps back. A damping factor
    does not see that: it knows no real poles, and is close to 1 where two of them meet and leave the axis as a pair.

    Parameters
    ----------
    loop : Sensitivities
    slower_than_hz : float
        Bound ``2 pi slower_than_hz`` on the decay rate.

    Returns
    -------
    (n_found,) array
        Rates ``-Re(pole)`` [rad/s], slowest first, of the poles with ``|Im| <= |Re|`` below the bound, a pair once;
        negative where one grows.
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
    """Return where a real function changes its sign between grid points."""
    signs = np.sign(values)
    changes = np.flatnonzero(signs[1:] * signs[:-1] < 0)
    return [float(brentq(function, grid[k], grid[k + 1], xtol=1e-12, rtol=1e-14)) for k in changes]
