"""Goals on responses: sensitivities, control effort, roll-off and margins over frequency, travel after an impact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum
from math import inf, pi, radians
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from annotated_types import Gt, Le, Lt

from gbid.control.loop.close import force_entry
from gbid.control.loop.half_sine import HalfSine
from gbid.control.loop.norm import largest_singular_values
from gbid.control.loop.sensitivity import structured_singular_values
from gbid.control.tuning.goals import (
    Bound,
    BoundLike,
    DisturbanceSpectrum,
    Wanted,
    bound_over_frequency,
    rms_under,
)
from gbid.control.tuning.loops import ControlLoops, Derivatives, LoopFamily, Loops, Path
from gbid.control.tuning.peaks import (
    ModalResponse,
    Peaks,
    around,
    base_frequencies,
    direct_response,
    exact_peaks,
    find_peaks,
    peak_curvature,
    peak_slopes,
)
from gbid.control.tuning.plane import Eigensystem, searched_frequencies, true_frequencies
from gbid.control.tuning.problem import ExtraLimit, LoopState, Measure, Pieces
from gbid.core.arrays import ComplexArray, FloatArray, IntArray
from gbid.core.errors import UsageError
from gbid.core.option_types import Allowed, Finite, NotNegative, Number, Positive
from gbid.lpv import MachineData
from gbid.structure import LinearModel


class LoopResponse(Enum):
    """Response to a disturbance on p, as (factor on S_o, factor on the unit matrix, whether K S_o replaces S_o)."""

    SENSITIVITY = (1.0, 0.0, False)
    COMPLEMENTARY = (-1.0, 1.0, False)
    """T_o = I - S_o."""
    BALANCED = (2.0, -1.0, False)
    """S - T = 2 S_o - I, whose structured singular value gives the disk margin."""
    CONTROL = (1.0, 0.0, True)
    """K S_o."""


@dataclass(frozen=True)
class ResponseMeasure(Measure):
    """Excess ``log(weight * peak over frequency of the gain over its bound)`` of each loop.

    Parameters
    ----------
    name : str
        Name of the limit.
    response : LoopResponse
        The response.
    bound : Bound
        Largest allowed gain over frequency.
    structured : bool
        Whether the gain is the structured singular value of independent channels, else the largest singular value.
    channel : int, optional
        The only channel, from and to which the response is taken; all by default.
    weight : float
        Weight.
    """

    stable_only = True
    name: str
    response: LoopResponse
    bound: Bound
    structured: bool = False
    channel: int | None = None
    weight: float = 1.0

    def excess(self, state: LoopState) -> FloatArray:
        """Return the excess of the highest peak of each loop."""
        peaks = self._peaks(state)
        highest = np.zeros(len(state.family))
        np.maximum.at(highest, peaks.loop, peaks.value)
        return np.asarray(np.log(self.weight * np.maximum(highest, 1e-300)))

    def pieces(self, state: LoopState, window: float) -> Pieces:
        """Return the peaks near the limit as smooth pieces with gradients."""
        peaks = self._peaks(state)
        keep = self.weight * peaks.value > np.exp(-window)
        loop, place, value = peaks.loop[keep], peaks.frequency[keep], peaks.value[keep]
        whole = self._of_response(state.derivatives, state.family.n_outputs)
        assert isinstance(whole, Derivatives)
        derivatives = whole.of(loop)
        if self.structured:
            derivatives = self._scaled(derivatives, place)
        slopes, gains = peak_slopes(derivatives, slice(None), Peaks(np.arange(len(loop)), place, value))
        gradient = slopes / gains[:, None]
        return Pieces(loop, np.log(self.weight * value), gradient, place.astype(complex) * 1j)

    def curvature(self, state: LoopState, loop: IntArray, place: ComplexArray) -> FloatArray:
        """Return second derivatives (k, d, d) of peaks of the largest singular value, which move over frequency."""
        if self.structured:
            return super().curvature(state, loop, place)
        whole, w = self._of_response(state.derivatives, state.family.n_outputs), place.imag
        assert isinstance(whole, Derivatives)
        second = peak_curvature(whole, slice(None), loop, w, state.family.bend(state.gains, state.steps))
        # f = max over w: f_xx - f_xw f_wx / f_ww, the last two by differences
        sides = [peak_slopes(whole, slice(None), Peaks(loop, at, at)) for at in (0.9999 * w, w, 1.0001 * w)]
        low, top, high = (np.log(size) for _, size in sides)
        mixed = (sides[2][0] / sides[2][1][:, None] - sides[0][0] / sides[0][1][:, None]) / 2
        moves = np.flatnonzero((low + high - 2 * top < -1e-14) & (w > 0))
        bend = (low + high - 2 * top)[moves, None, None]
        second[moves] -= mixed[moves, :, None] * mixed[moves, None] / bend
        return second

    def _peaks(self, state: LoopState) -> Peaks:
        if self not in state.computed:
            state.computed[self] = self._found(state)
        return state.computed[self]  # type: ignore[no-any-return]

    def _found(self, state: LoopState) -> Peaks:
        T = state.family.sample_time

        def size(responses: ComplexArray, frequency: FloatArray) -> FloatArray:
            gains = (structured_singular_values if self.structured else largest_singular_values)(responses)
            return np.asarray(gains / self.bound.of_hz(true_frequencies(frequency, T) / (2 * np.pi)))

        loops = self._of_response(state.loops, state.family.n_outputs)
        if self.structured or not self.bound.constant:
            return find_peaks(loops, state.system, slice(None), self._places(state), size)
        limit = float(self.bound.of_hz(np.zeros(1))[0])
        enough = limit / self.weight * float(np.exp(min(state.enough, 300.0)))
        peaks = exact_peaks(loops, state.system, enough)
        return replace(peaks, value=peaks.value / limit)

    def _places(self, state: LoopState) -> tuple[IntArray, FloatArray]:
        """Return loops and frequencies at which the search for peaks starts: of the bound, and around modes."""
        T, m = state.family.sample_time, len(state.family)
        true = 2 * np.pi * self.bound.places_hz
        frequencies = searched_frequencies(true if T is None else true[true < 0.999 * np.pi / T], T)
        loop, which = np.nonzero(state.system.values.imag > 0)
        modes = around(state.system.values[loop, which])
        loops = np.concatenate([np.repeat(np.arange(m), len(frequencies)), np.repeat(loop, modes.shape[1])])
        return loops, np.concatenate([np.tile(frequencies, m), modes.ravel()])

    def _of_response(self, loops: Loops, n_outputs: int) -> Loops:
        """Return the loops with this response as their only output."""
        factor, unit, control = self.response.value
        rows = slice(n_outputs, None) if control else slice(0, n_outputs)
        columns = slice(None)
        if self.channel is not None:
            at = self.channel + (n_outputs if control else 0)
            rows, columns = slice(at, at + 1), slice(self.channel, self.channel + 1)
        n_rows = loops.D[0][rows].shape[0]
        D = factor * loops.D[..., rows, :] + unit * np.eye(n_rows, loops.D.shape[-1], k=self.channel or 0)
        changed = replace(loops, C=factor * loops.C[..., rows, :], D=D[..., columns], B=loops.B[..., columns])
        if isinstance(changed, Derivatives):
            n, (left, right) = changed.A.shape[-1], (changed.left, changed.right)
            left = np.concatenate([left[:, :n], factor * left[:, n:][:, rows]], axis=1)
            right = np.concatenate([right[..., :n], right[..., n:][..., columns]], axis=2)
            return replace(changed, left=left, right=right)
        return changed

    @staticmethod
    def _scaled(loops: Derivatives, frequency: FloatArray) -> Derivatives:
        """Return 2 x 2 responses, scaled so that both off-diagonal entries have equal magnitude.

        The largest singular value is then the structured one, with the same gradient; see `structured_singular_values`.
        """
        if loops.D.shape[-1] != 2:
            return loops
        M = direct_response(loops.A, loops.B, loops.C, loops.D, frequency[:, None])[:, 0]
        ratio = np.sqrt((np.abs(M[:, 1, 0]) + 1e-300) / (np.abs(M[:, 0, 1]) + 1e-300)).clip(1e-6, 1e6)
        n, left = loops.A.shape[-1], np.stack([ratio, np.ones(len(ratio))], axis=1)[:, :, None]
        right, states = 1 / left.transpose(0, 2, 1), np.ones((len(ratio), n, 1))
        return replace(
            loops,
            B=loops.B * right,
            C=loops.C * left,
            D=loops.D * left * right,
            left=loops.left * np.concatenate([states, left], axis=1),
            right=loops.right * np.concatenate([states.swapaxes(1, 2), right], axis=2),
        )


@dataclass(frozen=True)
class ResponseGoal(Wanted):
    """Base of the goals on the largest singular value of a response over frequency.

    Parameters
    ----------
    limit : float, sequence of (frequency_hz, limit), or LinearModel
        One limit for all frequencies, breakpoints between which the limit is straight in logarithmic axes, or a model
        whose gain is the limit.
    soft, weight
        See `Wanted`.
    """

    limit: BoundLike
    response: ClassVar[LoopResponse]
    label: ClassVar[str]

    def __post_init__(self) -> None:
        super().__post_init__()
        bound_over_frequency(self.limit, f"{type(self).__name__}: limit")

    def measure(self, plant: LinearModel) -> ResponseMeasure:
        """Return the `Measure` of the largest singular value."""
        bound = bound_over_frequency(self.limit, type(self).__name__)
        return ResponseMeasure(f"{self.label} over frequency", self.response, bound, weight=self.weight)


@dataclass(frozen=True)
class PeakSensitivity(ResponseGoal):
    """Largest singular value of the output sensitivity S_o.

    Parameters
    ----------
    limit, soft, weight
        See `ResponseGoal`.
    """

    response = LoopResponse.SENSITIVITY
    label = "S_o"
    native = "peak_sensitivity"


@dataclass(frozen=True)
class PeakControl(ResponseGoal):
    """Largest singular value of the control effort K S_o [m/m].

    Parameters
    ----------
    limit, soft, weight
        See `ResponseGoal`.
    """

    response = LoopResponse.CONTROL
    label = "K S_o"
    native = "peak_control"


@dataclass(frozen=True)
class PeakComplementary(ResponseGoal):
    """Largest singular value of the complementary sensitivity T_o = I - S_o.

    Parameters
    ----------
    limit, soft, weight
        See `ResponseGoal`.
    """

    response = LoopResponse.COMPLEMENTARY
    label = "T_o"


@dataclass(frozen=True)
class RollOff(Wanted):
    """Control effort K S_o with a bound that falls above a frequency, over three decades or to half the sampling rate.

    Parameters
    ----------
    from_hz : float
        Frequency from which the limit holds [Hz].
    level : float
        Largest singular value of K S_o there [m/m].
    slope_db : float
        Fall of the limit above it [dB per decade].
    soft, weight
        See `Wanted`.
    """

    from_hz: Positive
    level: Positive
    slope_db: Annotated[NotNegative, Le(200), Allowed("0 to 200 dB per decade")] = 20.0

    def measure(self, plant: LinearModel) -> ResponseMeasure:
        """Return the `Measure` of the control effort above the frequency."""
        places = self.from_hz * (1 + 1e-9) * np.geomspace(1.0, 1e3, 25)
        bound = Bound(self._bound, places)
        return ResponseMeasure("roll-off of K S_o", LoopResponse.CONTROL, bound, weight=self.weight)

    def _bound(self, hz: FloatArray) -> FloatArray:
        over = np.maximum(hz, self.from_hz) / self.from_hz
        return np.where(hz >= self.from_hz, self.level * over ** (-self.slope_db / 20), 1e300)


@dataclass(frozen=True)
class StaticAmplification(Wanted):
    """Largest singular value of S_o at zero frequency: the amplification of a steady disturbance of p.

    Parameters
    ----------
    limit : float
        Largest allowed gain.
    soft, weight
        See `Wanted`.
    """

    limit: Positive
    native = "static_amplification"

    def measure(self, plant: LinearModel) -> ResponseMeasure:
        """Return the `Measure` of S_o at zero frequency."""

        def at_rest(hz: FloatArray) -> FloatArray:
            return np.where(hz == 0, self.limit, 1e300)

        return ResponseMeasure(
            "static amplification", LoopResponse.SENSITIVITY, Bound(at_rest, np.zeros(0)), weight=self.weight
        )


@dataclass(frozen=True)
class MinDiskMargin(Wanted):
    r"""Smallest disk margin alpha, of all loops together or of each loop alone.

    A loop with alpha tolerates gains times ``(2 - alpha)/(2 + alpha)`` to the inverse of it, and phases of
    ``2 arctan(alpha / 2)``; see `gbid.control.disk_margin`.

    Parameters
    ----------
    alpha : float
        Smallest allowed size of the disk.
    channel : int, optional
        Loop that is changed alone; all together by default.
    soft, weight
        See `Wanted`.
    """

    alpha: Annotated[Positive, Lt(2), Allowed("a number between 0 and 2")]
    channel: int | None = None

    def measure(self, plant: LinearModel) -> ResponseMeasure:
        """Return the `Measure` of the disk margin."""
        n = len(plant.C)
        if self.channel is not None and self.channel not in range(n):
            raise UsageError(
                f"MinDiskMargin: channel = {self.channel!r}; choose from the {n} channels, numbered from 0"
            )
        name = "disk margin" if self.channel is None else f"disk margin of {plant.output_names[self.channel]}"
        bound = bound_over_frequency(2 / self.alpha, "MinDiskMargin")
        return ResponseMeasure(name, LoopResponse.BALANCED, bound, True, self.channel, self.weight)


@dataclass(frozen=True)
class AxisSensitivity(ResponseGoal):
    """Peak of the sensitivity ``|S_ii|`` of each measured axis with all other axes closed, as in ISO 14839-3.

    Zone A of ISO 14839-3 is ``AxisSensitivity(gbid.control.ISO_LIMITS["A"])``.

    Parameters
    ----------
    limit, soft, weight
        See `ResponseGoal`.
    """

    response = LoopResponse.SENSITIVITY
    label = "sensitivity of an axis"

    def measures(self, plant: LinearModel) -> tuple[ResponseMeasure, ...]:
        """Return one `Measure` for each axis.

        Parameters
        ----------
        plant : LinearModel
            A plant of the design.
        """
        common = self.measure(plant)
        return tuple(
            replace(common, name=f"sensitivity of {name}", channel=i) for i, name in enumerate(plant.output_names)
        )


# ---- Goals on responses between any signals of plant and controller.


@dataclass(frozen=True)
class PathMeasure(ResponseMeasure):
    """Excess of a response between named signals, over all frequencies or at multiples of the speed.

    Parameters
    ----------
    path : Path
        Signals from and to which the response is taken.
    orders : tuple of float
        Multiples of the speed at which the response counts; empty for all frequencies.
    name, response, bound, weight
        See `ResponseMeasure`; the response is taken as it is (``SENSITIVITY``).
    """

    path: Path = field(kw_only=True)
    orders: tuple[float, ...] = ()

    def excess(self, state: LoopState) -> FloatArray:
        """Return the excess of each loop."""
        return super().excess(self._along(state))

    def pieces(self, state: LoopState, window: float) -> Pieces:
        """Return smooth pieces: the peaks near the limit, or the responses at multiples of the speed."""
        return super().pieces(self._along(state), window)

    def curvature(self, state: LoopState, loop: IntArray, place: ComplexArray) -> FloatArray:
        """Return second derivatives (k, d, d) of pieces."""
        return super().curvature(self._along(state), loop, place)

    def _along(self, state: LoopState) -> LoopState:
        assert isinstance(state.family, ControlLoops)
        if self.path not in state.computed:
            family = state.family.along(self.path)
            loops = family.matrices(state.gains)
            system = state.system if np.array_equal(loops.A, state.loops.A) else None
            state.computed[self.path] = replace(state, family=family, loops=loops, known_system=system)
        return state.computed[self.path]  # type: ignore[no-any-return]

    def _found(self, state: LoopState) -> Peaks:
        if not self.orders:
            return super()._found(state)
        assert state.family.points is not None
        speed = state.family.points[:, 1]
        if not speed.any():
            raise UsageError(f"PeakResponse: orders = {self.orders} of plants at rest; give speeds_rpm= to tune")
        hz = np.abs(speed[:, None]) / 60 * np.asarray(self.orders)
        response = ModalResponse(state.loops, state.system, slice(None))(2 * np.pi * hz)
        gains = largest_singular_values(response) / self.bound.of_hz(hz)
        loop = np.repeat(np.arange(len(hz)), len(self.orders))
        return Peaks(loop, 2 * np.pi * hz.ravel(), gains.ravel())


@dataclass(frozen=True)
class PathGoal(Wanted):
    """Base of the goals on a response between named signals.

    Sources are inputs of the plant and measured outputs. An input that the controller drives has the disturbance added
    to the reference, a measured output as in S_o, where the disturbed output is the target. Targets are outputs of the
    plant and references of the controller, by the names of the inputs it drives. A linear model may have inputs and
    outputs beside those of the controller (``inputs=`` and ``outputs=`` of `gbid.tune`): forces, currents, other
    planes. An LPV model has forces f_x and f_y on the rotor [N] (per mass [m/s^2] if its moving mass is not known).
    For a sampled loop the response is that of the continuous loop with the delay of sampling and computation.

    Parameters
    ----------
    sources, targets : tuple of str
        Names of the signals.
    soft, weight
        See `Wanted`.
    """

    sources: Annotated[tuple[str, ...], Allowed("names of signals")]
    targets: Annotated[tuple[str, ...], Allowed("names of signals")]

    @property
    def path(self) -> Path:
        """Names of the signals from and to which the response is taken.

        Raises
        ------
        UsageError
            When there is none on one side, or one twice.
        """
        path = Path(tuple(self.sources), tuple(self.targets))
        if not all(side and len(set(side)) == len(side) for side in path):
            raise UsageError(f"{type(self).__name__}: sources = {path[0]}, targets = {path[1]}; give each name once")
        return path

    def title(self, what: str) -> str:
        """Return the name of the limit."""
        return f"{what} from {', '.join(self.path.sources)} to {', '.join(self.path.targets)}"


@dataclass(frozen=True)
class PeakResponse(PathGoal):
    """Largest singular value of the response from some signals to others, such as a compliance.

    The dynamic stiffness is at least k where the compliance is at most 1/k. With an unbalance U [kg m] the amplitude is
    at most a [m] where the compliance is at most ``a / (U (2 pi f)^2)``, which two breakpoints give exactly. The slew
    rate of a current under a force F is at most s where the response is at most ``s / (2 pi f F)``. Its voltage is at
    most V where the response is at most the gain of the model ``V / (F (R + s L))``.

    Parameters
    ----------
    sources, targets : tuple of str
        See `PathGoal`.
    limit : float, sequence of (frequency_hz, limit), or LinearModel
        See `ResponseGoal`, in units of the targets over those of the sources.
    low_hz, high_hz : float
        Band of frequencies in which the limit holds [Hz].
    orders : tuple of float
        Multiples of the speed of rotation at which alone the limit holds, such as ``(1.0, 2.0)``. Linear models have
        the speeds of ``speeds_rpm=`` of `gbid.tune`.
    soft, weight
        See `Wanted`.
    """

    limit: BoundLike
    low_hz: NotNegative = 0.0
    high_hz: Number = inf
    orders: tuple[Annotated[Positive, Allowed("positive multiples of the speed")], ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        self.measure(None)

    def measure(self, plant: LinearModel | None) -> PathMeasure:
        """Return the `Measure` of the response."""
        bound = bound_over_frequency(self.limit, "PeakResponse: limit")
        edges = np.array([self.low_hz * (1 + 1e-9), self.high_hz * (1 - 1e-9)])
        places = np.union1d(bound.places_hz, edges[(edges > 0) & (edges < np.inf)])
        within = Bound(lambda hz: np.where((hz >= self.low_hz) & (hz <= self.high_hz), bound.of_hz(hz), 1e300), places)
        within = bound if (self.low_hz, self.high_hz) == (0.0, inf) else within
        return PathMeasure(
            self.title("response"),
            LoopResponse.SENSITIVITY,
            within,
            weight=self.weight,
            path=self.path,
            orders=tuple(self.orders),
        )


@dataclass(frozen=True)
class RmsResponse(PathGoal):
    """Rms of some signals under a spectrum of other signals, for example of positions under a force.

    Parameters
    ----------
    sources, targets : tuple of str
        See `PathGoal`.
    limit : float
        Largest allowed rms, in units of the targets.
    spectrum : DisturbanceSpectrum
        Spectral density of the sources, in their units squared per Hz.
    soft, weight
        See `Wanted`.
    """

    limit: Positive
    spectrum: Annotated[DisturbanceSpectrum, Allowed("DisturbanceSpectrum(frequency_hz, density)")]

    def measure(self, plant: LinearModel) -> ExtraLimit:
        """Return the `Measure` of the rms value."""
        if (n := self.spectrum.density.shape[1]) != len(self.path.sources):
            raise UsageError(f"RmsResponse: the spectrum has {n} channels for {len(self.path.sources)} sources")
        return ExtraLimit(self.title("rms"), rms_under(self.spectrum, path=self.path), self.limit / self.weight)


# ---- Goals on the classical margins of each loop: gain and phase.

_PER_DECADE = 80
_STEPS = np.linspace(0.0, 1.0, 9)
_RIDDERS = 8
"""Number of steps of two evaluations each; they halve an interval of 3 % and find a smooth crossing to 1e-12."""
_NONE = 1e-6
"""Share of a margin that is used up where a loop has no crossing."""


class _Crossings(NamedTuple):
    """Crossings (k,): loop, channel, frequency in the plane of the search [rad/s], used share of the margin."""

    loop: IntArray
    channel: IntArray
    frequency: FloatArray
    share: FloatArray


@dataclass(frozen=True)
class MarginMeasure(Measure):
    """Excess ``log(weight * share)`` of the share of a margin that each loop alone uses, with exact gradients.

    Parameters
    ----------
    name : str
        Name of the limit.
    required : float
        Logarithm of the gain, or phase [rad], that must be tolerated.
    is_phase : bool
        Whether it is the phase margin, at ``|L| = 1``; else the gain margin, where L is real.
    weight : float
        Weight.
    """

    name: str
    required: float
    is_phase: bool
    weight: float

    def excess(self, state: LoopState) -> FloatArray:
        """Return the excess of each loop."""
        shares, crossings = np.full(len(state.family), _NONE), self._crossings(state)
        np.maximum.at(shares, crossings.loop, crossings.share)
        return np.asarray(np.log(self.weight * shares))

    def pieces(self, state: LoopState, window: float) -> Pieces:
        """Return the crossings near the limit as smooth pieces with gradients."""
        every = self._crossings(state)
        loop, channel, w, share = (part[self.weight * every.share > np.exp(-window)] for part in every)
        near, row = state.derivatives.of(loop), np.arange(len(loop))
        resolvent = np.linalg.inv(1j * w[:, None, None] * np.eye(near.A.shape[-1]) - near.A)
        v = (resolvent @ near.B[row, :, channel, None])[..., 0]
        u = (near.C[row, None, channel] @ resolvent)[:, 0]
        S = np.einsum("kn,kn->k", near.C[row, channel], v) + near.D[row, channel, channel]
        outputs, inputs = (np.eye(size)[channel] for size in near.D.shape[1:])
        dS = near.along(row, np.hstack([u, outputs]), np.hstack([v, inputs]))
        L, dL, dL_dw = 1 - 1 / S, dS / S[:, None] ** 2, -1j * np.einsum("kn,kn->k", u, v) / S**2
        # the crossing moves along the frequency with the gains; at rest L stays real
        moved, along = ((part / L[:, None]).real if self.is_phase else part.imag for part in (dL, dL_dw[:, None]))
        with np.errstate(divide="ignore", invalid="ignore"):
            total = dL + dL_dw[:, None] * np.where((w > 0)[:, None] & (along != 0), -moved / along, 0.0)
            relative = total / L[:, None]
            slope = (
                relative.imag / np.angle(L)[:, None] if self.is_phase else relative.real / np.log(np.abs(L))[:, None]
            )
        slope = np.where(np.isfinite(slope), -slope, 0.0)
        return Pieces(loop, np.log(self.weight * share), slope, 1j * w)

    def _crosses(self, L: ComplexArray) -> FloatArray:
        """Return a function of the loop gain that is zero at a crossing."""
        return np.asarray(np.abs(L) - 1 if self.is_phase else L.imag)

    def _share(self, L: ComplexArray) -> FloatArray:
        """Return the share of the margin that is used at a crossing."""
        if self.is_phase:
            return np.asarray(self.required / np.maximum(np.abs(np.angle(L)), 1e-9))
        tolerated = np.abs(np.log(np.maximum(np.abs(L), 1e-12)))
        return np.where(L.real > 0, self.required / np.maximum(tolerated, 1e-9), _NONE)

    def _crossings(self, state: LoopState) -> _Crossings:
        """Return the crossings of all channels."""
        parts = [self._of_channel(state, channel) for channel in range(state.family.n_outputs)]
        return _Crossings(*(np.concatenate(part) for part in zip(*parts, strict=True)))

    def _of_channel(self, state: LoopState, channel: int) -> _Crossings:
        """Return the crossings of one channel, found by iteration; a crossing at zero frequency is included."""
        loops, system = state.loops, state.system
        response = ModalResponse(loops, system, slice(0, state.family.n_outputs))

        def gain(which: IntArray, w: FloatArray) -> ComplexArray:
            # opened at this channel, with the others closed: L = 1 - 1 / S_ii
            return np.asarray(1 - 1 / response(w, which)[..., channel, channel])

        m = len(state.family)
        base = base_frequencies(system.values, _PER_DECADE)
        # with modes of the loop opened at this channel, near which its gain has its peaks
        modes = np.concatenate([system.values, _opened(loops, channel)], axis=1)
        near = around(modes).reshape(m, -1)
        frequencies = np.sort(
            np.concatenate([np.abs(modes), np.abs(modes.imag), near, np.tile(base[1:], (m, 1))], 1), axis=1
        )
        loop, low, high, sign = _intervals(frequencies, lambda which, w: self._crosses(gain(which, w)))
        w = _roots(lambda at: sign * self._crosses(gain(loop, at[:, None])[:, 0]), low, high)
        # at zero frequency the loop gain is real, which limits the gain as well; rounding may give it an imaginary part
        rest = gain(np.arange(m), np.zeros((m, 1)))[:, 0].real.astype(complex)
        real = np.flatnonzero(np.abs(self._crosses(rest)) <= 1e-9 * np.abs(rest))
        values = np.concatenate([gain(loop, w[:, None])[:, 0], rest[real]])
        loop, w = np.concatenate([loop, real]), np.concatenate([w, np.zeros(len(real))])
        return _Crossings(loop, np.full(len(loop), channel), w, self._share(values))


@dataclass(frozen=True)
class MinGainMargin(Wanted):
    """Gain margin of each loop alone: it must be stable for gains from ``1 / factor`` to ``factor``.

    Parameters
    ----------
    factor : float
        Gain margin, above 1.
    soft, weight
        See `Wanted`; the quantity is the share ``log(factor) / log(gain margin)``.
    """

    factor: Annotated[Finite, Gt(1)]

    def measure(self, plant: LinearModel) -> MarginMeasure:
        """Return the `Measure` of the gain margin."""
        return MarginMeasure("gain margin", float(np.log(self.factor)), False, self.weight)


@dataclass(frozen=True)
class MinPhaseMargin(Wanted):
    """Phase margin of each loop alone, for phase lag and phase lead.

    Parameters
    ----------
    degrees : float
        Phase margin [degrees], between 0 and 180.
    soft, weight
        See `Wanted`; the quantity is the share ``degrees / phase margin``.
    """

    degrees: Annotated[Positive, Lt(180), Allowed("a number between 0 and 180")]

    def measure(self, plant: LinearModel) -> MarginMeasure:
        """Return the `Measure` of the phase margin."""
        return MarginMeasure("phase margin", radians(self.degrees), True, self.weight)


def _roots(value_at: Callable[[FloatArray], FloatArray], low: FloatArray, high: FloatArray) -> FloatArray:
    """Return the falling zero of a function between each pair of ends (k,), by Ridders's method."""
    at_low, at_high, x = value_at(low), value_at(high), (low + high) / 2
    for _ in range(_RIDDERS if len(low) else 0):
        middle = (low + high) / 2
        at_middle = value_at(middle)
        root = np.sqrt(np.maximum(at_middle**2 - at_low * at_high, 1e-300))
        x = np.clip(middle + (middle - low) * at_middle / root, low, high)
        at_x = value_at(x)
        for place, value in ((middle, at_middle), (x, at_x)):
            before, after = (value > 0) & (place > low), (value <= 0) & (place < high)
            low, at_low = np.where(before, place, low), np.where(before, value, at_low)
            high, at_high = np.where(after, place, high), np.where(after, value, at_high)
    return x


def _intervals(
    grid: FloatArray, value_at: Callable[[IntArray, FloatArray], FloatArray]
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Return the intervals in which a function of frequency crosses zero: loop, ends, and sign at the lower end.

    Where it turns back between neighbours of the grid, beyond zero, it crosses twice.
    """
    value = value_at(np.arange(len(grid)), grid)
    side, size = np.sign(value), np.abs(value)
    loop, k = np.nonzero(side[:, 1:] * side[:, :-1] < 0)
    crossings = loop, grid[loop, k], grid[loop, k + 1], side[loop, k]
    turns = (size[:, 1:-1] <= size[:, :-2]) & (size[:, 1:-1] <= size[:, 2:])
    loop, k = np.nonzero(turns & (side[:, 1:-1] == side[:, :-2]) & (side[:, 1:-1] == side[:, 2:]))
    if not len(loop):
        return crossings
    first, last, before, row = grid[loop, k], grid[loop, k + 2], side[loop, k], np.arange(len(loop))
    low, high, top = first, last, first
    for _ in range(4):
        points = low[:, None] + (high - low)[:, None] * _STEPS
        at = np.clip((before[:, None] * value_at(loop, points)).argmin(axis=1), 1, len(_STEPS) - 2)
        low, top, high = points[row, at - 1], points[row, at], points[row, at + 1]
    beyond = before * value_at(loop, top[:, None])[:, 0] < 0
    first, top, last, before = first[beyond], top[beyond], last[beyond], before[beyond]
    return (
        np.concatenate([crossings[0], loop[beyond], loop[beyond]]),
        np.concatenate([crossings[1], first, top]),
        np.concatenate([crossings[2], top, last]),
        np.concatenate([crossings[3], before, -before]),
    )


def _opened(loops: Loops, channel: int) -> ComplexArray:
    """Return the eigenvalues of the loops opened at a channel (m, n): the zeros of its S_ii."""
    direct = loops.D[:, channel, channel][:, None, None]
    back = loops.B[:, :, channel, None] @ loops.C[:, None, channel]
    return np.asarray(np.linalg.eigvals(loops.A - back / np.where(np.abs(direct) > 1e-9, direct, np.inf)), complex)


# ---- Goal on the travel of the piezo stacks after an impact.

UNSTABLE = 1e3
"""Travel that is assigned to an unstable loop, over the limit."""
_AFTER_S = 0.05
_STEP_S = 1e-4
_ZOOM = np.linspace(-1.0, 1.0, 17)


@dataclass(frozen=True)
class PiezoTravel(Wanted):
    """Motion of every stack after an impact in x and in y: at most half its travel to each side.

    Parameters
    ----------
    impact : HalfSine
        The impact. Without a mass it takes that of the LPV model.
    travel_m : float, optional
        Whole travel of a stack [m]; by default that of the LPV model.
    soft, weight
        See `Wanted`.
    """

    impact: Annotated[HalfSine, Allowed("a HalfSine")] = field(default_factory=HalfSine)
    travel_m: Positive | None = None

    def on(self, machine: MachineData) -> PiezoTravel:
        """Return this goal with the moving mass and travel of a machine if the goal has none."""
        travel = machine.piezo_travel_m if self.travel_m is None else self.travel_m
        return replace(self, impact=self.impact.on(machine), travel_m=travel)

    def measure(self, plant: LinearModel) -> ExtraLimit:
        """Return the `Measure` of the stack motion; all plants have an equal force input.

        Raises
        ------
        UsageError
            When the moving mass or the travel is not known.
        """
        if self.travel_m is None:
            raise UsageError("PiezoTravel: the travel of a stack is not known; give travel_m")
        entry, limit = force_entry(plant) * self.impact.peak_per_mass, self.travel_m / 2

        def largest(family: LoopFamily, gains: FloatArray) -> FloatArray:
            # of sampled loops the continuous ones with the delay of sampling
            loops = (getattr(family, "companion", None) or family).matrices(gains)
            # the states of the plant come first in every loop; the force does not act on the controller
            E = np.vstack([entry, np.zeros((loops.A.shape[1] - len(entry), entry.shape[1]))])
            system = Eigensystem.of(loops.A)
            stable = (system.values.real < 0).all(axis=1)
            peaks = np.full(len(family), UNSTABLE * limit)
            if stable.any():
                to_r = loops.C[stable, family.n_outputs :] @ system.right[stable]
                reached = _peaks(system.values[stable], to_r, system.left[stable] @ E, self.impact.duration_s)
                peaks[stable] = np.minimum(reached, UNSTABLE * limit)
            return np.asarray(np.maximum(peaks, 1e-12))

        return ExtraLimit("piezo travel", largest, limit / self.weight)


def _peaks(values: ComplexArray, outputs: ComplexArray, inputs: ComplexArray, length: float) -> FloatArray:
    """Return the largest ``|r|`` of each loop over both stacks and directions: (m,)."""
    m, n = values.shape
    weights = (outputs[:, None] * inputs.transpose(0, 2, 1)[:, :, None]).reshape(m, -1, n)  # (m, direction x stack, n)
    n_during = max(20, int(np.ceil(length / _STEP_S)))
    after = np.arange(_STEP_S, _AFTER_S, _STEP_S)
    time = np.concatenate([np.linspace(0.0, length, n_during + 1), length + after])
    r = np.abs((weights @ _modes(values[:, :, None], time, length)).real)
    best, place = r.max(axis=2), time[r.argmax(axis=2)]
    step = max(_STEP_S, length / n_during)
    for _ in range(3):
        at = np.clip(place[:, :, None] + step * _ZOOM, 0.0, time[-1])
        sizes = np.abs((weights[:, :, None] @ _modes(values[:, None, :, None], at[:, :, None], length)).real[:, :, 0])
        best, top = np.maximum(best, sizes.max(axis=2)), sizes.argmax(axis=2)
        place, step = np.take_along_axis(at, top[:, :, None], axis=2)[:, :, 0], step / 8
    return np.asarray(best.max(axis=1))


def _modes(values: ComplexArray, time: FloatArray, length: float) -> ComplexArray:
    r"""Return the modal solution of :math:`\dot z = \lambda z + \sin(\pi t / T)` up to T, then of the free motion."""
    w = pi / length
    during, later = np.minimum(time, length), np.maximum(time - length, 0.0)
    forced = w * (np.exp(values * during) - np.cos(w * during)) - values * np.sin(w * during)
    return np.asarray(np.exp(values * later) * forced / (values**2 + w**2))
