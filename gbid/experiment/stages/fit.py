"""Stage of the fits: checks of sections, arguments of `gbid.fit`, tasks, and stored documents."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from functools import lru_cache, partial
from itertools import islice
from math import inf, nan
from pathlib import Path
from typing import Any

import numpy as np

from gbid import identify
from gbid.core import hdf5
from gbid.core.errors import DataError, GbidError, nearest
from gbid.core.hdf5 import document_in, read_document, read_group, read_texts, reading, save
from gbid.core.index import DOCUMENT, known, version_of
from gbid.core.tables import Row
from gbid.experiment.controllers import found_controller
from gbid.experiment.experiment import Experiment, PlannedRecording, fit_models, recordings_of
from gbid.experiment.fields import Found, Item, Location, Result, file_digest, refusal
from gbid.experiment.machine import true_model, true_values
from gbid.experiment.recordings import refuse_bad_signals
from gbid.experiment.run import Job, Made, Stage, Task
from gbid.experiment.schema import FitSection
from gbid.experiment.stages.prefilter import fit_input, load_fit_input
from gbid.experiment.structures import (
    fit_channels,
    fit_disturbances,
    make_structure,
    output_labels,
    plant_structure,
    structure_or_none,
    structure_settings,
)
from gbid.identify.fit_tables import fit_document
from gbid.identify.options import FitArguments
from gbid.identify.problem.states import initial_states
from gbid.identify.result import FitResult
from gbid.identify.table import MODE_BLOCKS, FitRow, TableEntry
from gbid.recording import Recording
from gbid.recording.quality import ProblemKind
from gbid.structure.kinds import AnyStructure, kind_of
from gbid.structure.parameter import asked_once
from gbid.validate.residuals import shaft_lines


def fits_can_be_made(experiment: Experiment) -> Found:
    """Yield problems of each fit: structure, recordings, parameters, signals, and unsuitable options."""
    for name, section in experiment.spec.fits.items():
        structure = structure_or_none(experiment, name)
        problems = [
            *_structure_problems(experiment, name, section),
            *_recording_problems(experiment, name, section),
            *_local_problems(experiment, name, section),
            *_left_out_problems(experiment, name, section),
            *_response_problems(experiment, name, section),
        ]
        if structure is not None:
            problems += _parameter_problems(experiment, name, section, structure)
            problems += _signal_problems(experiment, name, section)
            problems += _option_problems(experiment, name, section, structure)
        yield from ((("fits", name, *where), text) for where, text in problems)


def _structure_problems(experiment: Experiment, name: str, section: FitSection) -> Found:
    """Yield a problem when the structure is unknown or cannot be built."""
    problems = list(refusal((), partial(plant_structure, experiment, name)))
    yield from problems
    if problems:
        return
    if section.loop is not None:
        try:
            found_controller(experiment, section.loop, planned=True)
        except GbidError:
            return  # the checks of loops report a missing controller
    where = ("structure" if section.loop is None else "loop",)
    yield from refusal(where, lambda: kind_of(make_structure(experiment, name, planned=True)).anatomy())


def _recording_problems(experiment: Experiment, name: str, section: FitSection) -> Found:
    """Yield a problem for each pattern that matches no recording."""
    for pattern in section.recordings or ():
        if not experiment.matching((pattern,)):
            yield ("recordings",), f"no recording matches {pattern!r}; {nearest(pattern, experiment.recordings)}"
    if experiment.fit_recordings(name) or section.responses or section.recordings:
        return
    if experiment.recordings:
        yield (), "there are no excited recordings; name the recordings to fit, or responses"


def response_of(experiment: Experiment, fit: str, i: int) -> identify.FrequencyData:
    """Return the frequency responses in a file of a fit, for the channels of the fit.

    Raises
    ------
    DataError
        When the file cannot be read, or lacks a channel.
    UsageError
        When the structure cannot be made, or standard deviations are missing.
    """
    section = experiment.spec.fits[fit].responses[i]
    data = identify.FrequencyData.read(experiment.folder / section.file, averages=section.averages, std=section.std)
    return data.channels(*fit_channels(experiment, fit), reference=section.reference or ())


def _response_problems(experiment: Experiment, name: str, section: FitSection) -> Found:
    """Yield a problem for each file of a frequency response that cannot be read."""
    for i in range(len(section.responses)):
        yield from refusal(("responses", i), partial(response_of, experiment, name, i))
    if not section.responses:
        return
    from gbid.identify.frequency_fit import refuse_other_options

    if not experiment.fit_recordings(name):
        if section.loop is not None and section.loop.beside is not None:
            yield ("loop", "beside"), "compares fits of recordings; this one has frequency responses alone: remove it"
        yield from refusal((), lambda: refuse_other_options(FitArguments(**fit_arguments(experiment, name, ()))))
    if section.responses and section.local:
        yield ("local",), "frequency responses need parameters that all recordings share; leave one of the two out"


def _parameter_problems(experiment: Experiment, name: str, section: FitSection, structure: AnyStructure) -> Found:
    """Yield problems of parameter names, start values, fixed values and bounds."""
    known = {q.name: q for q in structure.parameters}
    disturbing: Sequence[str] = ()  # coefficients of trends and hum, which have priors as well
    with suppress(GbidError):  # another check reports their options
        disturbing = fit_disturbances(experiment, name, structure).names
    starts: Mapping[str, float] = section.start if isinstance(section.start, Mapping) else {}
    given = {"start": starts, "fixed": section.fixed, "bounds": section.bounds, "prior": section.prior}
    for key, parameters in {**given, "local": section.local}.items():
        for parameter in parameters:
            gain = parameter.partition("[")[0]
            if key == "prior" and gain in disturbing:
                continue
            if (gain if key == "prior" else parameter) not in known:
                yield (key, parameter), f"no parameter of {structure.name}; {nearest(parameter, known)}"
            elif key != "fixed" and gain in section.fixed:
                yield (key, parameter), "the parameter is fixed; remove one of the two"
    for i, parameter in enumerate(() if section.profile == "all" else section.profile):
        if parameter not in known:
            yield ("profile", i), f"no parameter of {structure.name}; {nearest(parameter, known)}"
    for parameter in known.keys() & {**starts, **section.bounds}:
        where, plain = ("bounds" if parameter in section.bounds else "start", parameter), known[parameter]
        low, high = section.bounds.get(parameter, (plain.lower, plain.upper))
        bounds = {"lower": -inf if low is None else low, "upper": inf if high is None else high}
        start = None if section.start == "data" else starts.get(parameter, plain.start)
        yield from refusal(where, partial(replace, plain, start=start, fixed=False, **bounds))


def _signal_problems(experiment: Experiment, name: str, section: FitSection) -> Found:
    """Yield a problem for each signal or channel that a recording of the fit does not have."""
    inputs, outputs = fit_channels(experiment, name)
    for key, given, used in (("inputs", section.inputs, inputs), ("outputs", section.outputs, outputs)):
        for wanted in used:
            for text in islice(_missing(experiment.fit_recordings(name), *wanted.partition(".")[::2]), 1):
                yield (key,) if given else (), text


def _missing(recordings: Sequence[PlannedRecording], signal: str, channel: str) -> Iterator[str]:
    for planned in recordings:
        if signal not in planned.signals:
            yield f"recording {planned.name!r} has no signal {signal!r}; {nearest(signal, planned.signals)}"
        elif channel and channel not in planned.signals[signal]:
            hint = nearest(channel, planned.signals[signal])
            yield f"recording {planned.name!r}: signal {signal!r} has no channel {channel!r}; {hint}"


def _option_problems(experiment: Experiment, name: str, section: FitSection, structure: AnyStructure) -> Found:
    """Yield a problem for each option that does not suit the states, outputs and disturbances of the structure."""
    labels = output_labels(experiment, name, structure)
    if labels:
        yield from refusal((), partial(fit_disturbances, experiment, name, structure))
    try:
        anatomy = kind_of(structure).anatomy()
    except GbidError:
        return  # another check reports it
    for key, given in (("prior", section.prior), ("local", section.local)):
        for parameter in given:
            if section.focus == "simulation" and parameter.partition("[")[0] in anatomy.gain_only:
                yield (key, parameter), "a simulation does not use the disturbance gain; remove it"
    weights = section.output_weights
    if weights is not None and labels and len(weights) != len(labels):
        yield ("output_weights",), f"{len(weights)} weights for {len(labels)} outputs: {', '.join(labels)}"
    if weights is not None and section.criterion == "det":
        yield ("output_weights",), "are for criterion: trace; det weighs outputs by their errors"
    used = dict.fromkeys(q.name for q in experiment.fit_recordings(name))
    free = [q for q in structure.parameters if q.name not in section.fixed]
    yield from refusal(("initial_state",), partial(initial_states, structure, free, section.initial_state, [*used]))


def _local_problems(experiment: Experiment, name: str, section: FitSection) -> Found:
    """Yield a problem for local parameters of a fit to a single recording, or without operating points."""
    planned = experiment.fit_recordings(name)
    if section.local and (not section.together or len(planned) < 2):
        yield ("local",), "is for a fit to several recordings at once; write together: true"
        return
    silent = [q.name for q in planned if not {"pressure_bar", "speed_rpm"} <= set(q.conditions)]
    for parameter, scope in section.local.items():
        if scope == "operating_point" and silent:
            text = f"recording {silent[0]!r} has no pressure_bar and speed_rpm; add them to its conditions"
            yield ("local", parameter), text


def _left_out_problems(experiment: Experiment, name: str, section: FitSection) -> Found:
    """Yield a problem for each left-out stretch outside a recording of the fit."""
    rig, used = experiment.spec.rig, {q.name: q for q in experiment.fit_recordings(name)}
    for recording, stretches in section.left_out.items():
        if recording not in used:
            yield ("left_out", recording), f"no recording of this fit; {nearest(recording, used)}"
            continue
        for i, (begin, end) in enumerate(stretches):
            if end <= begin:
                yield ("left_out", recording, i), f"{end:g} s is not after {begin:g} s; make it larger"
            elif rig is not None and used[recording].imported is None and end > rig.duration_s:
                text = f"{end:g} s is beyond the end of the recording, {rig.duration_s:g} s; end it there"
                yield ("left_out", recording, i), text


def a_fit_is_named(experiment: Experiment, where: Location, name: str, needed: Sequence[str], remedy: str) -> Found:
    """Yield problems of a section that needs a fit with one model per recording.

    Parameters
    ----------
    experiment : Experiment
    where : Location
        Entry with the name of the fit.
    name : str
        Fit that is named there.
    needed : sequence of str
        Parameters that its structure must have.
    remedy : str
        Which fit to name instead.
    """
    if name not in experiment.spec.fits:
        yield where, f"no fit of this name; {nearest(name, experiment.spec.fits)}"
        return
    if experiment.spec.fits[name].together or not experiment.fit_recordings(name):
        yield where, f"{name} is one model for all its data; name a fit per recording"
    structure = structure_or_none(experiment, name)
    missing = [n for n in needed if n not in {q.name for q in structure.parameters}] if structure else []
    if missing:
        yield where, f"{name} has no parameters {', '.join(missing)}; {remedy}"


FOLDER = "fits"
_OWN_KINDS: tuple[ProblemKind, ...] = ("constant", "saturated", "too_few_samples")


def fit_tasks(job: Job, only: str | None = None) -> list[Task]:
    """Return the tasks of all fits, or of one named fit."""
    return [
        Task.of(
            fit_result(job.experiment, name, model),
            partial(_write_fit, name=name, model=model),
            recordings,
            read_fit_summary,
        )
        for name in (job.experiment.spec.fits if only is None else [only])
        for model, recordings in fit_models(job.experiment, name).items()
    ]


def fit_result(experiment: Experiment, name: str, model: str) -> Result:
    """Return the result file of one model of a fit."""
    section, recordings = experiment.spec.fits[name], recordings_of(experiment, name, model)
    settings = section.model_dump(exclude={"structure", "options", "loop", "recordings", "together", "responses"})
    settings["left_out"] = {recording: settings["left_out"].get(recording) for recording in recordings}
    settings["structure"] = structure_settings(experiment, name)
    settings["recordings"] = recordings
    if section.responses:
        files = [(file_digest(experiment.folder / each.file), each.model_dump()) for each in section.responses]
        settings["responses"] = files
    sources = [fit_input(experiment, experiment.recordings[recording]) for recording in recordings]
    return experiment.result(Item("fit", name, model), FOLDER, settings, sources)


def read_fit_summary(path: Path) -> Made:
    """Return status and smallest fit percent of an existing fit result.

    Raises
    ------
    DataError
        When the file is damaged.
    """
    return Made(*known(path, "fit", _summary))


def _summary(path: Path) -> tuple[str, bool, float]:
    document = read_document(path, identify.FitResult.FILE)
    return (
        document["status"],
        document["success"],
        min((q["fit_percent"] for q in document["fit_percent"]), default=nan),
    )


def table_row(path: Path) -> FitRow:
    """Return the row of a fit in a campaign table from its document, ten times faster than from the fit.

    Raises
    ------
    DataError
        When the file is damaged.
    """
    with reading(path, identify.FitResult.FILE) as file:
        document, covariance = document_in(file), identify.FitResult.covariance_in(file)
        free = read_texts(read_group(file, "parameters"), "free")
    percents: dict[str, list[float]] = {}
    for row in document["fit_percent"]:
        percents.setdefault(row["output"], []).append(row["fit_percent"])
    blocks: dict[str, dict[Any, float | None]] = {
        "values": {q["parameter"]: q["estimate"] for q in document["parameters"]},
        "std": {q["parameter"]: q["std"] for q in document["parameters"]},
        "fit_percent": {output: float(np.min(each)) for output, each in percents.items()},
        "static_gain": {f"{q['input']} to {q['output']}": q["gain"] for q in document["static_gain"]},
        "static_gain_std": {f"{q['input']} to {q['output']}": q["std"] for q in document["static_gain"]},
        **{block: dict(enumerate(q[block.removeprefix("mode_")] for q in document["modes"])) for block in MODE_BLOCKS},
    }
    return FitRow(
        **{key: document[key] for key in ("structure", "success", "status", "iterations", "wall_time_s")},
        notes=tuple(document["notes"]),
        units={q["parameter"]: q["unit"] for q in document["parameters"]},
        free=free,
        covariance=covariance,
        numbers={
            block: {name: nan if value is None else value for name, value in numbers.items()}
            for block, numbers in blocks.items()
        },
    )


def load_made_fit(job: Job, name: str, model: str) -> identify.FitResult:
    """Return the stored result of a fit for the present settings.

    Raises
    ------
    DataError
        When the result is missing or was made from other settings.
    """
    path = fit_result(job.experiment, name, model).require()
    return _load(path, version_of(path))


@lru_cache(maxsize=256)
def _load(path: Path, _version: tuple[int, ...]) -> identify.FitResult:
    """Return the fit in a file; cached, because several later stages read it."""
    return hdf5.load(path, FitResult)


def fit_entries(job: Job, name: str) -> list[TableEntry]:
    """Return the rows of all models of a fit for `gbid.identify.table.tabulate`; a missing model has a reason."""
    entries = []
    for model, recordings in fit_models(job.experiment, name).items():
        conditions = job.experiment.recordings[recordings[0]].conditions if recordings else {}
        try:
            result, failure = load_made_fit(job, name, model), ""
        except (DataError, OSError) as error:
            result, failure = None, str(error)
        entries.append(TableEntry(name, model, tuple(recordings), conditions, result, failure))
    return entries


def fit_arguments(experiment: Experiment, name: str, data: Sequence[Recording]) -> dict[str, Any]:
    """Return the keyword arguments of `gbid.fit` from a fits section and recordings."""
    section = experiment.spec.fits[name]
    hold, state = section.intersample, section.initial_state
    return {
        **{option.name: getattr(section, option.name) for option in fields(identify.FitOptions)},
        "intersample": hold[0] if hold and len(hold) == 1 else hold,
        "bounds": {
            key: (-inf if low is None else low, inf if high is None else high)
            for key, (low, high) in section.bounds.items()
        },
        "prior": {key: (known.value, known.std) for key, known in section.prior.items()},
        "initial_state": {recording.name: state[recording.name] for recording in data}
        if isinstance(state, Mapping)
        else state,
        "left_out": {
            recording.name: stretches for recording in data if (stretches := left_out_of(experiment, name, recording))
        },
    }


def samples_of(recording: Recording, from_s: float, to_s: float) -> tuple[int, int]:
    """Return the sample range (first, stop) between two times [s].

    Raises
    ------
    DataError
        When no sample lies between the times, or the end lies beyond the recording.
    """
    ends = np.append(recording.time, recording.duration) / recording.sample_time
    first, stop = (int(np.searchsorted(ends, t / recording.sample_time - 1e-6)) for t in (from_s, to_s))
    where = f"left_out: recording {recording.name!r}"
    if stop > recording.n_samples:
        end = recording.n_samples * recording.sample_time
        raise DataError(f"{where} ends at {end:g} s, before {to_s:g} s; make the stretch end there")
    if stop <= first:
        raise DataError(f"{where} has no sample from {from_s:g} s to before {to_s:g} s; widen it")
    return first, stop


def left_out_of(experiment: Experiment, name: str, data: Recording) -> list[tuple[int, int]]:
    """Return the samples of a recording that a fit leaves out, as (first, stop) pairs.

    Raises
    ------
    DataError
        When a stretch lies beyond the end of the recording.
    """
    return [samples_of(data, *stretch) for stretch in experiment.spec.fits[name].left_out.get(data.name, ())]


@asked_once()
def _write_fit(job: Job, part: Path, name: str, model: str) -> Made:
    inputs, outputs = fit_channels(job.experiment, name)
    data = []
    for recording in recordings_of(job.experiment, name, model):
        planned = job.experiment.recordings[recording]
        data.append(load_fit_input(job, planned))
        # The prefilter stage has checked prefiltered recordings already; only some kinds are checked here again.
        kinds = _OWN_KINDS if job.experiment.spec.prefilter else None
        refuse_bad_signals(planned, data[-1], [*inputs, *outputs], kinds=kinds, driving=inputs)
    structure, section = make_structure(job.experiment, name), job.experiment.spec.fits[name]
    arguments = fit_arguments(job.experiment, name, data)
    measured: list[Recording | identify.FrequencyData] = [*data]
    measured += (response_of(job.experiment, name, i) for i in range(len(section.responses)))
    if section.multi_start is None:
        result = identify.fit(structure, measured, progress=job.reporter.iteration, **arguments)
    else:
        options = section.multi_start.model_dump()
        result = identify.fit_multistart(
            structure, measured, **options, progress=job.reporter.iteration, **arguments
        ).best
    result = result.noted(*_suspects(job, name, result, data))
    save(result, part, overwrite=True, document=_document(job.experiment, structure, name, model, result))
    return Made(result.status, result.success, float(min(result.fit_percent.flat, default=nan)))


def _document(
    experiment: Experiment, structure: AnyStructure, name: str, model: str, result: identify.FitResult
) -> Row:
    """Return the document of a fit, with true values for recordings of the rig."""
    recordings = recordings_of(experiment, name, model)
    truth = true_values(experiment, recordings, structure) if recordings else {}
    return fit_document(result, truth, true_model(structure, truth, result.linear_model))


def made_document(job: Job, name: str, model: str) -> Row:
    """Return the stored document of a fit for the present settings.

    Raises
    ------
    DataError
        When the result is missing or was made from other settings.
    """
    path = fit_result(job.experiment, name, model).require()
    document: Row = known(path, DOCUMENT, partial(read_document, kind=identify.FitResult.FILE))
    return document


def _suspects(job: Job, name: str, result: identify.FitResult, data: Sequence[Recording]) -> list[str]:
    """Return notes on shaft harmonics in residuals that are not white: run-out that the prefilter left."""
    if result.trusted == "white":
        return []
    section, notes = job.experiment.spec.prefilter, []
    if section is None or section.method == "none":
        removed = "no run-out is removed"
    elif section.method == "harmonics" and section.harmonics != "auto":
        removed = (
            f"the prefilter removes {section.harmonics} harmonics; see what its map leaves, or write harmonics: auto"
        )
    else:
        removed = f"the prefilter removes run-out by method {section.method}; see what its map leaves"
    for rec in data:
        with suppress(GbidError):  # a model that overflows has a note of its own
            notes += [
                f"suspect for residuals that are not white: {rec.name}: {line.output} has a line of {line.rms:.2g} "
                f"{rec.units.get(line.output.rpartition('_')[0], '')} rms at {line.frequency_hz:.1f} Hz, "
                f"order {line.order} of the shaft; {removed}"
                for line in shaft_lines(result, rec, left_out_of(job.experiment, name, rec))
            ]
    return notes


FIT = Stage("fit", "fits", (fits_can_be_made,), fit_tasks, early=True)
"""``fits/<fit>/<recording>.h5``, or ``together.h5`` for a fit to all its recordings.

A fit that does not converge is written, too; its outcome reports that.
"""
