"""Prefilter of measured signals for a linear model (paper, Sec. 3.5): spikes, offline and online filter, reports."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, NamedTuple

import h5py
import numpy as np
import numpy.typing as npt
import scipy

from gbid.core import hdf5
from gbid.core.arrays import FloatArray, IntArray
from gbid.core.brief import Brief
from gbid.core.errors import DataError, UsageError
from gbid.core.hdf5 import NOT_STORED, Stored
from gbid.core.notes import DataNote
from gbid.core.option_types import checks_arguments
from gbid.core.tables import Column, Row, Table, shown_unit
from gbid.prefilter.runout import RunoutMap, running_median, sensor_notes, shaft_motion
from gbid.recording import Recording

THRESHOLD = 6.0
"""Robust standard deviations by which a sample must miss the cubic through its neighbours."""
ONE_SIDED = 4.0
"""Robust standard deviations by which it must also miss the cubic fitted to seven samples before, and after it."""
LONGEST_RUN = 3
"""Most wrong samples in a row that are replaced."""
_MIDDLE = np.array([-1.0, 4.0, 0.0, 4.0, -1.0]) / 6  # cubic through two samples on each side, at the middle
_BEFORE = np.array([-4.0, 6.0, 4.0, -3.0, -8.0, -4.0, 16.0]) / 7  # cubic fitted to seven samples, at the next one
_MAD_TO_STD = 1.4826
_QUANTA = 2.0
_REACH = 7  # samples at each end that have too few neighbours to be judged


class Despiked(NamedTuple):
    """Signal without spikes, and the positions of the removed spikes.

    Attributes
    ----------
    values : (n_samples, n_channels) array
        The signal, wrong samples replaced.
    samples : tuple of (n_spikes,) integer array
        Wrong samples of each channel, in order.
    """

    values: FloatArray
    samples: tuple[IntArray, ...]


def remove_spikes(values: FloatArray, threshold: float = THRESHOLD, measured: FloatArray | None = None) -> Despiked:
    """Replace samples that disagree with their neighbours on both sides.

    A Hampel identifier on the interpolation error. A run of one to three samples is wrong under three conditions:

    - A sample there misses the cubic through its four neighbours by more than `threshold` robust standard deviations
      (median of magnitudes) of this error, and no neighbour does so when the run is replaced by a cubic.
    - The first sample of the run does not continue the samples before it (cubic fitted to seven, four
      standard deviations).
    - The last sample of the run does not continue the samples after it. Steps and kinks of the signal therefore stay:
      each of their samples continues one of its sides.

    The error of a smooth signal is of fourth order: a wave of 10 um at 125 Hz, sampled at 5 kHz, has one of 1 nm. The
    distance from a running median is of second order (0.12 um there), so a limit on it would take crests for spikes.

    Parameters
    ----------
    values : (n_samples, n_channels) array
        The signal. Its first and last seven samples have too few neighbours on one side; they stay as they are.
    threshold : float
        In robust standard deviations.
    measured : (n_samples, n_channels) array, optional
        The signal as the converter gave it, when something was already subtracted from `values`. Errors of up to two
        steps of the converter are no spikes.

    Returns
    -------
    Despiked

    Notes
    -----
    Hampel, F. R. (1974), The influence curve and its role in robust estimation; Pearson, R. K. (2002), Outliers in
    process modeling and identification, IEEE Trans. Control Syst. Technol. 10, 55-63.
    """
    cleaned = np.array(values, dtype=float)
    steps = [_converter_step(column) for column in (cleaned if measured is None else measured).T]
    wrong = [_clean(column, threshold, step) for column, step in zip(cleaned.T, steps, strict=True)]
    return Despiked(cleaned, tuple(wrong))


OVERLOAD = 3.0
"""Distance of an overload from the median of its channel, over the largest distance of all other samples. A
sample nearer than this has less than a tenth of the power of 1 000 samples with a crest factor of 3 (9 * 9 / 1 000), so
that the checks of a recording bear it."""
_MEASURED = ("u", "p")


def repair_overloads(rec: Recording) -> Recording:
    """Return a recording without overloads: samples of u and p far beyond the range of all others.

    Such a sample (a full scale, 9999, 1e37) stands for no position, and decides means, spectra and maps. It is replaced
    as `remove_spikes` does, or on a line between its neighbours where that takes it for part of a step.
    ``import_remarks`` of the provenance tells of it. Runs of more than three such samples stay, and smaller spikes,
    which are the prefilter's. The command r stays: a single pulse may be meant. So do signals with missing samples or
    irregular times.

    Parameters
    ----------
    rec : Recording
        The recording.
    """
    repaired, texts = {}, []
    whole = [name for name in _MEASURED if name in rec.signals and name not in rec.missing and rec.stamps is None]
    for name in whole:
        values = rec.signal(name)
        distance = np.abs(values - np.median(values, axis=0))
        if not np.any(distance.max(axis=0) > OVERLOAD * np.percentile(distance, 99.0, axis=0)):
            continue
        cleaned = np.array(values)
        despiked = remove_spikes(values)
        for i, spikes in enumerate(despiked.samples):
            wrong = _overloaded(distance[:, i])
            if wrong.size:
                right = np.delete(np.arange(rec.n_samples), wrong)
                cleaned[wrong, i] = np.interp(wrong, right, values[right, i])
                smooth = np.intersect1d(wrong, spikes)
                cleaned[smooth, i] = despiked.values[smooth, i]
                worst = values[wrong[distance[wrong, i].argmax()], i]
                which = f"{wrong.size} overload{'s' if wrong.size > 1 else ''} of {name}_{rec.channels[name][i]}"
                texts.append(f"{which} replaced, up to {worst:g} {rec.units[name]}, the first at sample {wrong[0]}")
        repaired[name] = cleaned
    if not texts:
        return rec
    earlier = rec.provenance.get("import_remarks")
    remarks = "; ".join([*([earlier] if earlier else []), *texts])
    return replace(rec, signals={**rec.signals, **repaired}, provenance={**rec.provenance, "import_remarks": remarks})


def _overloaded(distance: FloatArray) -> IntArray:
    """Return the samples far beyond all others, at most 1 % of a signal, in runs of up to three."""
    order = np.argsort(-distance)
    largest = distance[order[: len(order) // 100 + 1]]
    above = np.flatnonzero((largest[:-1] > OVERLOAD * largest[1:]) & (largest[1:] > 0))
    wrong = np.sort(order[: above[-1] + 1]) if above.size else order[:0]
    runs = np.split(wrong, np.flatnonzero(np.diff(wrong) > 1) + 1)
    return np.concatenate([wrong[:0], *(run for run in runs if len(run) <= LONGEST_RUN)])


def _clean(x: FloatArray, threshold: float, step: float) -> IntArray:
    """Replace the spikes of one channel in place; return their positions."""
    spikes: list[int] = []
    if len(x) > 2 * _REACH:
        error = np.abs(_interpolation_error(x))
        sides = np.convolve(x, [1.0, *-_BEFORE[::-1]], mode="valid")
        limit = max(threshold * _robust_std(error), _QUANTA * step)
        limit_of_side = max(ONE_SIDED * _robust_std(sides), _QUANTA * step)
        done = 0
        for k in np.flatnonzero(error > limit) + 2:
            if k >= done:
                start, bridge = _wrong_run(x, int(k), limit, limit_of_side)
                x[start : start + len(bridge)] = bridge
                spikes += range(start, start + len(bridge))
                done = start + len(bridge) + 2 if len(bridge) else done
    return np.array(spikes, dtype=np.int64)


def _wrong_run(x: FloatArray, k: int, limit: float, limit_of_side: float) -> tuple[int, FloatArray]:
    """Return start and replacement of the shortest wrong run around a suspect sample; empty if there is none."""
    for length in range(1, LONGEST_RUN + 1):
        first, last = max(k - length + 1, _REACH), min(k + LONGEST_RUN, len(x) - _REACH - length + 1)
        starts = [start for start in range(first, last) if _off_both_sides(x, start, start + length, limit_of_side)]
        trials = [(start, *_bridged(x, start, start + length)) for start in starts]
        if trials:
            start, bridge, left = min(trials, key=lambda trial: trial[2])
            if left <= limit:
                return start, bridge
    return k, x[:0]


def _off_both_sides(x: FloatArray, start: int, stop: int, limit: float) -> bool:
    """Whether a run disagrees with the samples before it and with the samples after it."""
    before = x[start] - _BEFORE @ x[start - _REACH : start]
    after = x[stop - 1] - _BEFORE[::-1] @ x[stop : stop + _REACH]
    return bool(min(abs(before), abs(after)) > limit)


def _bridged(x: FloatArray, start: int, stop: int) -> tuple[FloatArray, float]:
    """Return the cubic through two samples on each side of a run, and the largest remaining interpolation error."""
    nodes = np.array([start - 2, start - 1, stop, stop + 1])
    bridge = np.asarray(scipy.interpolate.barycentric_interpolate(nodes, x[nodes], np.arange(start, stop)))
    # The run enters the errors of samples up to two away; the neighbours of those reach two further.
    trial = np.concatenate([x[max(start - 4, 0) : start], bridge, x[stop : stop + 4]])
    return bridge, float(np.abs(_interpolation_error(trial)).max())


def _interpolation_error(x: FloatArray) -> FloatArray:
    """Distance of each sample from the cubic through its four neighbours (n - 4,); two at each end are left out."""
    return np.asarray(x[2:-2] - np.convolve(x, _MIDDLE, mode="valid"))


def _robust_std(error: FloatArray) -> float:
    return _MAD_TO_STD * float(np.median(np.abs(error)))


def _converter_step(x: FloatArray) -> float:
    """Smallest step between two different values: the resolution of the converter."""
    steps = np.diff(np.unique(x))
    return float(steps.min()) if len(steps) else 0.0


_SHOWN_SPIKES = 10  # whose sample numbers a row lists
_NO_MEAN = ("phi", "force", "pressure_bar", "speed_rpm", "unbalance")  # these have no offset to remove


@dataclass(frozen=True, eq=False)
class PrefilterReport(Brief):
    """Report on one prefiltered recording: what the prefilter removed.

    Attributes
    ----------
    name : str
        Name of the recording.
    channels : dict of str to tuple of str
        Channel names of the signals of the recording, without angle and force.
    units : dict of str to str
        Units of these signals.
    rms_before, rms_after : dict of str to (n_channels,) array
        Root mean square of each of these signals about its mean, in the unit of the signal.
    offsets : dict of str to (n_channels,) array
        Removed means; zero when no means were removed. For the position it is the mean after the map. The mean of the
        map itself is `RunoutMap.mean`.
    runout_share : (n_channels,) array
        Share of the variance of p that the run-out map removed. It is zero without a map, and negative when the map
        increased the variance.
    harmonics : (n_orders, n_channels) array
        Amplitudes of the harmonics 1, 2, ... of the map [m]; no rows without a map or for a shaft at rest.
    spikes : tuple of int
        Number of wrong samples found in each channel of p.
    spike_samples : tuple of tuple of int
        Their sample numbers, from 0, for each channel; empty when spikes were not sought.
    median : int
        Size of the median filter, 1 for none.
    map_sources : tuple of str
        Recordings from which the map was made.
    notes : tuple of str
        Remarks, e.g. that a map of a shaft at rest is only a mean.
    """

    name: str
    channels: Annotated[Mapping[str, tuple[str, ...]], NOT_STORED]
    units: Annotated[Mapping[str, str], NOT_STORED]
    rms_before: Annotated[Mapping[str, FloatArray], NOT_STORED]
    rms_after: Annotated[Mapping[str, FloatArray], NOT_STORED]
    offsets: Annotated[Mapping[str, FloatArray], NOT_STORED]
    runout_share: Annotated[FloatArray, Stored("1", "part of the variance taken out by the run-out map", "channels")]
    harmonics: Annotated[FloatArray, Stored("m", "amplitudes of the harmonics of the map", "orders channels")]
    spikes: Annotated[tuple[int, ...], Stored("1", "wrong samples found in each channel")]
    median: int
    spike_samples: Annotated[tuple[tuple[int, ...], ...], NOT_STORED] = ()
    map_sources: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def prefilter(
    rec: Recording,
    runout_map: RunoutMap | None = None,
    *,
    position: str = "p",
    answers: Mapping[str, RunoutMap] | None = None,
    spikes: bool = True,
    median: int = 1,
    remove_mean: bool = True,
    any_condition: bool = False,
) -> tuple[Recording, PrefilterReport]:
    """Return a recording without run-out, unbalance response, offsets and spikes, and a report.

    The order is: ``p = p_raw - F_r(phi)``; replace spikes of p; subtract the means of all signals but angle and force;
    apply the median to p, when one is asked for. The paper removes the mean of the disc position only. A linear model
    from u to p (Eq. 6) or from r to u (Eq. 14) has no constant term, so the mean of its input must be removed as well.
    Without noise and filters, the means of one recording agree with the static gain up to the effect of the ends of the
    record, which is some nanometres in 5 s.

    A spike is a run of at most three samples that its neighbours on both sides contradict, see `remove_spikes`. All
    other samples stay as they are. The paper's way is ``spikes=False, median=3``. That median changes correct samples,
    too: it colours white noise and reduces crests, see `running_median`, and confidence intervals become too narrow.

    Parameters
    ----------
    rec : Recording
        Recording with p, and with phi when the map depends on the angle; r and u may be missing.
    runout_map : RunoutMap, optional
        Map from `identify_runout` at the same operating point. Without a map no run-out is removed.
    position : str
        Name of the measured position, ``"p"`` on the published rig.
    answers : dict of str to RunoutMap, optional
        Maps of other signals, such as r and u, that follow the shaft because a controller answers to run-out as to
        motion; see ``identify_runout(..., in_loop=True)``.
    spikes : bool
        Whether spikes of the position are replaced. They are reported in any case. Switch it off for a signal in which
        single samples may differ from their neighbours, such as the acceleration during an impact.
    median : int
        Size of the median filter on the position, odd; 1 for none.
    remove_mean : bool
        Whether the means are removed.
    any_condition : bool
        Whether a map from another operating point is accepted; the report notes it.

    Returns
    -------
    Recording
        The filtered signals; phi and other signals are unchanged.
    PrefilterReport
        What was removed.

    Raises
    ------
    UsageError
        When the size of the median is not odd.
    DataError
        When p or phi is missing, when phi does not fit the speed, or when map and recording differ in channels or
        operating point.
    """
    if position not in rec.signals:
        raise DataError(
            f"recording {rec.name!r} has no signal {position!r}; the prefilter works on the measured position, "
            f"name it (position=...); choose from {', '.join(rec.signals)}"
        )
    before = {name: values for name, values in rec.signals.items() if name not in _NO_MEAN}
    after = dict(before)
    notes = sensor_notes(rec, position)
    steps: list[str] = []
    share = np.zeros(before[position].shape[1])
    if runout_map is not None:
        after[position] = _without_runout(rec, position, runout_map, any_condition, notes)
        variance = before[position].var(axis=0)
        share = np.where(variance > 0, 1 - after[position].var(axis=0) / np.where(variance > 0, variance, 1), 0.0)
        steps.append(f"run-out map ({runout_map.method}) of {', '.join(runout_map.sources)} subtracted from {position}")
    for name, response in (answers or {}).items():
        if name not in after or name == position:
            raise DataError(f"recording {rec.name!r}: answers names {name!r}; choose from {', '.join(before)}")
        after[name] = _without_runout(rec, name, response, any_condition, notes)
        steps.append(
            f"answer of the loop to run-out ({response.method}) of {', '.join(response.sources)} subtracted from {name}"
        )
    despiked = remove_spikes(after[position], measured=before[position])
    counts = tuple(len(samples) for samples in despiked.samples)
    if spikes:
        after[position] = despiked.values
        if any(counts):
            steps.append(f"{sum(counts)} spikes of {position} replaced")
    elif any(counts) and median == 1:
        text = f"{sum(counts)} spikes of {position} were found and not replaced; spikes: true replaces them"
        notes.append(DataNote.SPIKES_LEFT(text))
    offsets = {name: values.mean(axis=0) * remove_mean for name, values in after.items()}
    if remove_mean:
        after = {name: values - offsets[name] for name, values in after.items()}
        steps.append(f"means of {', '.join(after)} removed")
    after[position] = running_median(after[position], median)
    if median > 1:
        steps.append(f"median of {median} on {position}")
    report = PrefilterReport(
        name=rec.name,
        channels={name: rec.channels[name] for name in before},
        units={name: rec.units[name] for name in before},
        rms_before={name: values.std(axis=0) for name, values in before.items()},
        rms_after={name: values.std(axis=0) for name, values in after.items()},
        offsets=offsets,
        runout_share=share,
        harmonics=runout_map.amplitudes() if runout_map else np.zeros((0, before[position].shape[1])),
        spikes=counts,
        median=median,
        spike_samples=tuple(tuple(int(k) for k in samples) for samples in despiked.samples),
        map_sources=runout_map.sources if runout_map else (),
        notes=tuple(notes),
    )
    earlier = rec.provenance.get("prefilter")
    text = "; ".join([*([earlier] if earlier else []), *(steps or ["nothing removed"])])
    filtered = replace(rec, signals={**rec.signals, **after}, provenance={**rec.provenance, "prefilter": text})
    return filtered, report


def _without_runout(
    rec: Recording, position: str, runout_map: RunoutMap, any_condition: bool, notes: list[str]
) -> FloatArray:
    """Return the position minus the run-out map at the recorded angles."""
    p = rec.signal(position)
    if rec.channels[position] != runout_map.channels:
        raise DataError(
            f"recording {rec.name!r}: {position} has the channels {', '.join(rec.channels[position])}, the run-out map "
            f"{', '.join(runout_map.channels)}; make the map from recordings of the same sensors"
        )
    try:
        runout_map.check_conditions(rec.name, rec.conditions)
    except DataError as error:
        if not any_condition:
            raise
        notes.append(DataNote.OTHER_CONDITION(str(error).split(";")[0]))
    notes.extend(runout_map.notes)
    if not runout_map.needs_angle:
        return np.asarray(p - runout_map.mean)
    return np.asarray(p - runout_map.evaluate(shaft_motion(rec).angle))


# ---- Online prefilter, sample by sample; equal to the offline filter where no spike is found.


class OnlinePrefilter:
    """Online prefilter: run-out map, constant offset and median, one sample at a time (paper, Sec. 3.5 and conclusion).

    The results are those of `gbid.prefilter` on the whole recording, to the last bit, with three differences that every
    causal filter has:

    - Spikes stay. To tell a spike from a step of the signal, the offline filter needs later samples: seven to judge a
      sample, two to replace it. Where the offline filter finds no spike, both filters agree. A controller that must not
      see spikes takes ``median=3``.
    - The median of 3 needs the next sample. `step` therefore returns the value of ``median // 2`` samples ago: one
      sample (0.2 ms) for the median of 3 in the paper, none for ``median=1``. The first ``median // 2`` calls return
      None. `finish` returns the remaining values.
    - The mean of a recording is known only at its end. Online it is replaced by a constant `offset`. The default zero
      makes the mean of the map the zero and equals the offline filter with ``remove_mean=False``. With
      ``offset=report.offsets["p"]`` of an earlier recording the same mean is removed as from that one.

    Parameters
    ----------
    runout_map : RunoutMap or None
        Map from `gbid.identify_runout` at the present operating point; None removes no run-out.
    offset : (n_channels,) array, optional
        Offset that is subtracted after the map [m]; zero by default.
    median : int
        Size of the median, odd; 1 for none.

    Raises
    ------
    UsageError
        When `median` is not odd and positive, or when `offset` does not fit the channels of the map.

    Examples
    --------
    >>> online = OnlinePrefilter(None, median=3)
    >>> [online.step([value], None) for value in (0.0, 1.0, 2.0)]
    [None, array([0.]), array([1.])]
    >>> online.finish()
    [array([2.])]
    """

    @checks_arguments
    def __init__(self, runout_map: RunoutMap | None, *, offset: npt.ArrayLike | None = None, median: int = 1) -> None:
        if median < 1 or median % 2 == 0:
            raise UsageError(f"median = {median}; give an odd number of samples, 1 for none")
        self._map = runout_map
        self._offset = None if offset is None else np.atleast_1d(np.asarray(offset, dtype=float))
        if runout_map is not None and self._offset is not None and self._offset.shape != runout_map.mean.shape:
            raise UsageError(
                f"offset has shape {self._offset.shape}, the run-out map {runout_map.mean.shape}; give one a channel"
            )
        self._half = median // 2
        self._window: deque[FloatArray] = deque(maxlen=median)
        self.start()

    @property
    def delay(self) -> int:
        """Delay of the output in samples: half the width of the median filter, rounded down."""
        return self._half

    def change_map(self, runout_map: RunoutMap) -> None:
        """Use another map from the next sample on, as at a new operating point; the state is kept.

        Parameters
        ----------
        runout_map : RunoutMap
            The new map, of the same channels.

        Raises
        ------
        UsageError
            When the channels differ.
        """
        if self._map is None or self._map.mean.shape != runout_map.mean.shape:
            raise UsageError("change_map: the new run-out map has other channels than the one before")
        self._map = runout_map

    def start(self) -> None:
        """Reset the filter and forget all earlier samples."""
        self._window.clear()
        self._count = 0

    def step(self, position: Sequence[float] | FloatArray, angle: float | None) -> FloatArray | None:
        """Return the next filtered position, from one more sample.

        Parameters
        ----------
        position : (n_channels,) sequence of float
            Measured disc position [m].
        angle : float or None
            Shaft angle [rad], wrapped or not; None is allowed when the map needs no angle.

        Returns
        -------
        (n_channels,) array or None
            The filtered position of `delay` samples ago [m]; None for the first samples.

        Raises
        ------
        DataError
            When a number is not finite, when the channels do not fit the map, or when the angle is missing. The state
            is not changed, so the caller may leave the sample out and go on.
        """
        newest = self._without_runout(np.asarray(position, dtype=float), angle)
        self._window.append(newest)
        self._count += 1
        if self._count <= self._half:
            return None
        if self._count <= 2 * self._half:  # the first samples stay as they are, as offline
            return self._window[self._count - 1 - self._half].copy()
        return np.asarray(np.sort(np.array(self._window), axis=0)[self._half])

    def finish(self) -> list[FloatArray]:
        """Return the last values, not changed by the median as in the offline filter, and reset the filter.

        Returns
        -------
        list of (n_channels,) array
            At most `delay` values, the oldest first [m].
        """
        held = min(self._half, self._count)
        rest = list(self._window)[len(self._window) - held :]
        self.start()
        return rest

    def _without_runout(self, position: FloatArray, angle: float | None) -> FloatArray:
        if position.ndim != 1 or not np.isfinite(position).all():
            raise DataError(f"position {position} is not one sample of finite numbers; leave the sample out")
        runout_map, value = self._map, position
        if runout_map is not None:
            if position.shape != runout_map.mean.shape:
                raise DataError(f"position has {len(position)} channels, the run-out map {len(runout_map.mean)}")
            if not runout_map.needs_angle:
                value = value - runout_map.mean
            elif angle is None or not np.isfinite(angle):
                raise DataError(f"angle = {angle}; the run-out map needs the shaft angle [rad] of each sample")
            else:
                value = value - runout_map.evaluate(np.array([float(angle)]))[0]
        return np.asarray(value if self._offset is None else value - self._offset)


# ---- HDF5 files of run-out maps and prefilter reports; docs/file-formats.md describes the tree.


@dataclass(frozen=True, eq=False)
class _Signal:
    """Report entries of one signal."""

    channels: Annotated[tuple[str, ...], Stored(shape="channels")]
    rms_before: Annotated[FloatArray, Stored("unit", "rms about the mean before the prefilter", "channels")]
    rms_after: Annotated[FloatArray, Stored("unit", "rms about the mean after the prefilter", "channels")]
    offset: Annotated[FloatArray, Stored("unit", "mean removed", "channels")]


def correction_rows(reports: Iterable[PrefilterReport]) -> list[Row]:
    """Return the prefilter's corrections of each channel of p as plain values, in the unit of p."""
    return [
        {
            "recording": report.name,
            "channel": f"p_{channel}",
            "unit": report.units["p"],
            "rms_before": float(report.rms_before["p"][i]),
            "rms_after": float(report.rms_after["p"][i]),
            "offset": float(report.offsets["p"][i]),
            "runout_share": float(report.runout_share[i]),
            "harmonics": [float(amplitude) for amplitude in report.harmonics[:, i]],
            "spikes": report.spikes[i],
            "first_spikes": list(report.spike_samples[i][:_SHOWN_SPIKES]) if report.spike_samples else [],
            "notes": list(report.notes),
        }
        for report in reports
        for i, channel in enumerate(report.channels["p"])
    ]


def correction_table(rows: Sequence[Row]) -> Table:
    """Return the table of the prefilter's corrections, from `correction_rows`."""
    units = list(dict.fromkeys(row["unit"] for row in rows))
    factor, unit = shown_unit(units[0]) if len(units) == 1 else (1.0, " or ".join(units))
    columns = [
        Column("recording"),
        Column("rms\nbefore\n", unit, ".3f"),
        Column("after\n", unit, ".3f"),
        Column("offset\n", unit, ".3f"),
        Column("run-out\nshare", format=".1%"),
        Column("harmonics\n1, 2, 3", unit),
        Column("spikes", format="d"),
    ]
    laid = []
    for row in rows:
        harmonics = " ".join(f"{factor * amplitude:.2f}" for amplitude in row["harmonics"][:3]) or None
        sizes = (factor * row[key] for key in ("rms_before", "rms_after", "offset"))
        laid.append([f"{row['recording']} {row['channel']}", *sizes, row["runout_share"], harmonics, row["spikes"]])
    return Table("Prefilter: what it removed from each channel", columns, laid)


@dataclass(frozen=True, eq=False)
class PrefilterFile(hdf5.InFile):
    """Run-out map of an operating point, and the reports on the recordings corrected with it.

    Attributes
    ----------
    runout_map : RunoutMap or None
        The map.
    reports : tuple of PrefilterReport
        The reports.
    """

    runout_map: RunoutMap | None = None
    reports: tuple[PrefilterReport, ...] = ()
    FILE: ClassVar[hdf5.FileKind] = hdf5.FileKind("prefilter", "make it again with `gbid run`")

    def document(self) -> Row:
        """Return the prefilter's corrections of each channel as plain values, for JSON."""
        return {"prefilter": correction_rows(self.reports)}

    def tables(self) -> list[Table]:
        """Return the table of the prefilter's corrections."""
        return [correction_table(correction_rows(self.reports))]

    def to_hdf5(self, group: h5py.Group) -> None:
        """Write map and reports to a `group`."""
        if self.runout_map is not None:
            _write_map(group.create_group("runout_map"), self.runout_map)
        reports = group.create_group("reports")
        for number, report in enumerate(self.reports):
            _write_report(reports.create_group(f"{number:04d}"), report)

    @classmethod
    def from_hdf5(cls, group: h5py.Group) -> PrefilterFile:
        """Return map and reports from a `group` written by `to_hdf5`."""
        runout_map = hdf5.read_fields(group["runout_map"], RunoutMap) if "runout_map" in group else None
        return cls(runout_map, tuple(_read_report(report) for report in hdf5.read_group(group, "reports").values()))


def save_prefiltered(filtered: Recording, report: PrefilterReport, path: Path) -> None:
    """Write a prefiltered recording and its report (group ``prefilter_report``); an existing file is replaced."""
    with hdf5.writing(path, Recording.FILE, overwrite=True) as file:
        filtered.to_hdf5(file)
        _write_report(file.create_group("prefilter_report"), report)


def read_report(path: str | Path) -> PrefilterReport:
    """Return the report in a file of a prefiltered recording.

    Raises
    ------
    DataError
        When the file is missing, unreadable, incomplete or of another kind.
    """
    with hdf5.reading(path, Recording.FILE) as file:
        return _read_report(hdf5.read_group(file, "prefilter_report"))


def _write_map(group: h5py.Group, runout_map: RunoutMap) -> None:
    hdf5.write_fields(group, runout_map)
    hdf5.add_dataset(group, "amplitudes", runout_map.amplitudes(), "m", "amplitudes of the harmonics 1, 2, ...")
    group.attrs["signal"], axis = ("table", "angles") if runout_map.method == "bins" else ("cosine", "orders")
    hdf5.add_texts(group, "axes", [axis, "."])


def _write_report(group: h5py.Group, report: PrefilterReport) -> None:
    hdf5.write_fields(group, report)
    if report.spike_samples:
        places = np.array([k for samples in report.spike_samples for k in samples], dtype=np.int64)
        hdf5.add_dataset(group, "spike_samples", places, "1", "numbers of the wrong samples, channel by channel")
    hdf5.add_texts(group, "signals", report.channels)
    for name, channels in report.channels.items():
        signal = _Signal(channels, report.rms_before[name], report.rms_after[name], report.offsets[name])
        hdf5.write_fields(group.create_group(name), signal, {"unit": report.units[name]})


def _read_report(group: h5py.Group) -> PrefilterReport:
    names = hdf5.read_texts(group, "signals")
    signals = {name: hdf5.read_fields(hdf5.read_group(group, name), _Signal) for name in names}
    report = hdf5.read_fields(
        group,
        PrefilterReport,
        channels={name: signal.channels for name, signal in signals.items()},
        units={name: hdf5.read_text(group, "units", f"{name}/offset") for name in names},
        rms_before={name: signal.rms_before for name, signal in signals.items()},
        rms_after={name: signal.rms_after for name, signal in signals.items()},
        offsets={name: signal.offset for name, signal in signals.items()},
    )
    return replace(report, spike_samples=_spike_samples(group, report.spikes))


def _spike_samples(group: h5py.Group, counts: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
    """Return the sample numbers of each channel's spikes; empty if the prefilter did not search spikes."""
    if "spike_samples" not in group:
        return ()
    places = hdf5.read_dataset(group, "spike_samples")
    if places.shape != (sum(counts),):
        raise hdf5.DamagedError(f"{group.name}/spike_samples has shape {places.shape}, expected ({sum(counts)},)")
    parts = np.split(places, np.cumsum(counts)[:-1])
    return tuple(tuple(int(k) for k in part) for part in parts)
