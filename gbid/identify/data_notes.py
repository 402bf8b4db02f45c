"""Notes on data that spoil a fit unnoticed: wrong units, equal recordings, clipping, spikes, acausal outputs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain, combinations

import numpy as np

from gbid.core.arrays import BoolArray, FloatArray
from gbid.core.notes import DataNote, FitNote
from gbid.identify.data import FitData, Record, centred_rows, column_variances
from gbid.identify.pose import FitTask
from gbid.identify.problem.assemble import counted_samples
from gbid.recording.cause import lead_before
from gbid.recording.quality import stays_at_limits
from gbid.structure.built_in import KEY_PARAMETERS

_MOTION = 2e-4  # [m] the clearance of a gas bearing and the travel of a piezo are some ten micrometres, that of a
# magnetic one some tenths of a millimetre
_PER_CURRENT = "k_i_"  # parameters of `gbid.structure.RigidRotor`, one for each axis
_GAIN = 300.0  # that of a resonance with a damping factor of 0.0017; a prefix of a unit is a factor of 1000 or more
_ABOVE = 20.0  # times the value that 99 % of the samples keep: 50 standard deviations of Gaussian noise
_ALONE = 10.0  # times the samples around: a response that decays has neighbours of its size
_BESIDE, _AROUND = 3, 20  # samples to both sides that may belong to a spike, and that show what is around it
_MOST = 50  # spikes that are looked at
_SAME = 1e-2  # part of an input that no other explains, below which standard deviations are a hundred times larger


def data_notes(task: FitTask) -> Iterator[str]:
    """Yield notes on faults of the data that the fit cannot detect.

    With the key parameters of the paper in its structure all signals are motions in metres; with those of magnetic
    bearings the positions are, which are the last outputs.
    """
    data, left_out = task.data, task.options.left_out or {}
    if not data.records:
        return
    names, n_outputs = {q.name for q in task.parameters}, len(data.output_names)
    axes = sum(name.startswith(_PER_CURRENT) for name in names)
    if set(KEY_PARAMETERS) <= names:
        pairs = [("outputs", slice(i, i + 2)) for i in range(0, n_outputs, 2)]
        yield from _units(data, [("inputs", slice(0, 2)), *pairs])
    elif axes:
        yield from _units(data, [("outputs", slice(n_outputs - axes, n_outputs))])
    yield from _twins(data.records)
    yield from _same_inputs(data)
    for record in data.records:
        counts = counted_samples(record, left_out.get(record.name, ()))
        yield from _clipped(record, (*data.input_names, *data.output_names), counts)
        yield from _spikes(record, data.output_names, counts)
        yield from _early_answers(record, data)


def _units(data: FitData, motions: Sequence[tuple[str, slice]]) -> Iterator[str]:
    """Yield a note on motions that are not in metres, judged by their size and by ratios of sizes.

    `motions` are the channels of a signal each: "inputs" or "outputs", and their columns.
    """
    for record in data.records:
        sizes = [np.sqrt(column_variances(getattr(record, side)[:, columns])) for side, columns in motions]
        largest = max(float(size.max(initial=0.0)) for size in sizes)
        if largest > _MOTION:
            yield FitNote.UNITS(
                f"recording {record.name!r}: motions have a standard deviation of {largest:.2g} m, far more than the "
                "clearance of a bearing: give metres, as gbid.import_recording makes them from unit: um"
            )
            return
        first, *others = (float(np.linalg.norm(size)) for size in sizes)
        for (side, columns), size in zip(motions[1:], others, strict=True):
            if first > 0 and not 1 / _GAIN < size / first < _GAIN:
                names = ", ".join((data.input_names if side == "inputs" else data.output_names)[columns])
                yield FitNote.UNITS(
                    f"recording {record.name!r}: {names} are {size / first:.2g} times the inputs, where a bearing has "
                    "a gain of about one: are both in metres"
                )
                return


def _twins(records: Sequence[Record]) -> Iterator[str]:
    """Yield a note on each recording whose samples equal another recording's."""
    groups: dict[tuple[int, float], list[Record]] = {}  # else many recordings would be compared with each other
    for record in records:
        groups.setdefault((record.n_samples, float(record.outputs.sum())), []).append(record)
    for one, other in chain.from_iterable(combinations(group, 2) for group in groups.values()):
        if np.array_equal(one.outputs, other.outputs) and np.array_equal(one.inputs, other.inputs):
            yield FitNote.TWINS(
                f"recordings {one.name!r} and {other.name!r} have the same samples, which make "
                "standard deviations too small; leave one out"
            )


def _clipped(record: Record, names: Sequence[str], counts: BoolArray) -> Iterator[str]:
    """Yield a note on each channel that stays at its largest or smallest value, as at the limit of a sensor."""
    for name, column in zip(names, chain(record.inputs.T, record.outputs.T), strict=True):
        if limits := stays_at_limits(column[counts]):
            yield DataNote.CLIPPED(
                f"recording {record.name!r}: {name!r} is clipped: {sum(limits.values())} samples stay at "
                f"{' and '.join(f'{limit:.4g}' for limit in limits)}; estimates are wrong by more than their standard "
                "deviations; widen the range of the sensor, or leave those samples out (left_out=...)"
            )


def _spikes(record: Record, names: Sequence[str], counts: BoolArray) -> Iterator[str]:
    """Yield a note on each output with spikes: isolated samples far beyond nearly all others."""
    rank, (size, ordered) = int(0.99 * record.n_samples), np.empty((2, record.n_samples))
    for name, column in zip(names, record.outputs.T, strict=True):
        ordered[:] = column
        np.abs(np.subtract(column, np.median(ordered, overwrite_input=True), out=size), out=size)
        ordered[:] = size
        ordered.partition(rank)
        usual = float(ordered[rank])
        spikes = [i for i in np.flatnonzero((size > _ABOVE * usual) & counts)[:_MOST].tolist() if _alone(size, i)]
        if usual > 0 and spikes:
            yield FitNote.SPIKE(
                f"recording {record.name!r}: output {name!r} has a spike at sample {spikes[0]}, "
                f"{size[spikes[0]] / usual:.0f} times what 99 % of the samples keep; remove it (gbid.prefilter, "
                "left_out=...), or weight outliers less (robust=...)"
            )


def _alone(size: FloatArray, at: int) -> bool:
    before, after = size[max(0, at - _AROUND) : max(0, at - _BESIDE)], size[at + _BESIDE + 1 : at + _AROUND + 1]
    return bool(size[at] > _ALONE * np.concatenate([before, after]).max(initial=0.0))


def _same_inputs(data: FitData) -> Iterator[str]:
    """Yield a note on each pair of inputs that are nearly proportional in all recordings."""
    centred = (centred_rows(record.inputs) for record in data.records)
    products = np.asarray(sum(rows @ rows.T for rows in centred))
    size = np.sqrt(np.diag(products))
    for i, j in combinations(np.flatnonzero(size > 0).tolist(), 2):
        cosine = float(products[i, j] / (size[i] * size[j]))
        difference = float(np.sqrt(max(0.0, 1 - cosine**2)))
        if difference < _SAME:
            yield FitNote.SAME_INPUTS(
                f"inputs {data.input_names[i]!r} and {data.input_names[j]!r} are the same to {difference:.1g} of their "
                "size: only their sum is known well; move them independently, or fit one of them"
            )


def _early_answers(record: Record, data: FitData) -> Iterator[str]:
    """Yield a note on an output that responds more than a sample before steps of the inputs."""
    lead = None if record.missing is not None else lead_before(record.inputs, record.outputs)
    if lead:
        yield FitNote.BEFORE_CAUSE(
            f"recording {record.name!r}: output {data.output_names[lead.channel]!r} moves about {lead.samples} samples "
            f"({lead.samples * data.sample_time:.2g} s) before steps of the inputs, which no model of the fit can do: "
            "the columns have different clocks, or one begins later; align them"
        )
