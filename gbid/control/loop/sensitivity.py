"""Sensitivities of a loop (Eq. 22), their peaks, zones of ISO 14839-3, disk margins and classical margins."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import atan, degrees, inf, nan, pi
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt
import scipy

from gbid.control.loop.close import loop_with_disturbances, static_force_gain
from gbid.control.loop.norm import Peak, larger_of_two, largest_singular_values, peak_gain, refine_maxima
from gbid.core.arrays import ComplexArray, FloatArray
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import UsageError
from gbid.core.figures import Pictured
from gbid.structure import LinearModel
from gbid.structure.delay import with_pade
from gbid.structure.models import frequency_grid

Which = Literal["output", "input", "control", "plant", "complementary"]
STABILITY_PADE_ORDER = 6
"""Order of the Pade delays for the stability test of a loop with exact delays."""


@dataclass(frozen=True, eq=False)
class Sensitivities(Brief, Pictured):
    r"""Sensitivities of a loop ``r = K p`` (Eq. 21) to disturbances.

    d is added to the measured position p, and w to the reference r:

    ================== =========================================== =================================
    name               transfer matrix                             from, to
    ================== =========================================== =================================
    ``output``         :math:`S_o = (I - G K)^{-1}` (Eq. 22)        d to p
    ``input``          :math:`S_i = (I - K G)^{-1}`                 w to r
    ``control``        :math:`K S_o`                               d to r: the effort
    ``plant``          :math:`S_o G`                               w to p
    ``complementary``  :math:`T_o = I - S_o = -G K S_o`            d to p, so that S_o + T_o = I
    ================== =========================================== =================================

    Parameters
    ----------
    plant, controller : LinearModel
        G and K, both continuous or both sampled; the plant may have exact delays.
    """

    plant: LinearModel
    controller: LinearModel

    drawn_by = "plot_iso_zones"

    def __post_init__(self) -> None:
        assert self._loop is not None  # raises an error when the models do not form a loop

    def _brief(self) -> Description:
        return brief(self, "", plant=self.plant.summary, controller=self.controller.summary)

    @property
    def has_delay(self) -> bool:
        """Whether the plant has exact delays. Such a loop has a frequency response but no finite state-space model."""
        return self.plant.delay is not None

    def is_stable(self) -> bool:
        """Return whether the loop is stable; Padé delays of order `STABILITY_PADE_ORDER` replace exact delays."""
        return bool(self._loop.is_stable())

    def model(self, which: Which) -> LinearModel:
        """Return the state-space model of one sensitivity; the models of all sensitivities have equal A.

        Parameters
        ----------
        which : {"output", "input", "control", "plant", "complementary"}
            Name of the sensitivity.

        Returns
        -------
        LinearModel

        Raises
        ------
        UsageError
            When the name is unknown, or when the plant has exact delays: replace them with `gbid.structure.with_pade`.
        """
        _check_which(which)
        if self.has_delay:
            raise UsageError(
                f"loop of {self.plant.name!r} has exact delays: use response() and peak(), or with_pade(plant, order)"
            )
        return self._part(which)

    def response(self, which: Which, frequency_hz: npt.ArrayLike) -> ComplexArray:
        """Return a frequency response, with exact delays.

        Parameters
        ----------
        which : {"output", "input", "control", "plant", "complementary"}
            Name of the sensitivity.
        frequency_hz : (n_frequencies,) array
            Frequencies [Hz].

        Returns
        -------
        (n_frequencies, n_outputs, n_inputs) array
            Frequency response.

        Raises
        ------
        UsageError
            When the name is unknown, or when frequencies are not finite.
        """
        _check_which(which)
        beside = self._beside_integrators(np.atleast_1d(np.asarray(frequency_hz, float)))
        G, K = self.plant.frequency_response(beside), self.controller.frequency_response(beside)
        return _combine(which, G, K)

    def _beside_integrators(self, frequency_hz: FloatArray) -> FloatArray:
        """Return frequencies; zero is replaced by a tiny frequency if plant or controller integrates."""
        at_rest = frequency_hz == 0
        if not at_rest.any() or not any(_integrates(model) for model in (self.plant, self.controller)):
            return frequency_hz
        moving = np.abs(self.poles)
        return np.where(at_rest, 1e-9 * float(moving[moving > 0].min(initial=1e3)) / (2 * np.pi), frequency_hz)

    def peak(self, which: Which = "output", tolerance: float = 1e-8) -> Peak:
        """Return the largest singular value over all frequencies.

        Parameters
        ----------
        which : {"output", "input", "control", "plant", "complementary"}
            Name of the sensitivity.
        tolerance : float
            Relative tolerance, for a loop without exact delays.

        Returns
        -------
        Peak
            Exact (see `gbid.control.peak_gain`) without exact delays. With exact delays it comes from a grid that is
            dense around the modes of the loop and refined around its maxima. Infinite when the loop is not stable.

        Raises
        ------
        UsageError
            When the name is unknown.
        """
        _check_which(which)
        if not self.has_delay:
            return peak_gain(self._part(which), tolerance)
        if not self.is_stable():
            return Peak(inf, nan)
        return refine_maxima(lambda f: largest_singular_values(self.response(which, f)), self.grid())

    def grid(self, n: int = 400) -> FloatArray:
        """Return frequencies [Hz] adapted to the modes of the loop; see `frequency_grid`.

        Parameters
        ----------
        n : int
            Approximate number of frequencies.
        """
        return frequency_grid(self._loop, n)

    @property
    def poles(self) -> ComplexArray:
        """Poles of the loop [rad/s]; Padé filters replace exact delays."""
        return self._loop.poles()

    @cached_property
    def _loop(self) -> LinearModel:
        plant = with_pade(self.plant, STABILITY_PADE_ORDER) if self.has_delay else self.plant
        return loop_with_disturbances(plant, self.controller)

    def _part(self, which: Which) -> LinearModel:
        """Return one sensitivity as a part of the loop from (w, d) to (p, r)."""
        n_r, n_p = self.plant.B.shape[1], self.plant.C.shape[0]
        w, d, p, r = slice(0, n_r), slice(n_r, None), slice(0, n_p), slice(n_p, None)
        rows, columns = {"output": (p, d), "input": (r, w), "control": (r, d), "plant": (p, w)}.get(which, (p, d))
        loop = self._loop
        C, D = loop.C[rows], loop.D[rows, columns]
        if which == "complementary":
            C, D = -C, np.eye(n_p) - D
        return replace(
            loop,
            B=loop.B[:, columns],
            C=C,
            D=D,
            name=f"{which} sensitivity, {loop.name}",
            input_names=tuple(loop.input_names[columns]),
            output_names=tuple(loop.output_names[rows]),
        )


def sensitivities(plant: LinearModel, controller: LinearModel) -> Sensitivities:
    """Return the sensitivities of a loop ``r = K p`` (Eqs. 21, 22).

    Parameters
    ----------
    plant : LinearModel
        G, from r to p; may have exact delays.
    controller : LinearModel
        K, from p to r.

    Returns
    -------
    Sensitivities
        Models, frequency responses and peaks of S_o, S_i, K S_o, S_o G and I - S_o.

    Raises
    ------
    UsageError
        When the two do not form a loop (as for `gbid.close_loop`).

    Examples
    --------
    >>> import gbid
    >>> from gbid.control.controllers.structures import p_controller
    >>> loop = gbid.sensitivities(gbid.load_model("theisen2016").plant_at(6, 0), p_controller(1.125, 0.99))
    >>> round(loop.peak("output").value, 3)
    2.283
    """
    return Sensitivities(plant, controller)


def _combine(which: Which, G: ComplexArray, K: ComplexArray) -> ComplexArray:
    n_p, n_r = G.shape[-2:]
    if which == "input":
        return np.asarray(np.linalg.inv(np.eye(n_r) - K @ G))
    S = np.linalg.inv(np.eye(n_p) - G @ K)
    if which == "control":
        return np.asarray(K @ S)
    if which == "plant":
        return np.asarray(S @ G)
    return np.asarray(np.eye(n_p) - S if which == "complementary" else S)


def _check_which(which: str) -> None:
    if which not in get_args(Which):
        raise UsageError(f"sensitivity {which!r}; choose {', '.join(map(repr, get_args(Which)))}")


def _integrates(model: LinearModel) -> bool:
    at_rest = 0.0 if model.dt is None else 1.0
    tolerance = 1e-12 * max(1.0, float(np.abs(model.A).max(initial=0.0)))
    return bool((np.abs(np.linalg.eigvals(model.A) - at_rest) <= tolerance).any())


@dataclass(frozen=True, eq=False)
class SensitivityData(Brief):
    """Frequency responses of a loop for the plots, channel by channel.

    Attributes
    ----------
    frequency_hz : (n_frequencies,) array
        Frequencies [Hz].
    output : (n_frequencies, 2, 2) array
        S_o (Fig. 20).
    control : (n_frequencies, 2, 2) array
        K S_o (Fig. 20).
    open_loop : (n_frequencies, 2, 2) array
        G (Fig. 21).
    plant : (n_frequencies, 2, 2) array
        S_o G (Fig. 21).
    input_names, output_names : tuple of str
        Channels of r and p.
    """

    frequency_hz: FloatArray
    output: ComplexArray
    control: ComplexArray
    open_loop: ComplexArray
    plant: ComplexArray
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]


def sensitivity_data(
    plant: LinearModel, controller: LinearModel, frequency_hz: npt.ArrayLike | None = None
) -> SensitivityData:
    """Return the frequency response curves of a loop (paper, Figs. 20 and 21).

    Parameters
    ----------
    plant, controller : LinearModel
        G from r to p (exact delays allowed) and K from p to r.
    frequency_hz : (n_frequencies,) array, optional
        Frequencies [Hz]; by default 600 from 1 to 1000 Hz with logarithmic spacing.

    Returns
    -------
    SensitivityData

    Raises
    ------
    UsageError
        When the two do not form a loop, or when frequencies are not finite.
    """
    f = np.geomspace(1.0, 1000.0, 600) if frequency_hz is None else np.atleast_1d(np.asarray(frequency_hz, float))
    loop = sensitivities(plant, controller)
    return SensitivityData(
        f,
        loop.response("output", f),
        loop.response("control", f),
        plant.frequency_response(f),
        loop.response("plant", f),
        plant.input_names,
        plant.output_names,
    )


# ---- Zones of ISO 14839-3 for the stability margin of a loop, by the peak of its sensitivity in each axis.

Zone = Literal["A", "B", "C", "D"]
ISO_LIMITS: dict[Zone, float] = {"A": 3.0, "B": 4.0, "C": 5.0, "D": inf}
"""Upper limits of the peak of the sensitivity in each zone (ISO 14839-3: 9.5 dB, 12 dB and 14 dB)."""


@dataclass(frozen=True, eq=False)
class SensitivityZones(Brief):
    """Sensitivity of each axis of a loop, its peak and its zone.

    Attributes
    ----------
    frequency_hz : (n,) array
        Frequencies [Hz].
    magnitude : (n, n_axes) array
        Magnitude of the sensitivity of each axis, with the loops of the other axes closed.
    peak : (n_axes,) array
        Its largest value over all frequencies; inf for a loop that is not stable.
    peak_hz : (n_axes,) array
        Frequency of the peak [Hz].
    zone : tuple of {"A", "B", "C", "D"}
        Zone of each axis: newly commissioned machines lie in A, B is acceptable for long operation, C for a limited
        time, D is likely to cause damage.
    axes : tuple of str
        Names of the axes.
    """

    frequency_hz: FloatArray
    magnitude: FloatArray
    peak: FloatArray
    peak_hz: FloatArray
    zone: tuple[Zone, ...]
    axes: tuple[str, ...]

    def _brief(self) -> Description:
        about = ", ".join(
            f"{axis} zone {zone} (peak {peak:.3f})"
            for axis, zone, peak in zip(self.axes, self.zone, self.peak, strict=True)
        )
        return brief(self, about)


def iso_zone(peak: float) -> Zone:
    """Return the zone of ISO 14839-3 of a peak of the sensitivity.

    Parameters
    ----------
    peak : float
        Largest magnitude of the sensitivity of an axis; inf for a loop that is not stable.

    Returns
    -------
    {"A", "B", "C", "D"}
        The zone; a limit belongs to the zone below it.

    Examples
    --------
    >>> iso_zone(2.6), iso_zone(4.5)
    ('A', 'C')
    """
    return next((zone for zone, limit in ISO_LIMITS.items() if peak <= limit), "D")


def sensitivity_zones(loop: Sensitivities) -> SensitivityZones:
    """Return the sensitivity of each axis of a loop with its zone of ISO 14839-3.

    Parameters
    ----------
    loop : Sensitivities
        Result of `gbid.sensitivities`.

    Returns
    -------
    SensitivityZones
        Curves over a grid that is dense around the poles. Peaks are found between its frequencies, too.

    Notes
    -----
    ISO 14839-3 measures the sensitivity axis by axis: a disturbance is added to the signal of one sensor, and all axes
    are under control. These are the diagonal entries of ``S_o``. The largest singular value, `Sensitivities.peak`, is
    never smaller.
    """
    f = loop.grid()
    f = f[f > 0]
    names = loop.plant.output_names
    stable = loop.is_stable()

    def of_axis(i: int, at: FloatArray) -> FloatArray:
        return np.asarray(np.abs(loop.response("output", at)[:, i, i]))

    axes = range(len(names))
    peaks = [refine_maxima(partial(of_axis, i), loop.grid()) if stable else Peak(inf, nan) for i in axes]
    values = np.array([peak.value for peak in peaks])
    return SensitivityZones(
        frequency_hz=f,
        magnitude=np.column_stack([of_axis(i, f) for i in axes]),
        peak=values,
        peak_hz=np.array([peak.frequency_hz for peak in peaks]),
        zone=tuple(iso_zone(value) for value in values.tolist()),
        axes=names,
    )


# ---- Stability margins of a loop: disk margins, classical margins, and static amplification.

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
    """Classical margins of one loop while all other loops stay closed.

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
    """Return the disk margin of each loop alone, with all other loops unchanged.

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

    def gain(i: int, frequency_hz: FloatArray) -> FloatArray:
        return np.asarray(np.abs(_balanced(loop, frequency_hz, at)[:, i, i]))

    return tuple(_disk(loop, partial(gain, i)) for i in range(_channels(loop, at)))


def loop_margins(loop: Sensitivities, at: Side = "output") -> tuple[LoopMargins, ...]:
    r"""Return the gain, phase and delay margins of each loop, with all other loops closed.

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
    """Return the ratio of the static stiffnesses of closed and open loop, axis by axis.

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
        When the plant does not show where a force enters (see `force_entry`).
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
    """Return the balanced sensitivity ``S - T = 2 S - I``."""
    S = loop.response(at, frequency_hz)
    return np.asarray(2 * S - np.eye(S.shape[-1]))


def _disk(loop: Sensitivities, gain: Callable[[FloatArray], FloatArray]) -> DiskMargin:
    if not loop.is_stable():
        return DiskMargin(0.0, (1.0, 1.0), 0.0, nan)
    value, place = refine_maxima(gain, loop.grid())
    alpha = 2.0 / value
    low = (2 - alpha) / (2 + alpha)
    return DiskMargin(alpha, (low, 1 / low if low > 0 else inf), degrees(2 * atan(alpha / 2)), place)


def _channels(loop: Sensitivities, at: Side) -> int:
    return int(loop.plant.C.shape[0] if at == "output" else loop.plant.B.shape[1])


def _margins_of(loop: Sensitivities, at: Side, i: int, grid: FloatArray, S: ComplexArray) -> LoopMargins:
    def gain_at(f: float) -> complex:
        return complex(1 - 1 / loop.response(at, f)[0, i, i])

    L = 1 - 1 / S
    factors = [1 / value for value in _real_ends(loop, i, gain_at) if value > 0]
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


_PASSED_ON = 0.1  # smallest relative change of the loop gain over an octave at rest with an integrator in the loop


def _real_ends(loop: Sensitivities, i: int, gain_at: Callable[[float], complex]) -> list[float]:
    """Return the loop gain of a channel where it is real: at zero frequency, and at the Nyquist or infinite frequency.

    With an integrator the gain at rest is infinite, and no factor but zero brings a pole there.
    """
    rest = float(loop._beside_integrators(np.zeros(1))[0])
    at_rest = gain_at(rest)
    is_finite = rest == 0 or abs(gain_at(2 * rest) - at_rest) < _PASSED_ON * abs(at_rest)
    ends = [at_rest.real] if is_finite else []
    if loop.plant.dt is not None:
        return [*ends, gain_at(0.5 / loop.plant.dt).real]
    if loop.has_delay:  # the gain turns for ever
        return ends
    D = loop.plant.D @ loop.controller.D
    return [*ends, float(1 - 1 / np.linalg.inv(np.eye(len(D)) - D)[i, i])] if D.any() else ends


def _zeros(function: object, grid: FloatArray, values: FloatArray) -> list[float]:
    """Return the zeros of a real function between grid points, found by changes of sign."""
    signs = np.sign(values)
    changes = np.flatnonzero(signs[1:] * signs[:-1] < 0)
    return [float(scipy.optimize.brentq(function, grid[k], grid[k + 1], xtol=1e-12, rtol=1e-14)) for k in changes]
