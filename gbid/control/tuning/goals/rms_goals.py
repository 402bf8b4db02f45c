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

_LINES = 256
"""Largest number of frequencies at which a response is computed; the spectrum is summed between them."""


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
        hz, power = _grouped(given)

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


def _grouped(given: DisturbanceSpectrum) -> tuple[FloatArray, ComplexArray]:
    """Return at most `_LINES` frequencies and the power around each of them, so that the variance stays the same."""
    power = given.widths[:, None, None] * given.density
    total = np.cumsum(np.einsum("kii->k", power).real)
    # groups of equal power or of equal width, whichever is finer
    share = total / max(float(total[-1]), 1e-300) + np.linspace(0, 1, len(total))
    group = np.minimum((share / 2 * _LINES).astype(int), _LINES - 1)
    names, start = np.unique(group, return_index=True)
    weight = np.maximum(np.einsum("kii->k", power).real, 1e-300)
    centre = np.add.reduceat(weight * given.frequency_hz, start) / np.add.reduceat(weight, start)
    assert len(names) == len(centre)
    return centre, np.add.reduceat(power, start, axis=0)
