"""Fits: checks of their sections, tasks, and arguments of `gbid.fit`."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

import numpy.typing as npt

from gbid.core.errors import DataError, GbidError
from gbid.core.hdf5 import read_attribute, read_dataset, reading
from gbid.experiment.controllers import found_controller
from gbid.experiment.experiment import Check, Experiment, fit_models, recordings_of
from gbid.experiment.fields import Found, Location, Result, nearest, refusal
from gbid.experiment.recordings import refuse_bad_signals
from gbid.experiment.rig_schema import LoopSection
from gbid.experiment.run import Job, Made, Stage, Task
from gbid.experiment.schema import FitSection, PrefilterSection
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
from gbid.identify import FitOptions, FitResult, TableEntry, fit, fit_multistart, load_fit, save_fit
from gbid.identify.problem.states import initial_states
from gbid.recording import ProblemKind, Recording
from gbid.structure import Anatomy, AnyStructure, Parameter, kind_of
from gbid.validate.residuals import shaft_lines


def structures_load(experiment: Experiment) -> Found:
    """Yield a problem for each fit whose structure is unknown or cannot be built."""
    for name, section in experiment.spec.fits.items():
        problems = list(refusal(("fits", name), partial(plant_structure, experiment, name)))
        yield from problems
        if problems or (section.loop is not None and not _controller_is_found(experiment, section.loop)):
            continue  # the checks of loops report a missing controller
        where = ("fits", name, "structure" if section.loop is None else "loop")
        yield from refusal(where, partial(_closed_structure, experiment, name))


def _closed_structure(experiment: Experiment, name: str) -> Anatomy:
    return kind_of(make_structure(experiment, name, planned=True)).anatomy()


def _controller_is_found(experiment: Experiment, section: LoopSection) -> bool:
    try:
        found_controller(experiment, section, planned=True)
    except GbidError:
        return False
    return True


def fits_find_recordings(experiment: Experiment) -> Found:
    """Yield a problem for each pattern that matches no recording."""
    for name, section in experiment.spec.fits.items():
        for pattern in section.recordings or ():
            if not experiment.matching((pattern,)):
                yield (
                    ("fits", name, "recordings"),
                    f"no recording matches {pattern!r}; {nearest(pattern, experiment.recordings)}",
                )
        if section.recordings is None and experiment.recordings and not experiment.fit_recordings(name):
            yield ("fits", name), "there are no excited recordings; name the recordings to fit"


def parameters_are_known(experiment: Experiment) -> Found:
    """Yield problems of parameter names, start values, fixed values and bounds."""
    for name, section in experiment.spec.fits.items():
        structure = structure_or_none(experiment, name)
        if structure is None:
            continue
        known = {q.name: q for q in structure.parameters}
        disturbing = _disturbing(experiment, name, structure)
        given: dict[str, Collection[str]] = {
            "start": _given_starts(section),
            "fixed": section.fixed,
            "bounds": section.bounds,
            "prior": section.prior,
            "local": section.local,
        }
        for key, parameters in given.items():
            for parameter in parameters:
                if key == "prior" and parameter.partition("[")[0] in disturbing:
                    continue
                if (parameter.partition("[")[0] if key == "prior" else parameter) not in known:
                    where = ("fits", name, key, parameter)
                    yield where, f"no parameter of {structure.name}; {nearest(parameter, known)}"
                elif key != "fixed" and parameter.partition("[")[0] in section.fixed:
                    yield ("fits", name, key, parameter), "the parameter is fixed; remove one of the two"
        yield from _bounds_hold(name, section, known)


def _disturbing(experiment: Experiment, fit: str, structure: AnyStructure) -> list[str]:
    """Return the names of the coefficients of trends and hum; none where another check reports their options."""
    try:
        return list(fit_disturbances(experiment, fit, structure).names)
    except GbidError:
        return []


def _given_starts(section: FitSection) -> Mapping[str, float]:
    """Return the start values of a section; none where the fit finds them in the data."""
    return section.start if isinstance(section.start, Mapping) else {}


def _bounds_hold(name: str, section: FitSection, known: Mapping[str, Parameter]) -> Found:
    """Yield a problem for bounds that are not in order or exclude the start value."""
    for parameter, (low, high) in section.bounds.items():
        where = ("fits", name, "bounds", parameter)
        lower, upper = float("-inf") if low is None else low, float("inf") if high is None else high
        if not lower < upper:
            yield where, f"the lower bound {lower:g} is not below the upper one {upper:g}; swap or change them"
        elif parameter in known:
            start = _given_starts(section).get(parameter, known[parameter].start)
            if start is not None and section.start != "data" and not lower <= start <= upper:
                yield where, f"the bounds exclude the start value {start:g}; widen them or give another start"
    for parameter, start in _given_starts(section).items():
        if parameter in known and parameter not in section.bounds:
            lower, upper = known[parameter].lower, known[parameter].upper
            if not lower <= start <= upper:
                where = ("fits", name, "start", parameter)
                yield where, f"{start:g} lies outside the bounds {lower:g} to {upper:g}; give bounds as well"


def signals_are_there(experiment: Experiment) -> Found:
    """Yield a problem for each signal or channel that a recording of a fit does not have."""
    for name, section in experiment.spec.fits.items():
        structure = structure_or_none(experiment, name)
        if structure is None:
            continue
        for key, given, used in zip(
            ("inputs", "outputs"), (section.inputs, section.outputs), fit_channels(experiment, name), strict=True
        ):
            where: Location = ("fits", name, key) if given else ("fits", name)
            for wanted in used:
                yield from ((where, text) for text in _missing(experiment, name, wanted))


def _missing(experiment: Experiment, fit: str, wanted: str) -> Iterator[str]:
    signal, _, channel = wanted.partition(".")
    for planned in experiment.fit_recordings(fit):
        if signal not in planned.signals:
            yield f"recording {planned.name!r} has no signal {signal!r}; {nearest(signal, planned.signals)}"
            return
        if channel and channel not in planned.signals[signal]:
            there = nearest(channel, planned.signals[signal])
            yield f"recording {planned.name!r}: signal {signal!r} has no channel {channel!r}; {there}"
            return


FIT_CHECKS: tuple[Check, ...] = (
    structures_load,
    fits_find_recordings,
    parameters_are_known,
    signals_are_there,
)
"""Checks of the fits."""


def a_fit_is_named(experiment: Experiment, where: Location, name: str, needed: Sequence[str], remedy: str) -> Found:
    """Yield problems of a section that starts from the models of a fit, one per recording.

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
    if experiment.spec.fits[name].together:
        yield where, f"{name} is one model for all recordings; name a fit per recording"
    structure = structure_or_none(experiment, name)
    missing = [n for n in needed if n not in {q.name for q in structure.parameters}] if structure else []
    if missing:
        yield where, f"{name} has no parameters {', '.join(missing)}; {remedy}"


# ---- Checks of the options of a fit together with its structure and recordings.


def focus_sees_options(experiment: Experiment) -> Found:
    """Yield a problem for each option that has no effect on a fit for simulation."""
    for name, section in experiment.spec.fits.items():
        if section.focus != "simulation":
            continue
        known = _known(experiment, name)
        if known is None:
            continue
        unseen = known[0].gain_only
        for key, given in (("prior", section.prior), ("local", section.local)):
            for parameter in given:
                if parameter.partition("[")[0] in unseen:
                    yield ("fits", name, key, parameter), "a simulation does not use the disturbance gain; remove it"


def vectors_have_their_length(experiment: Experiment) -> Found:
    """Yield a problem when the numbers of weights and outputs, or of initial values and states, differ."""
    for name, section in experiment.spec.fits.items():
        known = _known(experiment, name)
        if known is None:
            continue
        parts, structure = known
        labels = output_labels(experiment, name, structure)
        weights, state = section.output_weights, section.initial_state
        if weights is not None and labels and len(weights) != len(labels):
            there = ", ".join(labels)
            yield ("fits", name, "output_weights"), f"{len(weights)} weights for {len(labels)} outputs: {there}"
        if weights is not None and section.criterion == "det":
            yield (
                ("fits", name, "output_weights"),
                "are for criterion: trace; det weighs outputs by their errors",
            )
        wrong = False
        for given in state.values() if isinstance(state, Mapping) else (state,):
            if not isinstance(given, str) and len(given) != parts.n_states:
                yield (
                    ("fits", name, "initial_state"),
                    f"{len(given)} numbers for the {parts.n_states} states of {structure.name}; give one each",
                )
                wrong = True
        used = {q.name for q in experiment.fit_recordings(name)}
        if isinstance(state, Mapping) and set(state) != used:
            wrong = True
            yield ("fits", name, "initial_state"), f"give one for each recording of the fit: {', '.join(sorted(used))}"
        if not wrong:
            free = [q for q in structure.parameters if q.name not in section.fixed]
            try:
                initial_states(structure, free, state, sorted(used))
            except GbidError as error:
                yield ("fits", name, "initial_state"), str(error)


def trends_are_of_outputs(experiment: Experiment) -> Found:
    """Yield a problem for each trend and hum that the fit would refuse."""
    for name in experiment.spec.fits:
        structure = structure_or_none(experiment, name)
        if structure is None or not output_labels(experiment, name, structure):
            continue
        yield from refusal(("fits", name), partial(fit_disturbances, experiment, name, structure))


def local_parameters_have_groups(experiment: Experiment) -> Found:
    """Yield a problem for local parameters of a fit to one recording, or without operating points."""
    for name, section in experiment.spec.fits.items():
        planned = experiment.fit_recordings(name)
        if section.local and (not section.together or len(planned) < 2):
            yield (
                ("fits", name, "local"),
                "is for a fit to several recordings at once; write together: true",
            )
            continue
        for parameter, scope in section.local.items():
            silent = [q.name for q in planned if not {"pressure_bar", "speed_rpm"} <= set(q.conditions)]
            if scope == "operating_point" and silent:
                yield (
                    ("fits", name, "local", parameter),
                    f"recording {silent[0]!r} has no pressure_bar and speed_rpm; add them to its conditions",
                )


def stretches_left_out_exist(experiment: Experiment) -> Found:
    """Yield a problem for each left-out stretch that is not inside a recording of the fit."""
    rig = experiment.spec.rig
    for name, section in experiment.spec.fits.items():
        used = {q.name: q for q in experiment.fit_recordings(name)}
        for recording, stretches in section.left_out.items():
            where: Location = ("fits", name, "left_out", recording)
            if recording not in used:
                yield where, f"no recording of this fit; {nearest(recording, used)}"
                continue
            for i, (begin, end) in enumerate(stretches):
                if end <= begin:
                    yield (*where, i), f"{end:g} s is not after {begin:g} s; make it larger"
                elif rig is not None and used[recording].imported is None and end > rig.duration_s:
                    yield (
                        (*where, i),
                        f"{end:g} s is beyond the end of the recording, {rig.duration_s:g} s; end it there",
                    )


def _known(experiment: Experiment, fit: str) -> tuple[Anatomy, AnyStructure] | None:
    """Return what is known of a structure, and the structure; None when another check reports it."""
    structure = structure_or_none(experiment, fit)
    if structure is None:
        return None
    try:
        return kind_of(structure).anatomy(), structure
    except GbidError:
        return None


OPTION_CHECKS: tuple[Check, ...] = (
    focus_sees_options,
    vectors_have_their_length,
    trends_are_of_outputs,
    local_parameters_have_groups,
    stretches_left_out_exist,
)
"""Checks of the options of fits."""


# ---- Stage of the fits: one model per recording, or one for all recordings together.

FOLDER = "fits"
_OWN_KINDS: tuple[ProblemKind, ...] = ("constant", "saturated", "too_few_samples")


def fit_tasks(job: Job, only: str | None = None) -> list[Task]:
    """Return the tasks of all fits, or of the one named."""
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
    settings = section.model_dump(exclude={"structure", "options", "loop", "recordings", "together"})
    settings["left_out"] = {recording: settings["left_out"].get(recording) for recording in recordings}
    settings["structure"] = structure_settings(experiment, name)
    settings["recordings"] = recordings
    sources = [fit_input(experiment, experiment.recordings[recording]) for recording in recordings]
    path = experiment.path(f"{FOLDER}/{name}", model)
    return experiment.result("fit", f"{name}/{model}", path, settings, sources)


def read_fit_summary(path: Path) -> Made:
    """Return status and smallest fit percent of an existing result.

    Raises
    ------
    DataError
        When the file is damaged.
    """
    with reading(path, FitResult.FILE) as file:
        percent = read_dataset(file, "fit_percent")
        return Made(str(read_attribute(file, "status")), bool(read_attribute(file, "success")), _smallest(percent))


def load_made_fit(job: Job, name: str, model: str) -> FitResult:
    """Return the result of a fit that was made from the present settings.

    Raises
    ------
    DataError
        When the result is missing or was made from other settings.
    """
    return load_fit(fit_result(job.experiment, name, model).require())


def fit_entries(job: Job, name: str) -> list[TableEntry]:
    """Return the rows of all models of a fit for `gbid.tabulate`; a missing model has its reason."""
    entries = []
    for model, recordings in fit_models(job.experiment, name).items():
        conditions = job.experiment.recordings[recordings[0]].conditions
        try:
            result, failure = load_made_fit(job, name, model), ""
        except (DataError, OSError) as error:
            result, failure = None, str(error)
        entries.append(TableEntry(name, model, tuple(recordings), conditions, result, failure))
    return entries


def fit_arguments(experiment: Experiment, name: str, data: Sequence[Recording]) -> dict[str, Any]:
    """Return the keyword arguments of `gbid.fit` for a fits section and recordings."""
    section = experiment.spec.fits[name]
    hold, state = section.intersample, section.initial_state
    return {
        **{option.name: getattr(section, option.name) for option in fields(FitOptions)},
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
            recording.name: [samples_of(recording, *stretch) for stretch in section.left_out[recording.name]]
            for recording in data
            if recording.name in section.left_out
        },
    }


def samples_of(recording: Recording, from_s: float, to_s: float) -> tuple[int, int]:
    """Return the first samples at or after two times [s], as (first, stop).

    Raises
    ------
    DataError
        When no sample lies between the times, or the end lies beyond the recording.
    """
    first, stop = (math.ceil(t / recording.sample_time - 1e-6) for t in (from_s, to_s))
    if stop > recording.n_samples:
        raise DataError(
            f"left_out: recording {recording.name!r} ends at {recording.n_samples * recording.sample_time:g} s, "
            f"before {to_s:g} s; make the stretch end there"
        )
    if stop <= first:
        raise DataError(
            f"left_out: recording {recording.name!r} has no sample from {from_s:g} s to before {to_s:g} s; widen it"
        )
    return first, stop


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
    if section.multi_start is None:
        result = fit(structure, data, progress=job.reporter.iteration, **arguments)
    else:
        options = section.multi_start.model_dump()
        result = fit_multistart(structure, data, **options, progress=job.reporter.iteration, **arguments).best
    result = replace(result, notes=(*result.notes, *_suspects(job, name, result, data)))
    save_fit(result, part, overwrite=True)
    return Made(result.status, result.success, _smallest(result.fit_percent))


def _suspects(job: Job, name: str, result: FitResult, data: Sequence[Recording]) -> list[str]:
    """Return remarks on lines of the shaft in residuals that are not white: run-out that the prefilter left."""
    if result.trusted == "white":
        return []
    section, left_out = job.experiment.spec.prefilter, job.experiment.spec.fits[name].left_out
    removed = "no run-out is removed" if section is None or section.method == "none" else _removed(section)
    found = []
    for rec in data:
        ranges = [samples_of(rec, *stretch) for stretch in left_out.get(rec.name, ())]
        try:
            lines = shaft_lines(result, rec, ranges)
        except GbidError:  # a model that overflows has a note of its own
            continue
        found += [
            f"suspect for residuals that are not white: {rec.name}: {line.output} has a line of {line.rms:.2g} "
            f"{_unit(rec, line.output)} rms at {line.frequency_hz:.1f} Hz, order {line.order} of the shaft; {removed}"
            for line in lines
        ]
    return found


def _removed(section: PrefilterSection) -> str:
    if section.method == "harmonics" and section.harmonics != "auto":
        return f"the prefilter removes {section.harmonics} harmonics; see what its map leaves, or write harmonics: auto"
    return f"the prefilter removes run-out by method {section.method}; see what its map leaves"


def _unit(rec: Recording, output: str) -> str:
    return rec.units.get(output.rpartition("_")[0], "")


def _smallest(percent: npt.NDArray[Any]) -> float:
    return float(percent.min()) if percent.size else math.nan


FIT = Stage("fit", "fits", (*FIT_CHECKS, *OPTION_CHECKS), fit_tasks, early=True)
"""``fits/<fit>/<recording>.h5``, or ``together.h5`` for a fit to all its recordings.

A fit that does not converge is written, too; its outcome reports that.
"""
