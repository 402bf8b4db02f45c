"""Identification of a run-out map from recordings with piezos at rest (paper, Sec. 3.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import eigvalsh, solve

from gbid.arrays import FloatArray
from gbid.errors import DataError, UsageError
from gbid.notes.data_notes import DataNote
from gbid.prefilter.median import running_median
from gbid.prefilter.runout import TURN, RunoutMap, differing_condition
from gbid.prefilter.shaft import ShaftMotion, shaft_motion
from gbid.recording import Recording

# Above this condition number the recorded angles cannot distinguish two harmonics (aliasing at few angles per turn).
_WORST_CONDITION = 20.0


def identify_runout(
    recordings: Recording | Sequence[Recording],
    *,
    method: str = "harmonics",
    harmonics: int = 10,
    bins: int = 100,
    still: float = 0.5e-6,
    signal: str = "p",
    in_loop: bool = False,
) -> RunoutMap:
    """Return the map of the disc position over the shaft angle, from recordings with piezos at rest.

    All recordings share one map. Each has its own mean, and the map keeps the average of these means. When the shaft
    stands still (0 rpm), the position cannot be related to the angle, and the map is the mean alone.

    A controller that measures the run-out answers to it as to motion. References, piezos and disc then follow the
    shaft, each with a map of its own: make one of each signal from recordings with the controller and without
    excitation (`in_loop`), and give all of them to `gbid.prefilter`.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Recordings with p and phi, at one operating point. r or u is used to check that the piezos are at rest.
    method : str
        ``"harmonics"`` (default): least squares on sines and cosines. ``"bins"``: means over equal parts of a turn.
        Bins need no choice of the number of harmonics, but they smooth the high ones.
    harmonics : int
        Number of harmonics.
    bins : int
        Number of parts of a turn.
    still : float
        Largest movement of r and u that counts as rest [m], peak to peak and without single-sample spikes.
    signal : str
        Signal of the map.
    in_loop : bool
        Whether a controller acts, so that the piezos move. Then w, the injected signal, must be at rest instead.

    Returns
    -------
    RunoutMap
        The map, with the rms values before and after.

    Raises
    ------
    UsageError
        When the method is unknown, or when a number is below 1.
    DataError
        When a signal is missing, when a piezo moves, when the recordings do not belong together, or when the recorded
        angles do not determine the map.
    """
    group = [recordings] if isinstance(recordings, Recording) else list(recordings)
    if method not in ("harmonics", "bins"):
        raise UsageError(f"method = {method!r}; use 'harmonics' or 'bins'")
    if harmonics < 1 or bins < 4:
        raise UsageError(f"harmonics = {harmonics}, bins = {bins}; give at least 1 harmonic and 4 bins")
    if not group:
        raise UsageError("no stationary recording given; the run-out map needs at least one")
    first = group[0]
    notes: list[str] = []
    for rec in group:
        if signal not in rec.signals:
            raise DataError(f"recording {rec.name!r} has no signal {signal!r}, of which the map is to be made")
        _check_still(rec, still, notes, ("w",) if in_loop else ("r", "u"))
        if rec.channels[signal] != first.channels[signal] or differing_condition(rec.conditions, first.conditions):
            raise DataError(
                f"recordings {first.name!r} and {rec.name!r} differ in channels or conditions; "
                "make one map for each operating point"
            )
    motions = [shaft_motion(rec) for rec in group]
    turning = {motion.turns > 0 for motion in motions}
    if len(turning) > 1:
        raise DataError(f"of {', '.join(r.name for r in group)} some turn and some stand still; map them apart")

    p = [rec.signal(signal) for rec in group]
    n_channels = p[0].shape[1]
    orders, angles = np.zeros(0), np.zeros(0)
    cosine = sine = table = np.zeros((0, n_channels))
    if turning == {False}:
        method = "mean"
        means = [values.mean(axis=0) for values in p]
        notes.append(DataNote.SHAFT_STOOD_STILL("the shaft stood still: the map is the mean position alone"))
    elif method == "harmonics":
        orders = np.arange(1.0, harmonics + 1)
        means, cosine, sine = _fit_harmonics([m.angle for m in motions], p, orders)
    else:
        means = [_mean_over_turns(motion, values) for motion, values in zip(motions, p, strict=True)]
        centred = np.vstack([values - mean for values, mean in zip(p, means, strict=True)])
        angles, table = _bin_means(np.concatenate([m.angle for m in motions]), centred, bins)
    made = RunoutMap(
        method=method,
        mean=np.mean(means, axis=0),
        orders=orders,
        cosine=cosine,
        sine=sine,
        angles=angles,
        table=table,
        channels=first.channels[signal],
        conditions=dict(first.conditions),
        sources=tuple(rec.name for rec in group),
        turns=sum(motion.turns for motion in motions),
        rms_before=_rms([values - values.mean(axis=0) for values in p]),
        rms_after=np.zeros(n_channels),
        notes=tuple(notes),
    )
    residuals = [
        values - mean - (made.evaluate(motion.angle) - made.mean)
        for values, mean, motion in zip(p, means, motions, strict=True)
    ]
    return replace(made, rms_after=_rms(residuals))


def _check_still(rec: Recording, still: float, notes: list[str], signals: tuple[str, ...]) -> None:
    present = [name for name in signals if name in rec.signals]
    for name in present:
        values = rec.signal(name)
        travel = np.ptp(running_median(values, 3 if len(values) >= 3 else 1), axis=0)
        if travel.max() > still:
            channel = rec.channels[name][int(travel.argmax())]
            raise DataError(
                f"recording {rec.name!r}: {name}_{channel} moves by {travel.max() * 1e6:.2f} um; "
                f"a run-out map needs piezos at rest (at most {still * 1e6:.2f} um); for a recording in closed loop, "
                "see in_loop"
            )
    if not present:
        what = "w is not recorded" if signals == ("w",) else "neither r nor u is recorded"
        text = f"{rec.name}: {what}, so it was not checked that the piezos were at rest"
        notes.append(DataNote.REST_NOT_CHECKED(text))


def _fit_harmonics(
    angles: list[FloatArray], p: list[FloatArray], orders: FloatArray
) -> tuple[list[FloatArray], FloatArray, FloatArray]:
    """Least squares on one mean per recording and shared harmonics; return means, cosine and sine."""
    lengths = [len(values) for values in p]
    phase = np.outer(np.concatenate(angles), orders)
    own_mean = np.repeat(np.eye(len(p)), lengths, axis=0)
    # Cosines and sines have mean square 1/2. They are scaled to the size of the columns of ones.
    basis = np.hstack([own_mean, np.sqrt(2) * np.cos(phase), np.sqrt(2) * np.sin(phase)])
    if len(basis) <= basis.shape[1]:
        raise DataError(f"{len(basis)} samples cannot determine {len(orders)} harmonics; use fewer harmonics")
    # The condition number of a map that is accepted is small, so that the normal equations lose no digits.
    gram = basis.T @ basis
    squares = eigvalsh(gram)
    shares = np.sqrt(len(p))  # the column of a mean is nonzero only for its own recording
    if squares[-1] > (_WORST_CONDITION * shares) ** 2 * squares[0]:
        raise DataError(
            f"the recorded shaft angles cannot distinguish {len(orders)} harmonics; at constant speed a turn "
            "needs more than twice as many samples as harmonics: use fewer harmonics"
        )
    solution = solve(gram, basis.T @ np.vstack(p), assume_a="pos")
    means = list(solution[: len(p)])
    cosine, sine = np.split(np.sqrt(2) * solution[len(p) :], 2)
    return means, cosine, sine


def _mean_over_turns(motion: ShaftMotion, values: FloatArray) -> FloatArray:
    """Return the mean over the largest whole number of turns, in which the harmonics average out."""
    course = np.abs(np.unwrap(motion.angle) - motion.angle[0])
    inside = course < TURN * np.floor(motion.turns)
    return np.asarray(values[inside].mean(axis=0))


def _bin_means(angle: FloatArray, centred: FloatArray, bins: int) -> tuple[FloatArray, FloatArray]:
    """Return the mean angle and mean position in each part of a turn that has samples."""
    wrapped = np.mod(angle, TURN)
    index = np.minimum((wrapped * (bins / TURN)).astype(int), bins - 1)
    count = np.bincount(index, minlength=bins)
    full = count > 0
    sums = [np.bincount(index, weights=column, minlength=bins) for column in (wrapped, *centred.T)]
    nodes, *columns = (total[full] / count[full] for total in sums)
    # A constant speed may visit few angles only. The map interpolates linearly between them, so gaps must be small.
    gap = np.diff(nodes, append=nodes[0] + TURN).max()
    if gap > TURN / 16:
        raise DataError(
            f"the recorded shaft angles leave {np.rad2deg(gap):.0f} degrees of the turn without a sample; "
            "record longer, or at a speed that visits more angles"
        )
    return nodes, np.column_stack(columns)


def _rms(parts: list[FloatArray]) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(np.vstack(parts) ** 2, axis=0)))
