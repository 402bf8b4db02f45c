"""Checks of the recordings before a run: readable files, equal sample times, length, disk space."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from gbid.errors import DataError, GbidError, UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.plan import PlannedRecording
from gbid.experiment.stages.fit.plan import fit_models
from gbid.experiment.stages.fit.structures import fit_disturbances, structure_or_none
from gbid.experiment.stages.importing.plan import data_file, mapping_of
from gbid.identify.problem.initial_states import initial_states
from gbid.recording import ImportMapping
from gbid.recording.importers.peek import Peek, peek
from gbid.structure import anatomy
from gbid.tables.numbers import file_size

PER_UNKNOWN = 10
"""Smallest number of samples per unknown of a fit."""
_PER_FIT, _PER_FIGURE = 120_000, 400_000  # size of one result in bytes
_STATED = 1.1  # factor for the names, units and times that files contain beside the samples


def peek_recordings(experiment: Experiment) -> tuple[dict[str, Peek], list[tuple[PlannedRecording, GbidError]]]:
    """Return the length and sample time of each recording.

    Those of the rig follow from its settings. Those of files are read from the head of each file.

    Returns
    -------
    dict of str to Peek
        Length and sample time by name, for the recordings that can be read.
    list of (PlannedRecording, GbidError)
        Recordings that cannot be read, each with its error.
    """
    found: dict[str, Peek] = {}
    broken: list[tuple[PlannedRecording, GbidError]] = []
    rig = experiment.spec.rig
    for name, planned in experiment.recordings.items():
        if planned.imported is None:
            assert rig is not None
            seconds = rig.duration_s if planned.excited else rig.stationary.duration_s or rig.duration_s
            found[name] = Peek(round(seconds / rig.sample_time_s), rig.sample_time_s)
            continue
        try:
            mapping = ImportMapping.from_dict(mapping_of(planned.imported))
            found[name] = peek(data_file(experiment, planned.imported), mapping)
        except GbidError as error:
            broken.append((planned, error))
    return found, broken


def sample_times_differ(experiment: Experiment, seen: Mapping[str, Peek]) -> list[str]:
    """Return a text for each recording of a fit whose sample time differs from that of most recordings of the fit."""
    texts = []
    for fit in experiment.spec.fits:
        known = [q.name for q in experiment.fit_recordings(fit) if q.name in seen]
        rounded = {name: float(f"{seen[name].sample_time:.4g}") for name in known}
        if len(set(rounded.values())) < 2:
            continue
        usual, count = Counter(rounded.values()).most_common(1)[0]
        for name in known:
            if rounded[name] != usual:
                texts.append(
                    f"recording {name!r}: sample time {seen[name].sample_time:g} s; {count} of {len(known)} recordings "
                    f"of fit {fit} have {usual:g} s: correct sample_time_s or its time column, or use another fit"
                )
    return texts


def recordings_too_short(experiment: Experiment, seen: Mapping[str, Peek]) -> list[str]:
    """Return a text for each model whose recordings have too few samples for its unknowns.

    The unknowns are the free parameters, those of trends and hum, and one initial state for each recording.
    """
    texts = []
    for fit, section in experiment.spec.fits.items():
        structure = structure_or_none(experiment, fit)
        if structure is None:
            continue
        free = [q for q in structure.parameters if q.name not in section.fixed]
        shared, own = len(free), dict.fromkeys(seen, anatomy(structure).n_states)
        with suppress(GbidError):  # another check reports it
            used = [q.name for q in experiment.fit_recordings(fit)]
            states = initial_states(structure, free, section.initial_state, used)
            own |= dict(zip(used, np.sum(~states.known, axis=1).tolist(), strict=True))
        with suppress(UsageError):  # another check reports it
            shared += len(fit_disturbances(experiment, fit, structure).names)
        for names in fit_models(experiment, fit).values():
            known = [name for name in names if name in seen]
            samples, unknowns = sum(seen[name].n_samples for name in known), shared + sum(own[name] for name in known)
            if known and samples < PER_UNKNOWN * unknowns:
                texts.append(
                    f"recording {', '.join(known)}: {samples} samples for the {unknowns} unknowns of fit {fit}; "
                    f"at least {PER_UNKNOWN * unknowns} are needed: record longer, or fix some parameters"
                )
    return list(dict.fromkeys(texts))


def disk_space(experiment: Experiment, seen: Mapping[str, Peek]) -> tuple[int, int]:
    """Return the estimated size of all results and the free space of their disk.

    Returns
    -------
    needed, free : int
        Sizes [bytes]. Results that exist already are not subtracted.
    """
    spec = experiment.spec
    needed = 0.0
    for name, planned in experiment.recordings.items():
        if name in seen:
            copies = 2 if spec.prefilter is not None and planned.excited else 1
            channels = 1 + sum(len(channels) for channels in planned.signals.values())
            needed += _STATED * 8 * copies * channels * seen[name].n_samples
    needed += sum(_PER_FIT * len(fit_models(experiment, fit)) for fit in spec.fits)
    needed += sum(_PER_FIGURE * len(fit_models(experiment, fit)) for fit in spec.figures if fit in spec.fits)
    return int(needed), shutil.disk_usage(_nearest_folder(experiment.results)).free


def space_problem(experiment: Experiment, needed: int, free: int) -> str:
    """Return a text when the results need more space than the disk has, else an empty text."""
    if needed <= free:
        return ""
    return (
        f"{experiment.results}: the results need about {file_size(needed)}, {file_size(free)} are free; "
        "make room, or write elsewhere with --results"
    )


def find_data_problems(experiment: Experiment) -> tuple[list[str], int, tuple[int, int]]:
    """Return the problems of the recordings that show before a run.

    Returns
    -------
    problems : list of str
        One text for each problem.
    exit_code : int
        Highest exit code of the problems; 0 when there are none.
    needed, free : int
        Sizes [bytes], as `disk_space` returns.
    """
    seen, broken = peek_recordings(experiment)
    texts = [f"{experiment.file.position(planned.location)}: {error}" for planned, error in broken]
    code = max((error.exit_code for _, error in broken), default=0)
    space = disk_space(experiment, seen)
    more: Sequence[str] = [
        *sample_times_differ(experiment, seen),
        *recordings_too_short(experiment, seen),
        *filter(None, [space_problem(experiment, *space)]),
    ]
    texts += [f"{experiment.file.path}: {text}" for text in more]
    return texts, max(code, DataError.exit_code if more else 0), space


def _nearest_folder(path: Path) -> Path:
    """Return the folder itself, or the nearest folder above it that exists."""
    path = path.absolute()
    return next(folder for folder in (path, *path.parents) if folder.is_dir())
