"""Prefilter that prepares measured signals for a linear model (paper, Sec. 3.5), with spikes found one by one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from gbid.arrays import FloatArray
from gbid.brief import Brief
from gbid.errors import DataError
from gbid.hdf5 import NOT_STORED, Stored
from gbid.notes.data_notes import DataNote
from gbid.prefilter.median import running_median
from gbid.prefilter.runout import RunoutMap
from gbid.prefilter.shaft import shaft_motion
from gbid.prefilter.spikes import remove_spikes
from gbid.recording import Recording

_NO_MEAN = ("phi", "force", "pressure_bar", "speed_rpm", "unbalance")  # these have no offset to remove


@dataclass(frozen=True, eq=False)
class PrefilterReport(Brief):
    """Report of the prefilter about one recording: what was removed.

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
        Their sample numbers, from 0, for each channel; empty for a report of gbid 0.1.0, which kept the number alone.
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
            f"name it (position=...): there are {', '.join(rec.signals)}"
        )
    before = {name: values for name, values in rec.signals.items() if name not in _NO_MEAN}
    after = dict(before)
    notes: list[str] = []
    steps: list[str] = []
    share = np.zeros(before[position].shape[1])
    if runout_map is not None:
        after[position] = _without_runout(rec, position, runout_map, any_condition, notes)
        variance = before[position].var(axis=0)
        share = np.where(variance > 0, 1 - after[position].var(axis=0) / np.where(variance > 0, variance, 1), 0.0)
        steps.append(f"run-out map ({runout_map.method}) of {', '.join(runout_map.sources)} subtracted from {position}")
    for name, own in (answers or {}).items():
        if name not in after or name == position:
            raise DataError(f"recording {rec.name!r}: answers names {name!r}; there are {', '.join(before)}")
        after[name] = _without_runout(rec, name, own, any_condition, notes)
        steps.append(f"answer of the loop to run-out ({own.method}) of {', '.join(own.sources)} subtracted from {name}")
    despiked = remove_spikes(after[position], measured=before[position])
    counts = tuple(len(samples) for samples in despiked.samples)
    if spikes:
        after[position] = despiked.values
        if any(counts):
            steps.append(f"{sum(counts)} spikes of {position} replaced")
    elif any(counts) and median == 1:
        text = f"{sum(counts)} spikes of {position} were found and left; spikes: true replaces them"
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
    """Return the position minus the map at the recorded angles."""
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
