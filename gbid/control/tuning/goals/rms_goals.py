"""Goals on the rms of position and reference under a measured disturbance (an H2 norm)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gbid.arrays import ComplexArray, FloatArray
from gbid.control.tuning.goals.disturbance import DisturbanceSpectrum
from gbid.control.tuning.goals.goal import DesignContext, Wanted, positive
from gbid.control.tuning.search.loop_family import LoopFamily
from gbid.control.tuning.search.measure import ExtraLimit
from gbid.control.tuning.search.peaks import respond
from gbid.control.tuning.search.plane import searched_frequencies
from gbid.control.tuning.search.spectrum import Eigensystem
from gbid.errors import UsageError

_LINES = 384
"""Number of frequencies at which a response is computed."""
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

    limit_m: float
    disturbance: DisturbanceSpectrum
    control: ClassVar[bool]
    label: ClassVar[str]

    def __post_init__(self) -> None:
        super().__post_init__()
        positive(self, limit_m=self.limit_m)
        if not isinstance(self.disturbance, DisturbanceSpectrum):
            raise UsageError(f"{type(self).__name__}: give disturbance=recorded_disturbance(...)")

    def measure(self, context: DesignContext) -> ExtraLimit:
        """Return the measure of this goal."""
        given = self.disturbance
        if given.density.shape[1] != len(context.plant.C):
            raise UsageError(
                f"{type(self).__name__}: the disturbance has {given.density.shape[1]} channels, the plant "
                f"{len(context.plant.C)} outputs"
            )
        hz, power = _lines(given)

        def rms(family: LoopFamily, gains: FloatArray) -> FloatArray:
            loops = family.matrices(gains)
            system = Eigensystem.of(loops.A)
            rows = slice(family.n_outputs, None) if self.control else slice(0, family.n_outputs)
            T = family.sample_time
            below = hz < (np.inf if T is None else 0.499 / T)
            w = searched_frequencies(2 * np.pi * hz[below], T)
            M = respond(loops, system, rows, np.arange(len(family)), np.tile(w, (len(family), 1)))
            squares = np.einsum("mkij,kjl,mkil->m", M, power[below], M.conj(), optimize=True).real
            return np.asarray(np.sqrt(np.maximum(squares, 1e-300)))

        return ExtraLimit(f"rms of {self.label}", rms, self.limit_m / self.weight)


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
    """Rms of the reference r, the motion that the piezos are asked for, under a measured disturbance.

    Parameters
    ----------
    limit_m, disturbance, soft, weight
        See `RmsGoal`.
    """

    control = True
    label = "r"


def _lines(given: DisturbanceSpectrum) -> tuple[FloatArray, ComplexArray]:
    """Return the middles of `_LINES` intervals [Hz] and the power in each (k, n, n).

    They are narrow where there is much power, and in proportion to the frequency, as resonances are. They do not follow
    the resonances of a loop: the rms would not be a smooth function of the gains.
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
    nodes = np.interp(np.linspace(0.0, share[-1], _LINES + 1), share, fine)
    return (nodes[1:] + nodes[:-1]) / 2, np.diff(_between(nodes, fine, below), axis=0)


def _between(hz: FloatArray, known: FloatArray, values: ComplexArray) -> ComplexArray:
    """Return values (k, n, n) at other frequencies, straight between the known ones."""
    k = np.clip(np.searchsorted(known, hz, side="right") - 1, 0, len(known) - 2)
    part = ((hz - known[k]) / (known[k + 1] - known[k]))[:, None, None]
    return np.asarray(values[k] + part * (values[k + 1] - values[k]))
