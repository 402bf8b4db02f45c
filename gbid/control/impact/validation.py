"""Validation of simulated impact responses, and identification of the force scale (paper, Sec. 5.1, Figs. 24 to 27)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from gbid.arrays import FloatArray
from gbid.brief import Brief
from gbid.control.impact.force_response import force_response
from gbid.control.impact.measured import MeasuredImpact, find_impacts, force_of, pulses_of
from gbid.control.impact.ringdown.basis import harmonics_for, quiet_basis
from gbid.control.impact.ringdown.coloured import MEMORY_S, autocovariance, sandwich
from gbid.errors import DataError
from gbid.hdf5 import Stored
from gbid.recording import Recording
from gbid.structure import LinearModel
from gbid.validate import fit_percent

_DIED_OUT = 0.01  # the response has decayed when the simulation is below this share of its largest value
_BEFORE = 25  # samples before an impact in a figure


@dataclass(frozen=True, eq=False)
class ImpactValidation(Brief):
    """Measured and simulated response, as `validate_impact` returns them.

    Attributes
    ----------
    force_scale : float
        g_f [1/kg], the inverse of the moving mass.
    force_scale_std : float
        Its standard deviation [1/kg], from residuals that are correlated in time and from the noise of the force.
    fit_percent : (2,) array
        ``100 (1 - |p - g_f p_s| / |p - mean p|)`` of x and y over the responses to the impacts, without offset and
        harmonics.
    along_percent : float
        Fit percent of the motion in the direction of the impacts.
    time : (n_samples,) array
        Time [s].
    measured : (n_samples, 2) array
        Measured position minus its offset, with unbalance and run-out [m].
    stationary : (n_samples, 2) array
        Part of it that is synchronous with the shaft [m]; zero at rest.
    simulated : (n_samples, 2) array
        ``g_f`` times the simulated response for a mass of 1 kg [m].
    force : (n_samples, 2) array
        Measured force [N].
    windows : tuple of (start, stop)
        Sample ranges of each impact with its response.
    impacts : tuple of MeasuredImpact
        Impacts in the recording.
    harmonics : int
        Number of estimated harmonics of the shaft angle.
    recording, loop : str
        Names of the recording and of the loop.
    """

    force_scale: float
    force_scale_std: float
    fit_percent: Annotated[FloatArray, Stored("%", "fit of simulated to measured response, x and y", "2")]
    along_percent: float
    time: Annotated[FloatArray, Stored("s", "time", "samples")]
    measured: Annotated[FloatArray, Stored("m", "position as measured, less its offset", "samples 2")]
    stationary: Annotated[FloatArray, Stored("m", "part of it that turns with the shaft", "samples 2")]
    simulated: Annotated[FloatArray, Stored("m", "simulated response, scaled", "samples 2")]
    force: Annotated[FloatArray, Stored("N", "measured force", "samples 2")]
    windows: Annotated[tuple[tuple[int, int], ...], Stored("1", "samples of each impact and the response to it")]
    impacts: tuple[MeasuredImpact, ...]
    harmonics: int
    recording: str
    loop: str

    @property
    def axis(self) -> str:
        """``"x"``, ``"y"``, or ``"xy"`` when there are impacts along both axes."""
        return "".join(sorted({impact.axis for impact in self.impacts}))

    def window(self, impact: int = 0) -> slice:
        """Return the samples of one impact for a figure, from a little before it until the response has decayed.

        Parameters
        ----------
        impact : int
            Number of the impact, from 0.
        """
        start, stop = self.windows[impact]
        return slice(max(0, start - _BEFORE), stop)


def validate_impact(
    recording: Recording,
    plant: LinearModel,
    controller: LinearModel | None = None,
    *,
    position: str = "p",
    force: str = "f",
    axis: str | None = None,
    harmonics: int | None = None,
    computation_s: float | None = None,
    entry: FloatArray | None = None,
) -> ImpactValidation:
    r"""Return the force scale, and measured and simulated impact responses (paper, Sec. 5.1).

    g_f is the linear least-squares factor between the measured response and the simulated response for a mass of 1
    kg, :math:`p = g_f\, G_b f` (Eq. 8) or :math:`p = g_f\, S_o G_b f`. An offset and, when the shaft turns, harmonics
    of its angle are estimated together with it.

    Parameters
    ----------
    recording : Recording
        Recording with position, force of the hammer and, when the shaft turns, its angle `phi`.
    plant : LinearModel
        Continuous plant, from r (or u) to p: `LPVModel.plant_at`, or `gbid.control.exact_plant` for a sampled
        controller.
    controller : LinearModel, optional
        Controller during the recording; open loop when not given. A continuous controller gives the loop of the
        paper, a sampled one (`gbid.control.sample_controller`) gives the sampled loop.
    position, force : str
        Names of the signals.
    axis : {"x", "y"}, optional
        Direction of a force with one channel.
    harmonics : int, optional
        Number of harmonics; by default 10 when the shaft turns.
    computation_s : float, optional
        Time from the sample of p to the change of r, for sampled controllers only [s]; one sample when not given.
    entry : (n, 2) array, optional
        Input matrix of a force per mass; from `gbid.control.force_entry` when not given.

    Returns
    -------
    ImpactValidation

    Raises
    ------
    DataError
        When the recording has no impact, or when a signal is missing or of another shape.
    UsageError
        When models do not fit together, or when the loop is unstable.
    """
    h, n = recording.sample_time, recording.n_samples
    f = force_of(recording, force, axis)
    p = recording.signal(position)
    if p.shape[1] != 2:
        raise DataError(f"recording {recording.name!r}: {position!r} has {p.shape[1]} channels; an impact needs two")
    impacts = find_impacts(f, h, recording.name)
    response = force_response(plant, controller, pulses_of(f, impacts), n, h, computation_s=computation_s, entry=entry)
    count = harmonics_for(recording, harmonics)
    basis = quiet_basis(recording, count)
    q, r = np.linalg.qr(basis)
    free = response - q @ (q.T @ response)
    energy = float((free**2).sum())
    g = float((free * p).sum()) / energy
    quiet = np.linalg.solve(r, q.T @ (p - g * response))
    simulated = g * response
    measured, stationary = p - quiet[0], basis[:, 1:] @ quiet[1:]
    residual = measured - stationary - simulated
    windows = _windows(response, impacts)
    rows = np.concatenate([np.arange(*window) for window in windows])
    moved, modelled = (measured - stationary)[rows], simulated[rows]
    angles = np.concatenate(
        [np.full(b - a, impact.direction_deg) for impact, (a, b) in zip(impacts, windows, strict=True)]
    )
    direction = np.column_stack([np.cos(np.deg2rad(angles)), np.sin(np.deg2rad(angles))])
    along = [(part * direction).sum(axis=1)[:, None] for part in (moved, modelled)]
    return ImpactValidation(
        g,
        _scale_std(g, free, residual, response, f, impacts, windows, h),
        fit_percent(moved, modelled),
        float(fit_percent(*along)[0]),
        np.asarray(recording.time),
        measured,
        stationary,
        simulated,
        f,
        windows,
        impacts,
        count,
        recording.name,
        "open loop" if controller is None else controller.name,
    )


def _windows(response: FloatArray, impacts: Sequence[MeasuredImpact]) -> tuple[tuple[int, int], ...]:
    """Return the samples from each impact until its response has decayed, or until the next impact."""
    size = np.hypot(*response.T)
    windows = []
    for impact, end in zip(impacts, [*(b.start for b in impacts[1:]), len(size)], strict=True):
        part = size[impact.start : end]
        loud = np.flatnonzero(part > _DIED_OUT * part.max())
        windows.append((impact.start, impact.start + int(loud[-1]) + 1))
    return tuple(windows)


def _scale_std(
    g: float,
    free: FloatArray,
    residual: FloatArray,
    response: FloatArray,
    force: FloatArray,
    impacts: Sequence[MeasuredImpact],
    windows: Sequence[tuple[int, int]],
    h: float,
) -> float:
    """Return the standard deviation of g_f from the residuals and from the noise of the force."""
    used = np.ones(len(free), dtype=bool)
    memory = autocovariance([residual], [used], round(MEMORY_S / h))
    from_position = float(sandwich([free[:, :, None]], memory)[0, 0]) / float((free**2).sum()) ** 2
    for impact in impacts:
        used[impact.start : impact.stop + 1] = False
    noise = float(np.sqrt(np.mean(force[used] ** 2)))
    energies = np.array([float((response[a:b] ** 2).sum()) for a, b in windows])
    impulses = np.array([np.hypot(*force[b.start : b.stop + 1].sum(axis=0)) for b in impacts])
    relative = noise * np.sqrt([b.stop - b.start + 1 for b in impacts]) / impulses
    from_force = g**2 * float((energies**2 * relative**2).sum()) / float(energies.sum()) ** 2
    return float(np.sqrt(from_position + from_force))
