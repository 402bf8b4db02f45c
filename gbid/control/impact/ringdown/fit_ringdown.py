r"""Modes of a rotor identified from its ring-down after impacts ("obtained experimentally" in Tables 3 and 4).

After an impact the disc moves freely. The model has two degrees of freedom, and decays without oscillation:

.. math::

    p(t) = q(t) + \sum_l R_l \int_{-\infty}^t \rho_l e^{-\rho_l (t - s)} f(s)\, ds
           + p_0 + \sum_n c_n \cos n\phi + s_n \sin n\phi, \quad \ddot q = K q + D \dot q

K, D and the lags are common to all impacts. Each impact has its own initial state. Each recording has its own offset
and, when the shaft turns, harmonics of the shaft angle. So unbalance and run-out are estimated together with the modes
and are not filtered out before (Figs. 26, 27).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.impact.measured import MeasuredImpact, find_impacts, force_of, pulses_of
from gbid.control.impact.ringdown.basis import RingData, Scale, harmonics_for, ring_data
from gbid.control.impact.ringdown.coloured import MEMORY_S, autocovariance, sandwich
from gbid.control.impact.ringdown.lags import fit_lags
from gbid.control.impact.ringdown.oscillations import oscillations
from gbid.control.impact.ringdown.ringdown_result import RingDown, RingDownStatus, two_modes
from gbid.control.impact.ringdown.separable import RingProblem, SeparableFit
from gbid.control.impact.ringdown.start import start_candidates
from gbid.errors import DataError, UsageError
from gbid.notes.control_notes import ControlNote
from gbid.recording import Recording


def fit_ringdown(
    recordings: Recording | Sequence[Recording],
    *,
    position: str = "p",
    force: str | tuple[()] = "f",
    axis: str | None = None,
    lags: int | str = "auto",
    harmonics: int | None = None,
    skip_s: float = 0.0,
    start: Sequence[tuple[float, float]] | None = None,
) -> RingDown:
    """Return two modes fitted to the free responses after impacts (paper, Sec. 5.1, Tables 3 and 4).

    A recording without a force, or with one that is zero throughout, is one free response from its first sample.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Recordings of one machine at one operating point. Impacts along x and along y together give the best accuracy.
    position, force : str
        Names of the signals: disc position of two channels [m], force of the hammer [N]. ``force=()`` for recordings of
        free decays, as ``inputs=()`` of `gbid.fit`.
    axis : {"x", "y"}, optional
        Direction of a force with one channel.
    lags : int or "auto"
        Number of decays without oscillation to fit besides the modes. In open loop there are none. A closed loop has
        those of actuators, low-pass and delays; a fit without them would overestimate the damping. ``"auto"`` chooses
        none or 3 by Schwarz's criterion (BIC), and with them up to two decays that oscillate: a loop with filters has
        more modes that ring than two. Free decays without a measured force have none.
    harmonics : int, optional
        Number of harmonics of the shaft angle `phi` to estimate; by default 10 when the shaft turns.
    skip_s : float
        Time after the end of an impact, or from the first sample of a free decay, that is left out [s].
    start : sequence of (frequency_hz, damping), optional
        Two modes as an additional start value.

    Returns
    -------
    RingDown
        When the fit does not converge, or when there are no two oscillations, `success` and `status` show it.

    Raises
    ------
    DataError
        When a force has no impact, too few samples follow one, or a signal is missing.
    UsageError
        When an argument is out of range.
    """
    group = [recordings] if isinstance(recordings, Recording) else list(recordings)
    _check_arguments(group, lags, harmonics, skip_s, start)
    h = group[0].sample_time
    forces = [_force(rec, force, axis) for rec in group]
    found = [() if f is None else find_impacts(f, h, rec.name) for rec, f in zip(group, forces, strict=True)]
    if not any(found):
        if lags not in ("auto", 0):
            raise UsageError(f"fit_ringdown: lags = {lags}; free decays have no force that acts through lags: give 0")
        lags = 0
    counts = [harmonics_for(rec, harmonics) for rec in group]
    data = tuple(
        ring_data(rec, position, impacts, () if f is None else pulses_of(f, impacts), count, round(skip_s / h))
        for rec, f, impacts, count in zip(group, forces, found, counts, strict=True)
    )
    unit = float(np.sqrt(np.mean([np.mean(_after(d) ** 2) for d in data])))
    if unit == 0:
        raise DataError(f"recording {group[0].name!r}: {position!r} does not move after the impacts; check the signal")
    data = tuple(replace(d, position=d.position / unit) for d in data)

    directions = tuple(i for i, word in enumerate("xy") if any(b.axis == word for impacts in found for b in impacts))

    def problems(rate: float) -> RingProblem:
        return RingProblem(data, Scale(rate, h), directions)

    problem, solved = fit_lags(problems, _guesses(data, h, start), lags)
    rms = _channel_rms(problem, solved)
    if (rms > 0).all():  # the noise of the channels differs: fit again with weights from the residuals
        problem = replace(problem, weights=float(np.sqrt(np.mean(rms**2))) / rms)
        solved = problem.solve(solved.theta)
        rms = _channel_rms(problem, solved)
    return _result(problem, solved, group, rms * unit, found, max(counts))


def _force(recording: Recording, force: str | tuple[()], axis: str | None) -> FloatArray | None:
    """Return the force, (n_samples, 2) [N]; None for a free decay."""
    if not force:
        return None
    return force_of(recording, force, axis) if recording.signal(force).any() else None


def _check_arguments(
    group: list[Recording],
    lags: int | str,
    harmonics: int | None,
    skip_s: float,
    start: Sequence[tuple[float, float]] | None,
) -> None:
    if not group:
        raise UsageError("fit_ringdown: no recording given; give at least one with an impact")
    if lags != "auto" and not (isinstance(lags, int) and 0 <= lags <= 6):
        raise UsageError(f"fit_ringdown: lags = {lags!r}; give a number from 0 to 6, or 'auto'")
    if harmonics is not None and harmonics < 0:
        raise UsageError(f"fit_ringdown: harmonics = {harmonics}; it must not be negative")
    if not (np.isfinite(skip_s) and skip_s >= 0):
        raise UsageError(f"fit_ringdown: skip_s = {skip_s} s; it must not be negative")
    if start is not None and (len(start) != 2 or any(f <= 0 or not abs(z) < 1 for f, z in start)):
        raise UsageError(f"fit_ringdown: start = {start}; give two modes (frequency in Hz, damping factor below 1)")
    for rec in group[1:]:
        if rec.sample_time != group[0].sample_time:
            raise UsageError(
                f"recordings {group[0].name!r} and {rec.name!r} are sampled at {group[0].sample_time} s and "
                f"{rec.sample_time} s; fit them apart"
            )


def _after(data: RingData) -> FloatArray:
    """Return the positions after the impacts, without offset and harmonics."""
    quiet = data.position - data.quiet @ (data.quiet.T @ data.position)
    return np.vstack([quiet[a:b] for a, b in data.segments])


def _guesses(
    data: tuple[RingData, ...], h: float, start: Sequence[tuple[float, float]] | None
) -> list[tuple[float, FloatArray]]:
    if start is None:
        return start_candidates(data, h, None)
    rate = 2 * np.pi * float(np.mean([f for f, _ in start]))
    K = [(2 * np.pi * f / rate) ** 2 for f, _ in start]
    D = [2 * z * 2 * np.pi * f / rate for f, z in start]
    own = np.array([K[0], 0, 0, K[1], D[0], 0, 0, D[1]])
    return [(rate, own), *start_candidates(data, h, rate)]


def _channel_rms(problem: RingProblem, solved: SeparableFit) -> FloatArray:
    """Return the rms residuals of x and y over all samples used."""
    squares = sum((r**2).sum(axis=0) for r in solved.at.residuals)
    return np.asarray(np.sqrt(squares * 2 / problem.n_values) / problem.weights)


def _covariance(problem: RingProblem, solved: SeparableFit) -> FloatArray:
    """Return the covariance of the parameters for correlated residuals."""
    slopes, residuals = solved.at.slopes, solved.at.residuals
    stacked = np.concatenate([s.reshape(-1, s.shape[-1]) for s in slopes])
    bread = np.linalg.pinv(stacked.T @ stacked, hermitian=True)
    memory = autocovariance(residuals, [d.used for d in problem.data], round(MEMORY_S / problem.scale.sample_time))
    return np.asarray(bread @ sandwich(slopes, memory) @ bread)


def _result(
    problem: RingProblem,
    solved: SeparableFit,
    group: list[Recording],
    rms: FloatArray,
    found: Sequence[Sequence[MeasuredImpact]],
    harmonics: int,
) -> RingDown:
    theta, scale, covariance = solved.theta, problem.scale, _covariance(problem, solved)
    K, D = -theta[:4].reshape(2, 2) * scale.rate**2, -theta[4:8].reshape(2, 2) * scale.rate
    modes = two_modes(theta, scale)
    spread = np.full((4, 4), np.nan)
    status = RingDownStatus.CONVERGED if solved.converged else RingDownStatus.NOT_CONVERGED
    if np.isnan(modes).any():
        status = RingDownStatus.NO_OSCILLATIONS
    else:
        steps = 1e-6 * np.eye(len(theta))
        slope = np.column_stack([(two_modes(theta + s, scale) - two_modes(theta - s, scale)) / 2e-6 for s in steps])
        spread = slope @ covariance @ slope.T
    std = np.sqrt(np.diag(spread))
    notes: tuple[str, ...] = (
        () if solved.converged else (ControlNote.SOLVER_STOPPED(f"the solver stopped: {solved.message}"),)
    )
    doubles = sum(impact.pulses > 1 for impacts in found for impact in impacts)
    if doubles:
        text = f"{doubles} double hit(s); the free response is taken from the end of the last pulse"
        notes = (*notes, ControlNote.DOUBLE_HIT(text))
    further = oscillations(problem)
    if len(further):
        words = ", ".join(f"{f:.0f} Hz with damping {z:.2f}" for f, z in further)
        text = f"the response rings in more than two modes; fitted beside them as decays at {words}"
        notes = (*notes, ControlNote.FURTHER_MODES(text))
    if status is RingDownStatus.CONVERGED and std[0] + std[2] > modes[2] - modes[0]:
        text = "the frequencies differ by less than their uncertainty: which mode is which is not certain"
        notes = (*notes, ControlNote.MODES_ALIKE(text))
    return RingDown(
        modes[::2],
        modes[1::2],
        std[::2],
        std[1::2],
        spread,
        K,
        D,
        np.array([rate.real for rate in problem.rates if not rate.imag]),
        rms,
        sum(len(impacts) for impacts in found),
        tuple(rec.name for rec in group),
        harmonics,
        status,
        notes,
        further,
    )
