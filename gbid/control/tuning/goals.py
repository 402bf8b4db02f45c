"""Goals of a design: base classes, goals on modes and rms values, bounds over frequency, disturbance spectra."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import scipy
from annotated_types import Gt, Lt

from gbid.control.tuning.loops import ControlLoops, LoopFamily, Path
from gbid.control.tuning.peaks import ModalResponse
from gbid.control.tuning.plane import (
    Eigensystem,
    damping_factors,
    damping_slopes,
    rate_slopes,
    searched_frequencies,
    true_rates,
)
from gbid.control.tuning.problem import ExtraLimit, Limits, LoopState, Measure, Pieces
from gbid.core.arrays import REAL, BoolArray, ComplexArray, FloatArray, is_finite
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.option_types import Allowed, Finite, NotNegative, Number, Positive, check_options
from gbid.lpv import MachineData
from gbid.recording import Recording
from gbid.structure import LinearModel


class Goal(ABC):
    """Objective or limit of a design; see `gbid.tune`. The annotations of the arguments define their checks."""

    def __post_init__(self) -> None:
        check_options(self, type(self).__name__)
        low, high = getattr(self, "low_hz", 0.0), getattr(self, "high_hz", inf)
        if not low < high:
            raise UsageError(f"{type(self).__name__}: low_hz = {low!r}, high_hz = {high!r}; give 0 <= low < high")

    def on(self, machine: MachineData) -> Goal:
        """Return this goal, completed with numbers of a machine that the goal does not give."""
        return self

    @abstractmethod
    def add_to(self, limits: Limits, plant: LinearModel) -> Limits:
        """Return the given limits, extended by this goal.

        Parameters
        ----------
        limits : Limits
            Objective and limits so far.
        plant : LinearModel
            One of the plants in continuous time.
        """


@dataclass(frozen=True, kw_only=True)
class Wanted(Goal):
    """Base of the goals that are a limit by default and an objective with ``soft=True``.

    Parameters
    ----------
    soft : bool
        Whether the goal is an objective. The search then makes its excess ``log(weight * value / limit)`` as small as
        it can. With several objectives it improves the worst one.
    weight : float
        Weight of an objective: with a larger one the search does more for it.
    """

    soft: bool = False
    weight: Positive = 1.0
    native: ClassVar[str] = ""
    """Name of the limit that the search knows without a measure, which is verified by an exact norm."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.weight != 1.0 and not self.soft:
            raise UsageError(f"{type(self).__name__}: weight belongs to an objective; give soft=True as well")

    @abstractmethod
    def measure(self, plant: LinearModel) -> Measure:
        """Return the quantity that this goal limits or minimises, with its weight.

        Parameters
        ----------
        plant : LinearModel
            One of the plants in continuous time.
        """

    def add_to(self, limits: Limits, plant: LinearModel) -> Limits:
        """Return the given limits, extended by this goal as an objective or as a limit."""
        limit = getattr(self, "limit", None)
        if self.native and not self.soft and is_finite(limit):
            known = getattr(limits, self.native)
            changed: dict[str, Any] = {self.native: float(limit if known is None else min(known, limit))}
            return replace(limits, **changed)
        where = "soft" if self.soft else "extra"
        changed = {where: (*getattr(limits, where), *self.measures(plant))}
        return replace(limits, **changed)

    def measures(self, plant: LinearModel) -> tuple[Measure, ...]:
        """Return the `Measure` objects of this goal: one for all axes, or one for each axis.

        Parameters
        ----------
        plant : LinearModel
            A plant of the design.
        """
        return (self.measure(plant),)


def limits_of(goals: Sequence[Goal], plant: LinearModel, machine: MachineData | None = None) -> Limits:
    """Return objective and limits of a list of goals, completed with mass and travel of a machine if known.

    Raises
    ------
    UsageError
        When none of them is an objective.
    """
    limits = Limits(weight=inf)  # no objective yet
    for goal in goals:
        limits = goal.on(machine or MachineData()).add_to(limits, plant)
    if limits.weight == inf:
        if not limits.soft:
            raise UsageError("goals: none of them is an objective; add MaxDamping(), or make one soft=True")
        limits = replace(limits, weight=0.0)
    return limits


# ---- Bounds over frequency: a number, breakpoints, or the gain of a transfer function.

BoundLike = float | Sequence[tuple[float, float]] | LinearModel
"""A number, ``(frequency_hz, bound)`` breakpoints, or a model with one input and one output whose gain is the bound."""


@dataclass(frozen=True, eq=False)
class Bound:
    """Bound as a function of frequency.

    Attributes
    ----------
    of_hz : callable
        From frequencies [Hz] to bounds, for arrays of any shape.
    places_hz : (k,) array
        Frequencies at which it has a corner, a step, or a narrow dip [Hz].
    constant : bool
        Whether it is one number at all frequencies.
    """

    of_hz: Callable[[FloatArray], FloatArray]
    places_hz: FloatArray
    constant: bool = False


def bound_over_frequency(bound: BoundLike, what: str) -> Bound:
    """Return a bound as a function of frequency.

    Parameters
    ----------
    bound : float, sequence of (frequency_hz, bound), or LinearModel
        Between breakpoints the bound is straight in logarithmic axes; outside it is constant.
    what : str
        Name for messages.

    Raises
    ------
    UsageError
        When numbers are not positive, when breakpoints do not rise in frequency, or when a model has more than one
        input or output.
    """
    if isinstance(bound, LinearModel):
        if bound.D.shape != (1, 1):
            raise UsageError(f"{what}: model {bound.name!r} as a bound has {bound.D.shape} channels; give one by one")
        return _gain(bound)
    if isinstance(bound, int | float | np.integer | np.floating):
        value = float(bound)
        if not (is_finite(bound) and value > 0):
            raise UsageError(f"{what} = {bound!r}; give a positive number")
        return Bound(lambda hz: np.full(np.shape(hz), value), np.zeros(0), constant=True)
    try:
        points = np.array([(float(hz), float(value)) for hz, value in bound])
    except (TypeError, ValueError):
        points = np.zeros((0, 2))
    if len(points) < 2 or not (np.isfinite(points) & (points > 0)).all() or not (np.diff(points[:, 0]) > 0).all():
        raise UsageError(
            f"{what} = {bound!r}; give a positive number, or (frequency_hz, bound) with rising frequencies"
        )
    x, y = np.log(points).T
    return Bound(lambda hz: np.exp(np.interp(np.log(np.maximum(hz, 1e-300)), x, y)), points[:, 0])


def _gain(model: LinearModel) -> Bound:
    """Return the gain of a model as a bound; zero frequency and undamped poles are replaced by frequencies nearby."""
    places, poles = _places(model), np.linalg.eigvals(model.A)
    still = np.unique(np.abs(poles.imag[np.abs(poles.real) <= 1e-9 * np.abs(poles)])) / (2 * np.pi)
    scale = float(places[places > 0].min()) if places.any() else 1.0

    def of_hz(hz: FloatArray) -> FloatArray:
        at = np.maximum(np.ravel(hz), 1e-6 * scale)
        for pole in still:
            at = np.where(np.abs(at - pole) <= 1e-9 * pole, pole * (1 + 2e-9), at)
        return np.asarray(np.abs(model.frequency_response(at)[:, 0, 0]).reshape(np.shape(hz)))

    return Bound(of_hz, places)


def _places(model: LinearModel) -> FloatArray:
    """Return the frequencies of the poles and zeros of a model with one input and one output [Hz]."""
    A, B, C, D = model.A, model.B, model.C, model.D
    whole = np.block([[A, B], [C, D]])
    zeros = scipy.linalg.eigvals(whole, np.diag([*np.ones(len(A)), 0.0]))
    roots = np.concatenate([np.linalg.eigvals(A), zeros[np.isfinite(zeros)]]) if len(A) else np.zeros(0)
    places = np.unique(np.concatenate([np.abs(roots), np.abs(roots.imag)])) / (2 * np.pi)
    fastest = np.abs(np.linalg.eigvals(A)).max(initial=0.0) / (2 * np.pi)  # what rounding leaves of 0 and of infinity
    return np.asarray(places[(places > 1e-9 * fastest) & (places < 1e9 * max(fastest, 1e-9))])


# ---- Goals on the modes of the loop: damping and decay, of all modes or of those in a band of frequencies.


Quantity = Literal["damping", "decay", "frequency"]
Whirl = Literal["both", "forward", "backward"]
_PLANAR = 0.05
"""Share of a circular whirl below which a mode counts as one of both directions."""


@dataclass(frozen=True)
class ModeMeasure(Measure):
    """Excess ``limit - value / weight`` of the modes in a frequency band.

    Parameters
    ----------
    name : str
        Name of the limit.
    limit : float
        Smallest damping factor, smallest decay rate [1/s], or largest magnitude of a pole over 2 pi [Hz].
    quantity : {"damping", "decay", "frequency"}
        What is limited. Decay and frequency are in units of their limit (of 1 1/s for a decay of 0), and the excess of
        the frequency has the other sign.
    low_hz, high_hz : float
        Natural frequencies of the modes that count [Hz].
    whirl : {"both", "forward", "backward"}
        Direction of the modes that count.
    weight : float
        Weight.
    """

    name: str
    limit: float
    quantity: Quantity = "damping"
    low_hz: float = 0.0
    high_hz: float = inf
    whirl: Whirl = "both"
    weight: float = 1.0

    def excess(self, state: LoopState) -> FloatArray:
        """Return the excess of the worst mode of each loop; minus infinity without a mode in the band."""
        return np.asarray(np.where(self._counts(state), self._values(state), -np.inf).max(axis=1))

    def pieces(self, state: LoopState, window: float) -> Pieces:
        """Return the modes near the limit as smooth pieces with gradients."""
        T = state.family.sample_time
        every = self._values(state)
        upper = state.system.values.imag >= -REAL * np.abs(state.system.values)
        loop, which = np.nonzero(self._counts(state) & upper & (every > -window))
        values = state.system.values[loop, which]
        slopes = state.system.slopes(loop, which, state.derivatives) * rate_slopes(values, T)[:, None]
        rates = true_rates(values, T)
        if self.quantity == "damping":
            slope = -damping_slopes(rates, slopes, T)
        elif self.quantity == "decay":
            slope = slopes.real / self._unit
        else:
            slope = (rates.conj()[:, None] * slopes).real / np.abs(rates)[:, None]
            slope *= self.weight**2 / (2 * np.pi * self.limit)
        return Pieces(loop, every[loop, which], slope / self.weight, values)

    @property
    def _unit(self) -> float:
        return self.limit if self.limit > 0 else 1.0

    def _values(self, state: LoopState) -> FloatArray:
        T = state.family.sample_time
        rates = true_rates(state.system.values, T)
        if self.quantity == "damping":
            return np.asarray(self.limit - damping_factors(rates, T) / self.weight)
        if self.quantity == "decay":
            return np.asarray((self.limit + rates.real / self.weight) / self._unit)
        return np.asarray(self.weight * np.abs(rates) / (2 * np.pi * self.limit) - 1)

    def _counts(self, state: LoopState) -> BoolArray:
        values, n = state.system.values, state.family.n_outputs
        size = np.abs(true_rates(values, state.family.sample_time)) / (2 * np.pi)
        counts = (size >= self.low_hz) & (size <= self.high_hz)
        if self.whirl == "both":
            return np.asarray(counts)
        shape = state.loops.C[:, :n] @ state.system.right
        x, y = shape[:, : n // 2], shape[:, n // 2 :]
        # where x is the real part of exp(j w t), y of -j exp(j w t) turns from x to y
        turn = -2 * (x.conj() * y).imag.sum(axis=1) * np.sign(values.imag)
        along = turn if self.whirl == "forward" else -turn
        return np.asarray(counts & (along >= -_PLANAR * (np.abs(shape) ** 2).sum(axis=1)))


@dataclass(frozen=True, kw_only=True)
class OfModes:
    """Base of the goals on modes: selection by natural frequency and direction of whirl.

    Parameters
    ----------
    low_hz, high_hz : float
        Natural frequencies of the modes that count [Hz]; all by default.
    whirl : {"both", "forward", "backward"}
        Direction of whirl of the modes that count. The first half of the measured outputs is one direction x, the
        second half the other direction y in the same order of planes; forward is from x to y. A mode in a plane counts
        for both.
    """

    low_hz: NotNegative = 0.0
    high_hz: Number = inf
    whirl: Whirl = "both"

    def of_modes(self, name: str, limit: float, quantity: Quantity, weight: float, plant: LinearModel) -> ModeMeasure:
        """Return the `Measure` of the selected modes."""
        if self.whirl != "both" and len(plant.C) % 2:
            raise UsageError(
                f"{type(self).__name__}: whirl = {self.whirl!r} of {len(plant.C)} outputs; x and y are needed"
            )
        label = name if self.whirl == "both" else f"{name} ({self.whirl} whirl)"
        return ModeMeasure(label, limit, quantity, self.low_hz, self.high_hz, self.whirl, weight)

    @property
    def all_modes(self) -> bool:
        """Whether the goal selects all modes."""
        return (self.low_hz, self.high_hz, self.whirl) == (0.0, inf, "both")


@dataclass(frozen=True)
class MaxDamping(OfModes, Goal):
    """Objective: maximise the smallest damping factor of the oscillatory modes.

    Parameters
    ----------
    weight : float
        Weight beside soft goals: the objective is the damping factor over it.
    low_hz, high_hz, whirl
        See `OfModes`.
    """

    weight: Positive = 1.0

    def add_to(self, limits: Limits, plant: LinearModel) -> Limits:
        """Return the given limits with the smallest damping factor as objective."""
        if self.all_modes:
            _only_one(limits)
            return replace(limits, objective="damping", weight=1 / self.weight)
        measure = self.of_modes("damping in the band", 0.0, "damping", self.weight, plant)
        return replace(limits, soft=(*limits.soft, measure))


@dataclass(frozen=True)
class MaxDecay(Goal):
    """Objective: maximise the slowest decay ``-Re`` of all poles [1/s].

    Parameters
    ----------
    weight : float
        Weight beside soft goals: the objective is the decay in units of a typical rate of the loops, over the weight.
    """

    weight: Positive = 1.0

    def add_to(self, limits: Limits, plant: LinearModel) -> Limits:
        """Return the given limits with the slowest decay as objective."""
        _only_one(limits)
        return replace(limits, objective="decay", weight=1 / self.weight)


@dataclass(frozen=True)
class MinDamping(OfModes, Wanted):
    """Smallest damping factor of the modes in a band; its excess is ``limit - damping / weight``.

    Parameters
    ----------
    limit : float
        Smallest allowed damping factor.
    low_hz, high_hz, whirl
        See `OfModes`.
    soft, weight
        See `Wanted`.
    """

    limit: Annotated[Finite, Gt(-1), Lt(1), Allowed("a damping factor below 1")]

    def measure(self, plant: LinearModel) -> ModeMeasure:
        """Return the `Measure` of the damping factors."""
        return self.of_modes("damping of modes", self.limit, "damping", self.weight, plant)


@dataclass(frozen=True)
class SlowestPole(OfModes, Wanted):
    """Smallest decay rate ``-Re`` of all poles, real poles included, or of the poles in a band.

    Parameters
    ----------
    rate : float
        Smallest allowed decay rate [1/s]: the largest real part is ``-rate``.
    low_hz, high_hz, whirl
        See `OfModes`; magnitudes of the poles over 2 pi.
    soft, weight
        See `Wanted`.
    """

    rate: Annotated[NotNegative, Allowed("a rate of at least 0 in 1/s")]

    def measure(self, plant: LinearModel) -> ModeMeasure:
        """Return the `Measure` of the decay rates."""
        return self.of_modes("slowest pole in the band", self.rate, "decay", self.weight, plant)

    def add_to(self, limits: Limits, plant: LinearModel) -> Limits:
        """Return the given limits, extended by the smallest decay rate."""
        if self.soft or not self.all_modes:
            return super().add_to(limits, plant)
        return replace(limits, slowest_pole=max(limits.slowest_pole, self.rate))


@dataclass(frozen=True)
class FastestPole(OfModes, Wanted):
    """Largest magnitude over 2 pi of all poles, or of the poles in a band; one side of a pole region.

    Parameters
    ----------
    hz : float
        Largest allowed magnitude [Hz].
    low_hz, high_hz, whirl
        See `OfModes`.
    soft, weight
        See `Wanted`; the excess is ``weight * magnitude / hz - 1``.
    """

    hz: Positive

    def measure(self, plant: LinearModel) -> ModeMeasure:
        """Return the `Measure` of the pole magnitudes."""
        return self.of_modes("fastest pole", self.hz, "frequency", self.weight, plant)


def _only_one(limits: Limits) -> None:
    if limits.weight < inf:
        raise UsageError("goals: give either MaxDamping or MaxDecay of all modes, and only once")


# ---- Disturbance of the position: the spectrum that a recording shows, and lines such as unbalance.


@dataclass(frozen=True, eq=False)
class DisturbanceSpectrum(Brief):
    """Disturbance d of the measured position in the open loop, as a one-sided spectrum.

    Parameters
    ----------
    frequency_hz : (k,) array
        Frequencies, rising [Hz].
    density : (k, n, n) array
        Hermitian spectral density matrices of d [m^2/Hz], straight between the frequencies and zero beyond them. The
        variance of d is the integral of its diagonal over frequency. A line (unbalance at the speed) is a narrow peak
        of it.
    name : str
        Name.
    """

    frequency_hz: FloatArray
    density: ComplexArray
    name: str = "disturbance"

    def __post_init__(self) -> None:
        try:
            f, S = np.atleast_1d(np.asarray(self.frequency_hz, float)), np.asarray(self.density, complex)
        except (TypeError, ValueError):
            raise UsageError("disturbance: frequency_hz and density must be numbers") from None
        if S.ndim != 3 or S.shape[0] != len(f) or S.shape[1] != S.shape[2] or len(f) < 2:
            raise UsageError(f"disturbance: density has shape {S.shape}; give (k, n, n) for {len(f)} frequencies")
        if not (np.isfinite(f).all() and np.isfinite(S).all() and (np.diff(f) > 0).all() and f[0] >= 0):
            raise UsageError("disturbance: frequencies must rise from 0 or more, and all numbers must be finite")
        size = float(np.abs(S).max())
        hermitian = np.abs(S - S.conj().transpose(0, 2, 1)).max() <= 1e-9 * size
        if not hermitian or np.linalg.eigvalsh(S).min() < -1e-9 * size:
            raise UsageError("disturbance: density must be Hermitian, without negative eigenvalues, at each frequency")
        object.__setattr__(self, "frequency_hz", f)
        object.__setattr__(self, "density", S)

    @property
    def widths(self) -> FloatArray:
        """Widths of the intervals around each frequency, for sums over frequency by the trapezoidal rule (k,) [Hz]."""
        steps = np.diff(self.frequency_hz)
        return np.asarray((np.append(steps, 0.0) + np.append(0.0, steps)) / 2)

    @property
    def rms(self) -> FloatArray:
        """Rms of each channel (n,) [m]."""
        return np.asarray(np.sqrt(np.einsum("k,kii->i", self.widths, self.density).real))


def recorded_disturbance(
    recordings: Recording | Sequence[Recording], signal: str = "p", *, segment_s: Positive = 0.5
) -> DisturbanceSpectrum:
    """Return the disturbance that recordings without excitation show: noise, unbalance and run-out.

    Parameters
    ----------
    recordings : Recording or sequence of these
        Recordings of the open loop at rest, at the operating points of the design.
    signal : str
        Name of the measured position.
    segment_s : float
        Length of the segments of Welch's estimate [s].

    Returns
    -------
    DisturbanceSpectrum
        Mean of the recordings' spectra.

    Raises
    ------
    UsageError
        When a recording has no such signal or is shorter than a segment, or when sample times differ.
    """
    every = [recordings] if isinstance(recordings, Recording) else list(recordings)
    if not every:
        raise UsageError("recorded_disturbance: give a gbid.Recording or a list of these")
    spectra = []
    for recording in every:
        if signal not in recording.signals:
            raise UsageError(
                f"recording {recording.name!r}: no signal {signal!r}; choose from {', '.join(recording.signals)}"
            )
        p, length = np.asarray(recording.signals[signal]), round(segment_s / recording.sample_time)
        if recording.sample_time != every[0].sample_time:
            raise UsageError("recorded_disturbance: the recordings have different sample times")
        if length < 8 or len(p) < length:
            raise UsageError(f"recording {recording.name!r}: {len(p)} samples; segment_s = {segment_s} does not fit")
        parts = {"fs": 1 / recording.sample_time, "nperseg": length}
        f, S = scipy.signal.csd(p.T[:, None], p.T[None], **parts)
        spectra.append(np.moveaxis(S, -1, 0).transpose(0, 2, 1))
    return DisturbanceSpectrum(f, np.mean(spectra, axis=0), signal)


# ---- Goals on the rms of position and reference under a measured disturbance (an H2 norm).

_BANDS = 384
"""Number of bands of frequency over which a response is integrated."""
_LOW = 1e-3
"""Share of the highest frequency below which intervals are no longer in proportion to the frequency."""


@dataclass(frozen=True)
class RmsGoal(Wanted):
    r"""Base of the goals on the rms under a disturbance d of the position, over all channels.

    .. math:: \sqrt{\int \operatorname{tr}\left(M(f)\, \Phi_d(f)\, M(f)^H\right) \mathrm d f}

    Parameters
    ----------
    limit_m : float
        Largest allowed rms [m].
    disturbance : DisturbanceSpectrum
        Spectrum of d; see `gbid.control.recorded_disturbance`.
    soft, weight
        See `Wanted`.
    """

    limit_m: Positive
    disturbance: Annotated[DisturbanceSpectrum, Allowed("recorded_disturbance(...)")]
    control: ClassVar[bool]
    label: ClassVar[str]

    def measure(self, plant: LinearModel) -> ExtraLimit:
        """Return the `Measure` of the rms value."""
        given = self.disturbance
        if given.density.shape[1] != len(plant.C):
            raise UsageError(
                f"{type(self).__name__}: the disturbance has {given.density.shape[1]} channels, the plant "
                f"{len(plant.C)} outputs"
            )
        rms = rms_under(given, self.control)
        return ExtraLimit(f"rms of {self.label}", rms, self.limit_m / self.weight)


def rms_under(
    spectrum: DisturbanceSpectrum, control: bool = False, path: Path | None = None
) -> Callable[[LoopFamily, FloatArray], FloatArray]:
    """Return the rms of every loop under a disturbance as a function of loops and gains.

    Parameters
    ----------
    spectrum : DisturbanceSpectrum
        Disturbance d of the measured outputs, or of the sources of a path.
    control : bool
        Whether the rms is that of the references, else of the outputs.
    path : Path, optional
        Signals from and to which the response is taken.
    """
    edges, power = _bands(spectrum)

    def rms(family: LoopFamily, gains: FloatArray) -> FloatArray:
        if path is not None:
            assert isinstance(family, ControlLoops)
            family = family.along(path)
        loops = family.matrices(gains)
        rows = slice(family.n_outputs, None) if control else slice(0, family.n_outputs)
        T = family.sample_time
        below = edges < (np.inf if T is None else 0.499 / T)
        w = searched_frequencies(2 * np.pi * edges[below], T)
        products = ModalResponse(loops, Eigensystem.of(loops.A), rows).mean_products(w)
        squares = np.einsum("kjl,mkjl->m", power[: len(w) - 1], products).real
        return np.asarray(np.sqrt(np.maximum(squares, 1e-300)))

    return rms


@dataclass(frozen=True)
class RmsPosition(RmsGoal):
    """Rms of the position p + d under a measured disturbance.

    Parameters
    ----------
    limit_m, disturbance, soft, weight
        See `RmsGoal`.
    """

    control = False
    label = "p"


@dataclass(frozen=True)
class RmsControl(RmsGoal):
    """Rms of the reference r, the motion that the controller demands from the piezos, under a measured disturbance.

    Parameters
    ----------
    limit_m, disturbance, soft, weight
        See `RmsGoal`.
    """

    control = True
    label = "r"


def _bands(given: DisturbanceSpectrum) -> tuple[FloatArray, ComplexArray]:
    """Return the edges of `_BANDS` frequency bands [Hz] and the power in each band (k, n, n).

    Bands are narrow where the power is large, and in proportion to the frequency: within a band the density counts as
    constant. They do not follow the resonances of a loop, which are integrated exactly within a band.
    """
    f = given.frequency_hz
    fine = np.union1d(f, np.concatenate([np.linspace(f[0], f[-1], 400), np.geomspace(_LOW * f[-1], f[-1], 1200)]))
    fine = fine[fine >= f[0]]
    density = _between(fine, f, given.density)
    steps = (density[1:] + density[:-1]) / 2 * np.diff(fine)[:, None, None]
    below = np.concatenate([np.zeros_like(density[:1]), np.cumsum(steps, axis=0)])
    power, pitch = np.einsum("kii->k", below).real, np.log(np.maximum(fine, _LOW * f[-1]))
    parts = [power, pitch - pitch[0], fine - fine[0]]
    share = sum(part / max(float(part[-1]), 1e-300) * weight for part, weight in zip(parts, (2, 3, 1), strict=True))
    nodes = np.interp(np.linspace(0.0, share[-1], _BANDS + 1), share, fine)
    return nodes, np.diff(_between(nodes, fine, below), axis=0)


def _between(hz: FloatArray, known: FloatArray, values: ComplexArray) -> ComplexArray:
    """Return values (k, n, n) at other frequencies by linear interpolation."""
    return np.asarray(scipy.interpolate.make_interp_spline(known, values, k=1)(hz))
