"""Measure of a response over frequency: its peak over a bound, with exact gradients."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from gbid.arrays import ComplexArray, FloatArray
from gbid.control.loop.margins import structured_singular_values
from gbid.control.loop.norm import largest_singular_values
from gbid.control.tuning.goals.bound import Bound
from gbid.control.tuning.search.loop_family import Derivatives, Loops
from gbid.control.tuning.search.measure import LoopState, Measure, Pieces
from gbid.control.tuning.search.peaks import IntArray, Peaks, around, direct_response, find_peaks, peak_slopes
from gbid.control.tuning.search.plane import searched_frequencies, true_frequencies


class LoopResponse(Enum):
    """LoopResponse from a disturbance on p, as (factor on S_o, factor on the unit matrix, whether K S_o is meant)."""

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
        """Return the peaks near the limit."""
        peaks = self._peaks(state)
        keep = np.log(self.weight * peaks.value) > -window
        loop, place, value = peaks.loop[keep], peaks.frequency[keep], peaks.value[keep]
        whole = self._of_response(state.derivatives, state.family.n_outputs)
        assert isinstance(whole, Derivatives)
        own = whole.of(loop)
        if self.structured:
            own = self._scaled(own, place)
        slopes, gains = peak_slopes(own, slice(None), Peaks(np.arange(len(loop)), place, value))
        gradient = slopes / gains[:, None]
        return Pieces(loop, np.log(self.weight * value), gradient, place.astype(complex) * 1j)

    def _peaks(self, state: LoopState) -> Peaks:
        T = state.family.sample_time

        def size(responses: ComplexArray, frequency: FloatArray) -> FloatArray:
            gains = (structured_singular_values if self.structured else largest_singular_values)(responses)
            return np.asarray(gains / self.bound.of_hz(true_frequencies(frequency, T) / (2 * np.pi)))

        loops = self._of_response(state.loops, state.family.n_outputs)
        return find_peaks(loops, state.system, slice(None), self._places(state), size)

    def _places(self, state: LoopState) -> tuple[IntArray, FloatArray]:
        """Return loops and frequencies of the search at which peaks are looked for: of the bound, and around modes."""
        T, m = state.family.sample_time, len(state.family)
        true = 2 * np.pi * self.bound.places_hz
        own = searched_frequencies(true if T is None else true[true < 0.999 * np.pi / T], T)
        loop, which = np.nonzero(state.system.values.imag > 0)
        modes = around(state.system.values[loop, which])
        loops = np.concatenate([np.repeat(np.arange(m), len(own)), np.repeat(loop, modes.shape[1])])
        return loops, np.concatenate([np.tile(own, m), modes.ravel()])

    def _of_response(self, loops: Loops, n_outputs: int) -> Loops:
        """Return the loops with this response as their only outputs."""
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
            dC, dD = factor * changed.dC[..., rows, :], factor * changed.dD[..., rows, columns]
            return replace(changed, dB=changed.dB[..., columns], dC=dC, dD=dD)
        return changed

    @staticmethod
    def _scaled(loops: Derivatives, frequency: FloatArray) -> Derivatives:
        """Return 2 x 2 responses, each scaled so that its off-diagonal entries at its frequency have equal magnitude.

        The largest singular value is then the structured one, with the same gradient (margins.py).
        """
        if loops.D.shape[-1] != 2:
            return loops
        M = direct_response(loops.A, loops.B, loops.C, loops.D, frequency[:, None])[:, 0]
        ratio = np.sqrt((np.abs(M[:, 1, 0]) + 1e-300) / (np.abs(M[:, 0, 1]) + 1e-300)).clip(1e-6, 1e6)
        left = np.stack([ratio, np.ones(len(ratio))], axis=1)[:, :, None]
        right = 1 / left.transpose(0, 2, 1)
        return replace(
            loops,
            B=loops.B * right,
            C=loops.C * left,
            D=loops.D * left * right,
            dB=loops.dB * right[:, None],
            dC=loops.dC * left[:, None],
            dD=loops.dD * (left * right)[:, None],
        )
