"""Run-out maps from recordings with piezos at rest (paper, Sec. 3.5): identification, residual, choice, alignment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
import scipy
from annotated_types import Ge

from gbid.core.arrays import FloatArray
from gbid.core.brief import Brief
from gbid.core.errors import DataError, UsageError
from gbid.core.notes import DataNote
from gbid.core.option_types import Count
from gbid.prefilter.runout import (
    TURN,
    RunoutMap,
    ShaftMotion,
    differing_condition,
    running_median,
    sensor_notes,
    shaft_motion,
)
from gbid.recording import Recording

# Above this condition number the recorded angles cannot distinguish two harmonics (aliasing at few angles per turn).
_WORST_CONDITION = 20.0


def identify_runout(
    recordings: Recording | Sequence[Recording],
    *,
    method: Literal["harmonics", "bins"] = "harmonics",
    harmonics: Count = 10,
    bins: Annotated[int, Ge(4)] = 100,
    still: float = 0.5e-6,
    signal: str = "p",
    in_loop: bool = False,
) -> RunoutMap:
    """Return the run-out map over the shaft angle, from recordings with piezos at rest.

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
    if not group:
        raise UsageError("no stationary recording given; the run-out map needs at least one")
    first = group[0]
    notes: list[str] = []
    for rec in group:
        if signal not in rec.signals:
            raise DataError(f"recording {rec.name!r} has no signal {signal!r}, of which the map is to be made")
        _check_still(rec, still, notes, ("w",) if in_loop else ("r", "u"))
        notes += sensor_notes(rec, signal)
        if rec.channels[signal] != first.channels[signal] or differing_condition(rec.conditions, first.conditions):
            raise DataError(
                f"recordings {first.name!r} and {rec.name!r} differ in channels or conditions; "
                "make one map for each operating point"
            )
    motions = [shaft_motion(rec) for rec in group]
    turning = {motion.turns > 0 for motion in motions}
    if len(turning) > 1:
        raise DataError(f"of {', '.join(r.name for r in group)} some turn and some stand still; make separate maps")

    p = [rec.signal(signal) for rec in group]
    n_channels = p[0].shape[1]
    orders, angles = np.zeros(0), np.zeros(0)
    cosine = sine = table = np.zeros((0, n_channels))
    if turning == {False}:
        means = [values.mean(axis=0) for values in p]
        notes.append(DataNote.SHAFT_STOOD_STILL("the shaft stood still: the map is the mean position alone"))
    elif method == "harmonics":
        orders = np.arange(1.0, harmonics + 1)
        means, cosine, sine = _fit_harmonics([m.angle for m in motions], p, orders)
    else:
        means = [_mean_over_turns(motion, values) for motion, values in zip(motions, p, strict=True)]
        centred = np.vstack([values - mean for values, mean in zip(p, means, strict=True)])
        angles, table = _bin_means(np.concatenate([m.angle for m in motions]), centred, bins)
    runout_map = RunoutMap(
        method="mean" if turning == {False} else method,
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
        values - mean - (runout_map.evaluate(motion.angle) - runout_map.mean)
        for values, mean, motion in zip(p, means, motions, strict=True)
    ]
    return replace(runout_map, rms_after=_rms(residuals))


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
    """Fit a mean for each recording and shared harmonics by least squares; return means, cosine and sine."""
    lengths = [len(values) for values in p]
    phase = np.outer(np.concatenate(angles), orders)
    own_mean = np.repeat(np.eye(len(p)), lengths, axis=0)
    # Cosines and sines have mean square 1/2. They are scaled to the size of the columns of ones.
    basis = np.hstack([own_mean, np.sqrt(2) * np.cos(phase), np.sqrt(2) * np.sin(phase)])
    if len(basis) <= basis.shape[1]:
        raise DataError(f"{len(basis)} samples cannot determine {len(orders)} harmonics; use fewer harmonics")
    # The condition number of a map that is accepted is small, so that the normal equations lose no digits.
    gram = basis.T @ basis
    squares = scipy.linalg.eigvalsh(gram)
    shares = np.sqrt(len(p))  # the column of a mean is nonzero only for its own recording
    if squares[-1] > (_WORST_CONDITION * shares) ** 2 * squares[0]:
        raise DataError(
            f"the recorded shaft angles cannot distinguish {len(orders)} harmonics; at constant speed a turn "
            "needs more than twice as many samples as harmonics: use fewer harmonics"
        )
    solution = scipy.linalg.solve(gram, basis.T @ np.vstack(p), assume_a="pos")
    means = list(solution[: len(p)])
    cosine, sine = np.split(np.sqrt(2) * solution[len(p) :], 2)
    return means, cosine, sine


def _mean_over_turns(motion: ShaftMotion, values: FloatArray) -> FloatArray:
    """Return the mean over the largest whole number of turns, which contains no harmonics."""
    course = np.abs(np.unwrap(motion.angle) - motion.angle[0])
    inside = course < TURN * np.floor(motion.turns)
    return np.asarray(values[inside].mean(axis=0))


def _bin_means(angle: FloatArray, centred: FloatArray, bins: int) -> tuple[FloatArray, FloatArray]:
    """Return the mean angle and mean position of each angle bin that has samples."""
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


SHARE = 0.3
"""A line is named when its rms is above this share of the sensor noise."""
_WHOLE = 0.02  # an order is a harmonic of the shaft within this distance
_UPPER = 0.5  # upper part of the spectrum that contains sensor noise only


@dataclass(frozen=True, eq=False)
class RunoutResidual(Brief):
    """Residual of one stationary recording after subtraction of a run-out map.

    On a stable orbit the residual is the sensor noise. At 4000 rpm the orbit of the paper (Sec. 4) is not stable: it
    moves slowly, and no function of the shaft angle describes that.

    Attributes
    ----------
    name : str
        Name of the recording.
    conditions : dict of str to float
        Its operating point.
    rms_before : (n_channels,) array
        Root mean square about the mean before the map [m].
    rms : (n_channels,) array
        Root mean square about the mean after the map [m].
    noise : (n_channels,) array
        Sensor noise, from the level of the upper half of the spectrum [m].
    non_synchronous : (n_channels,) array
        Root mean square of the residual beyond the noise [m].
    frequency_hz : (n_channels,) array
        Frequency of the strongest spectral line in the residual.
    order : (n_channels,) array
        This frequency over the shaft frequency. A value that is not an integer means motion that does not follow the
        shaft. NaN for a shaft at rest.
    line_rms : (n_channels,) array
        Root mean square of the residual within 5 Hz of this line [m].
    """

    name: str
    conditions: Mapping[str, float]
    rms_before: FloatArray
    rms: FloatArray
    noise: FloatArray
    non_synchronous: FloatArray
    frequency_hz: FloatArray
    order: FloatArray
    line_rms: FloatArray

    @property
    def over_noise(self) -> FloatArray:
        """Residual divided by sensor noise, (n_channels,); 1 for a perfect map."""
        return np.asarray(self.rms / self.noise)


def runout_residual(runout_map: RunoutMap, rec: Recording) -> RunoutResidual:
    """Return the residual after subtraction of a run-out map, for a recording with piezos at rest.

    Parameters
    ----------
    runout_map : RunoutMap
        Map made from this recording or, better, from another one.
    rec : Recording
        Recording with p and phi.

    Returns
    -------
    RunoutResidual

    Raises
    ------
    DataError
        When p or phi is missing, or when phi does not fit the speed.
    """
    p, motion = rec.signal("p"), shaft_motion(rec)
    rest = p - runout_map.evaluate(motion.angle) if runout_map.needs_angle else p - runout_map.mean
    rest = rest - rest.mean(axis=0)
    power, frequency = power_of(rest, rec.sample_time)
    upper = power[int(len(power) * (1 - _UPPER)) :]
    # A periodogram is chi-square distributed with two degrees of freedom: its median is ln 2 times its mean. Single
    # spectral lines do not change the median.
    noise = np.sqrt(np.median(upper, axis=0) / np.log(2) * len(power))
    rms = np.sqrt(np.mean(rest**2, axis=0))
    strongest = power.argmax(axis=0)
    near = np.abs(frequency[:, None] - frequency[strongest]) <= 5.0
    turns_per_s = motion.turns / ((rec.n_samples - 1) * rec.sample_time)
    return RunoutResidual(
        name=rec.name,
        conditions=dict(rec.conditions),
        rms_before=p.std(axis=0),
        rms=rms,
        noise=noise,
        non_synchronous=np.sqrt(np.maximum(rms**2 - noise**2, 0.0)),
        frequency_hz=frequency[strongest],
        order=frequency[strongest] / turns_per_s if turns_per_s else np.full(len(rms), np.nan),
        line_rms=np.sqrt(np.where(near, power, 0.0).sum(axis=0)),
    )


def power_of(values: FloatArray, sample_time: float) -> tuple[FloatArray, FloatArray]:
    """Return the power spectrum without the mean; its sum over frequencies is the variance.

    Returns
    -------
    (n_frequencies, n_channels) array
        Mean squares.
    (n_frequencies,) array
        Frequencies [Hz], from the first above zero.
    """
    n = len(values)
    power = 2 * np.abs(np.fft.rfft(values, axis=0)[1:] / n) ** 2
    if n % 2 == 0:
        power[-1] /= 2  # the Nyquist frequency occurs only once
    return power, np.asarray(np.fft.rfftfreq(n, sample_time)[1:], dtype=float)


def leftover_words(runout_map: RunoutMap, recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Return a remark on each strong line that a map leaves in stationary recordings.

    Parameters
    ----------
    runout_map : RunoutMap
        The map.
    recordings : sequence of Recording
        Recordings with piezos at rest, as for `identify_runout`.

    Returns
    -------
    tuple of str
        Empty when nothing is left over, or for a shaft at rest.
    """
    if not runout_map.needs_angle:
        return ()
    return tuple(words for rec in recordings for words in _words(runout_map, runout_residual(runout_map, rec)))


def _words(runout_map: RunoutMap, left: RunoutResidual) -> list[str]:
    parts = []
    for i, channel in enumerate(runout_map.channels):
        if left.line_rms[i] <= SHARE * left.noise[i]:
            continue
        order, nearest = left.order[i], round(left.order[i])
        size = f"{left.name}: left over in p_{channel}: {1e9 * left.line_rms[i]:.0f} nm rms"
        at = f"{left.frequency_hz[i]:.1f} Hz, noise {1e9 * left.noise[i]:.0f} nm"
        if nearest < 1 or abs(order - nearest) > _WHOLE:
            parts.append(f"{size} of order {order:.2f} ({at}): it does not follow the shaft, so no map removes it")
        elif nearest > runout_map.orders.max(initial=0):
            parts.append(f"{size} of order {nearest} ({at}): harmonics: {nearest} or auto removes it")
        else:
            parts.append(f"{size} of order {nearest} ({at}): the run-out changes within the recording")
    return parts


# ---- Choice of a run-out map: cross-validation of methods and sizes.

HARMONICS = (1, 2, 3, 5, 7, 10, 15, 20)
BINS = (25, 50, 100, 200)


@dataclass(frozen=True, eq=False)
class RunoutTrial(Brief):
    """Cross-validation result of one method and size of a run-out map.

    Attributes
    ----------
    method : str
        ``"harmonics"``, ``"bins"``, or ``"mean"`` for a shaft at rest.
    size : int
        Number of harmonics or bins.
    residual_rms : (n_channels,) array
        Root mean square of the residuals over all validation parts [m]; NaN when no map could be made.
    fold_rms : (n_folds, n_channels) array
        Root mean square of the residuals on each validation part [m].
    chosen : bool
        Whether this trial is the recommended one.
    note : str
        Reason why no map could be made.
    """

    method: str
    size: int
    residual_rms: FloatArray
    fold_rms: FloatArray
    chosen: bool = False
    note: str = ""

    @property
    def n_parameters(self) -> int:
        """Number of map parameters for each channel, not counting the mean."""
        return 2 * self.size if self.method == "harmonics" else self.size


@dataclass(frozen=True, eq=False)
class RunoutComparison(Brief):
    """Trials of a cross-validation, and the map of the recommended trial.

    Attributes
    ----------
    trials : tuple of RunoutTrial
        In the requested order: harmonics by size, then bins by size.
    runout_map : RunoutMap
        Map of the chosen method and size, made from all recordings.
    held_out : tuple of str
        Validation parts: names of recordings, or sample ranges of the single recording, ``"name[0:6250]"``.
    """

    trials: tuple[RunoutTrial, ...]
    runout_map: RunoutMap
    held_out: tuple[str, ...]

    @property
    def chosen(self) -> RunoutTrial:
        """The recommended trial."""
        return next(trial for trial in self.trials if trial.chosen)

    def rows(self) -> list[dict[str, Any]]:
        """Return the trials as table rows: method, size, residual_rms_<channel> [m], chosen, note."""
        return [
            {
                "method": trial.method,
                "size": trial.size,
                **{
                    f"residual_rms_{channel}": float(rms)
                    for channel, rms in zip(self.runout_map.channels, trial.residual_rms, strict=True)
                },
                "chosen": trial.chosen,
                "note": trial.note,
            }
            for trial in self.trials
        ]


def compare_runout(
    recordings: Recording | Sequence[Recording],
    *,
    harmonics: Sequence[int] = HARMONICS,
    bins: Sequence[int] = BINS,
    folds: Annotated[int, Ge(2)] = 4,
    still: float = 0.5e-6,
) -> RunoutComparison:
    """Return a cross-validation of run-out maps (harmonics and angle bins), with a recommended map.

    With several recordings, each is the validation part once. A single recording is cut into `folds` stretches of equal
    length. Each map is made from the other parts and evaluated by the residuals on the validation part, about their own
    mean. Another recording starts at another shaft angle. But stretches of one recording visit the same angles when a
    turn is a whole number of samples. Then they cannot judge bins well, and a second recording is better.

    Among the maps that are not worse than the best by more than one standard error of the difference (of the mean
    squares, summed over the channels, over the validation parts), the map with the fewest parameters is chosen. A
    larger size fits noise, a smaller one leaves run-out.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        As for `identify_runout`: p and phi, piezos at rest, one operating point.
    harmonics : sequence of int
        Numbers of harmonics to try; may be empty.
    bins : sequence of int
        Numbers of bins to try; may be empty.
    folds : int
        Number of stretches of a single recording, at least 2.
    still : float
        Largest movement of the piezos, as for `identify_runout` [m].

    Returns
    -------
    RunoutComparison

    Raises
    ------
    UsageError
        When there is nothing to try, or when `folds` is below 2.
    DataError
        As for `identify_runout`; also when a validation part is shorter than two turns, or when no trial gives a map.
    """
    group = [recordings] if isinstance(recordings, Recording) else list(recordings)
    wanted = [("harmonics", int(n)) for n in harmonics] + [("bins", int(n)) for n in bins]
    if not wanted:
        raise UsageError("nothing to compare: give numbers of harmonics or of bins")
    if not group:
        raise UsageError("no stationary recording given; the comparison needs at least one")
    parts = group if len(group) > 1 else _stretches(group[0], folds)
    if not any(shaft_motion(rec).turns for rec in group):
        only = identify_runout(group, still=still)
        rms = np.array([rec.signal("p").std(axis=0) for rec in parts])
        return RunoutComparison((_trial("mean", 1, rms, chosen=True),), only, tuple(rec.name for rec in parts))
    trials = [_tried(method, size, parts, still) for method, size in wanted]
    usable = [trial for trial in trials if not trial.note]
    if not usable:
        raise DataError(f"no run-out map can be made: {trials[0].note}")
    best = _simplest_of_the_best(usable)
    size: dict[str, Any] = {"method": best.method, best.method: best.size}
    return RunoutComparison(
        tuple(replace(trial, chosen=trial is best) for trial in trials),
        identify_runout(group, still=still, **size),
        tuple(rec.name for rec in parts),
    )


def _stretches(rec: Recording, folds: int) -> list[Recording]:
    """Return parts of equal length, each at least two turns long."""
    motion = shaft_motion(rec)
    if motion.turns and motion.turns < 2 * folds:
        raise DataError(
            f"recording {rec.name!r}: {motion.turns:.1f} turns are too few for {folds} stretches of two turns each; "
            "record longer or hold out fewer"
        )
    edges = np.linspace(0, rec.n_samples, folds + 1).astype(int)
    return [rec.slice(a, b, f"{rec.name}[{a}:{b}]") for a, b in pairwise(edges)]


def _tried(method: str, size: int, parts: list[Recording], still: float) -> RunoutTrial:
    """Return the trial of one method and size; each part is once the validation part."""
    n_channels = parts[0].signal("p").shape[1]
    rms = []
    sized: dict[str, Any] = {"method": method, method: size}
    for i, held_out in enumerate(parts):
        others = [part for j, part in enumerate(parts) if j != i]
        try:
            runout_map = identify_runout(others, still=still, **sized)
        except DataError as error:
            no_folds = np.full((0, n_channels), np.nan)
            return RunoutTrial(method, size, np.full(n_channels, np.nan), no_folds, note=str(error))
        rest = held_out.signal("p") - runout_map.evaluate(shaft_motion(held_out).angle)
        rms.append(rest.std(axis=0))
    return _trial(method, size, np.array(rms))


def _trial(method: str, size: int, fold_rms: FloatArray, chosen: bool = False) -> RunoutTrial:
    return RunoutTrial(method, size, np.sqrt(np.mean(fold_rms**2, axis=0)), fold_rms, chosen)


def _simplest_of_the_best(trials: list[RunoutTrial]) -> RunoutTrial:
    """Return the simplest trial within one standard error of the best, by paired differences of mean squares."""
    squares = [np.sum(trial.fold_rms**2, axis=1) for trial in trials]
    best = min(squares, key=lambda m: float(m.mean()))
    candidates = []
    for trial, candidate in zip(trials, squares, strict=True):
        worse = candidate - best
        if worse.mean() <= worse.std(ddof=1) / np.sqrt(len(worse)):
            candidates.append((trial.n_parameters, float(candidate.mean()), trial))
    return min(candidates, key=lambda entry: entry[:2])[2]


# ---- Alignment of recordings without encoder index: the run-out gives the offset of the shaft angle.

SURE = 5.0
"""Number of standard deviations by which every other offset must be worse."""
INDEX_OFF = np.deg2rad(10.0)
"""Smallest rotation of a recording's run-out against the map that shows a missed index [rad]."""
_GRID = 3600  # evaluated offsets; the minima are refined
_MAX_BLOCKS = 20


@dataclass(frozen=True, eq=False)
class IndexAlignment(Brief):
    """Angle offset between the encoder zero of a recording and the zero of a run-out map.

    Attributes
    ----------
    offset : float
        Angle to add to the recorded angle, within [0, 2 pi) [rad].
    std : float
        Its standard deviation [rad].
    margin : float
        Number of standard deviations by which the next best offset is worse. It is small for run-out with few
        harmonics, which repeats after part of a turn.
    next_best : float
        The next best offset [rad].
    explained : float
        Share of the mean square of the synchronous motion that the aligned map explains. It is near 1 when the map
        holds for the recording, and small or negative for another operating point or machine.
    offsets, misfit : (n,) array
        Evaluated offsets [rad], and the squared deviation at each, in squared standard deviations, for a figure.
    """

    offset: float
    std: float
    margin: float
    next_best: float
    explained: float
    offsets: FloatArray
    misfit: FloatArray

    @property
    def sure(self) -> bool:
        """Whether the offset is reliable: 5 standard deviations better than the next, and half of the map explained."""
        return self.margin >= SURE and self.explained >= 0.5

    def apply(self, rec: Recording) -> Recording:
        """Return the recording with its angle counted from the map's zero.

        Parameters
        ----------
        rec : Recording
            The aligned recording, or another one from the same run of the encoder.

        Raises
        ------
        DataError
            When the offset is not sure. If you know the offset, add it to phi yourself.
        """
        if not self.sure:
            raise DataError(
                f"recording {rec.name!r}: the run-out does not determine the missing index of the encoder: "
                f"{np.rad2deg(self.offset):.1f} or {np.rad2deg(self.next_best):.1f} degrees "
                f"fit almost equally ({self.margin:.1f} standard deviations; {self.explained:.0%} explained); "
                "use a longer recording, or one with the index"
            )
        note = f"{np.rad2deg(self.offset):.3f} degrees added to phi (std {np.rad2deg(self.std):.3f})"
        aligned = rec.with_signals(phi=np.mod(rec.signal("phi") + self.offset, TURN))
        return replace(aligned, provenance={**rec.provenance, "index": note})


def align_index(runout_map: RunoutMap, recording: Recording, *, orders: Count = 10) -> IndexAlignment:
    r"""Return the angle offset of a recording from an encoder without index.

    Let :math:`A_n` be the harmonics of the recorded position over the recorded angle, and :math:`M_n` those of the
    map. They differ by a rotation: :math:`A_n = M_n e^{i n \delta}`. The offset minimises :math:`J(\delta) = \sum_n
    |A_n - M_n e^{i n \delta}|^2 / \sigma_n^2` over all channels. This is a circular correlation with one weight for
    each harmonic. The variance :math:`\sigma_n^2` comes from the scatter between parts of the recording and from the
    residuals of the map. The piezos may move, because their motion only adds scatter. The curvature at the minimum
    gives the standard deviation. The margin of the choice is :math:`\sqrt{J(\delta_2) - J(\delta)}`, where
    :math:`\delta_2` is the next lowest minimum.

    Parameters
    ----------
    runout_map : RunoutMap
        Map from recordings with one common zero of the angle, at the same operating point.
    recording : Recording
        Recording with p and phi and at least 8 turns. The piezos may move.
    orders : int
        Number of harmonics, at most those of the map.

    Returns
    -------
    IndexAlignment

    Raises
    ------
    UsageError
        When `orders` is below 1, or when the map is of a shaft at rest.
    DataError
        When signals are missing, when channels differ, or when there are too few turns.
    """
    if not runout_map.needs_angle:
        raise UsageError("the run-out map was measured with the shaft at rest; it has no angle to align")
    p, motion = recording.signal("p"), shaft_motion(recording)
    if recording.channels["p"] != runout_map.channels:
        raise DataError(f"recording {recording.name!r} and the run-out map differ in the channels of p")
    if motion.turns < 8:
        raise DataError(
            f"recording {recording.name!r}: {motion.turns:.1f} turns are too few to find the index; "
            "at least 8 are needed"
        )
    expected = _map_phasors(runout_map, orders)
    n = np.arange(1.0, len(expected) + 1)
    parts = _phasors(motion, p, n)
    measured = parts.mean(axis=0)
    variance = parts.var(axis=0, ddof=1) / len(parts)  # sum for the real and imaginary part
    # The map has errors, too: white noise of rms_after, averaged over the samples in its turns.
    n_map = recording.n_samples * max(runout_map.turns, 1.0) / motion.turns
    variance = variance + 4 * runout_map.rms_after**2 / n_map
    variance = np.maximum(variance, 1e-12 * float(np.abs(expected).max()) ** 2)  # noise-free data: finite weights

    def misfit(offset: FloatArray) -> FloatArray:
        turned = expected[None] * np.exp(1j * n[None, :, None] * offset[:, None, None])
        return np.asarray(np.sum(2 * np.abs(measured[None] - turned) ** 2 / variance[None], axis=(1, 2)))

    grid = np.arange(_GRID) * TURN / _GRID
    curve = misfit(grid)
    minima = np.flatnonzero((curve <= np.roll(curve, 1)) & (curve < np.roll(curve, -1)))
    refined = [_refined(misfit, grid[i]) for i in minima]
    refined.sort(key=lambda entry: entry[1])
    offset, least, curvature = refined[0]
    other, other_misfit = refined[1][:2] if len(refined) > 1 else ((offset + np.pi) % TURN, float(curve.max()))
    aligned = expected * np.exp(1j * n[:, None] * offset)
    return IndexAlignment(
        offset=offset,
        std=float(np.sqrt(2 / curvature)),
        margin=float(np.sqrt(max(other_misfit - least, 0.0))),
        next_best=other,
        explained=float(1 - np.sum(np.abs(measured - aligned) ** 2) / np.sum(np.abs(measured) ** 2)),
        offsets=grid,
        misfit=curve,
    )


def refuse_lost_index(runout_map: RunoutMap, recording: Recording) -> None:
    """Refuse a recording whose run-out is a rotated copy of the map: subtraction would add run-out.

    Parameters
    ----------
    runout_map : RunoutMap
        A map over the angle.
    recording : Recording
        Recording with p and phi at the same operating point. One that is too short for an estimate is accepted.

    Raises
    ------
    DataError
        When the zero of the angle is another one.
    """
    try:
        shown = align_index(runout_map, recording)
    except DataError:
        return  # too short for an estimate of the rotation
    off = abs(np.angle(np.exp(1j * shown.offset)))
    if shown.sure and off > max(INDEX_OFF, SURE * shown.std):
        raise DataError(
            f"recording {recording.name!r}: its run-out is that of {', '.join(runout_map.sources)}, but rotated by "
            f"{np.rad2deg(off):.1f} degrees (std {np.rad2deg(shown.std):.1f}), so phi does not start at the "
            "same zero: the encoder missed its index; write prefilter: align_index: true, or record again"
        )


def _map_phasors(runout_map: RunoutMap, orders: int) -> FloatArray:
    """Return the complex amplitudes of the harmonics 1, 2, ... of the map, (n_orders, n_channels)."""
    highest = int(runout_map.orders.max()) if runout_map.orders.size else len(runout_map.angles) // 2
    n_points = 4096
    values = runout_map.evaluate(np.arange(n_points) * TURN / n_points)
    return np.asarray(np.fft.rfft(values, axis=0)[1 : min(orders, highest) + 1] * 2 / n_points)


def _phasors(motion: ShaftMotion, p: FloatArray, orders: FloatArray) -> FloatArray:
    """Return complex amplitudes of the harmonics for several parts of whole turns, (n_parts, n_orders, n_channels)."""
    course = np.abs(np.unwrap(motion.angle) - motion.angle[0])
    n_parts = int(min(_MAX_BLOCKS, motion.turns // 2))
    edges = np.searchsorted(course, TURN * np.floor(motion.turns / n_parts) * np.arange(n_parts + 1))
    parts = []
    for first, last in pairwise(edges):
        phase = np.outer(motion.angle[first:last], orders)
        basis = np.hstack([np.ones((last - first, 1)), np.cos(phase), np.sin(phase)])
        solution = np.linalg.lstsq(basis, p[first:last], rcond=None)[0]
        cosine, sine = np.split(solution[1:], 2)
        parts.append(cosine - 1j * sine)
    return np.array(parts)


def _refined(misfit: object, start: float) -> tuple[float, float, float]:
    """Return the minimum of a parabola through three neighbouring points: position, value and curvature."""
    assert callable(misfit)
    step = TURN / _GRID
    for _ in range(3):
        low, mid, high = misfit(np.array([start - step, start, start + step]))
        curvature = (low - 2 * mid + high) / step**2
        if curvature <= 0:
            break
        start = start + np.clip((low - high) / (2 * step * curvature), -step, step)
        step /= 4
    value = float(misfit(np.array([start]))[0])
    return float(np.mod(start, TURN)), value, float(max(curvature, 1e-300))
