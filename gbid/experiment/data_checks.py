"""What can be known of recordings before hours are spent: whole files, clocks that agree, length, disk space."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from gbid.errors import DataError, GbidError
from gbid.experiment.experiment import Experiment
from gbid.experiment.plan import PlannedRecording
from gbid.experiment.stages.fit.plan import fit_models
from gbid.experiment.stages.fit.structures import structure_or_none
from gbid.experiment.stages.importing.plan import data_file, mapping_of
from gbid.recording import ImportMapping
from gbid.recording.importers.peek import Peek, peek
from gbid.structure import symbolic_matrices

PER_UNKNOWN = 10
"""Samples that a fit needs for each of its unknowns to be worth its time."""
_PER_FIT, _PER_FIGURE = 120_000, 400_000  # bytes
_STATED = 1.1  # files also hold names, units, times


def peek_recordings(experiment: Experiment) -> tuple[dict[str, Peek], list[tuple[PlannedRecording, GbidError]]]:
    """Look at length and sample time of all recordings: those of the rig as planned, files by a short look.

    Returns
    -------
    dict of str to Peek
        Of the recordings that can be read.
    list of (PlannedRecording, GbidError)
        Those that cannot, and why.
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
    """Name recordings of a fit whose sample time is not that of the others; delays are tied to it."""
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
                    f"of fit {fit} have {usual:g} s: correct sample_time_s or its time column, or fit it apart"
                )
    return texts


def recordings_too_short(experiment: Experiment, seen: Mapping[str, Peek]) -> list[str]:
    """Name recordings that are too short for the unknowns of a fit: parameters, offsets, and an initial state each."""
    texts = []
    for fit, section in experiment.spec.fits.items():
        structure = structure_or_none(experiment, fit)
        if structure is None:
            continue
        _, matrices = symbolic_matrices(structure)
        free = [q for q in structure.parameters if q.name not in section.fixed]
        shared, own = len(free), matrices.A.shape[0] if section.initial_state == "estimated" else 0
        shared += matrices.C.shape[0] if section.offsets else 0
        for names in fit_models(experiment, fit).values():
            known = [name for name in names if name in seen]
            samples, unknowns = sum(seen[name].n_samples for name in known), shared + own * len(known)
            if known and samples < PER_UNKNOWN * unknowns:
                texts.append(
                    f"recording {', '.join(known)}: {samples} samples for the {unknowns} unknowns of fit {fit}; "
                    f"at least {PER_UNKNOWN * unknowns} are needed: record longer, or fix some parameters"
                )
    return list(dict.fromkeys(texts))


def disk_space(experiment: Experiment, seen: Mapping[str, Peek]) -> tuple[int, int]:
    """Estimate the size of all results, and find the free space where they go.

    Returns
    -------
    needed, free : int
        Bytes. What is there of the results already is not subtracted.
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
    """Say when the results will not fit on the disk, empty otherwise."""
    if needed <= free:
        return ""
    return (
        f"{experiment.results}: the results need about {size(needed)}, {size(free)} are free; "
        "make room, or write elsewhere with --results"
    )


def size(count: int) -> str:
    """Write a number of bytes in words."""
    value = float(count)
    for unit in ("B", "kB", "MB"):
        if value < 1000:
            return f"{value:.3g} {unit}"
        value /= 1000
    return f"{value:.3g} GB"


def find_data_problems(experiment: Experiment) -> tuple[list[str], int, tuple[int, int]]:
    """Check what can be known of the recordings by a short look.

    Returns
    -------
    problems : list of str
    exit_code : int
        Of the worst problem; 0 without.
    needed, free : int
        Bytes, as `disk_space` gives.
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
    """Find the folder itself or the nearest one above that is there."""
    path = path.absolute()
    return next(folder for folder in (path, *path.parents) if folder.is_dir())
