"""Loading of an experiment YAML: checks across sections, JSON schema, and checks of recordings."""

from __future__ import annotations

import inspect
import pkgutil
import re
import shutil
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from gbid.core.errors import DataError, GbidError, UsageError
from gbid.core.names import file_stem, given_path
from gbid.core.tables import file_size
from gbid.core.yaml_file import read_yaml, with_changes
from gbid.experiment.experiment import Experiment, PlannedRecording, fit_models, planned_recordings
from gbid.experiment.fields import ExperimentError, Found, Location, Problem, dotted, in_file_order, schema_faults
from gbid.experiment.machine import rig_model
from gbid.experiment.recordings import mapping_of
from gbid.experiment.run import has_section
from gbid.experiment.schema import ExperimentFile
from gbid.experiment.stages import registry
from gbid.experiment.stages.importing import find_import_problems
from gbid.experiment.structures import fit_disturbances, structure_or_none
from gbid.experiment.user_code import forget_failures, new_code
from gbid.identify.problem.states import initial_states
from gbid.recording import ImportMapping
from gbid.recording.importing import Peek, peek
from gbid.structure.kinds import kind_of

# ---- Checks across the sections of an experiment: each check is a function that yields problems.


def find_experiment_problems(experiment: Experiment) -> list[tuple[Location, str]]:
    """Return the problems found by all checks across sections.

    A check stays silent about values that another check reports as missing.

    Returns
    -------
    list of (location, text)
        Location in the YAML and text of each problem, without duplicates.
    """
    problems = dict.fromkeys([*has_recordings(experiment), *names_are_unique(experiment)])
    for stage in registry.STAGES:
        for check in stage.checks if has_section(experiment, stage.section) else ():
            problems |= dict.fromkeys(check(experiment))
    return list(problems)


def has_recordings(experiment: Experiment) -> Found:
    """Yield a problem when the experiment has no recordings."""
    spec = experiment.spec
    if spec.rig is None and spec.imported is None and not any(fit.responses for fit in spec.fits.values()):
        yield (
            (),
            (
                "no recordings: add a rig section (virtual rig) or an import section (files of your own); a fit to "
                "frequency responses has responses"
            ),
        )
    elif spec.rig is not None and not (experiment.recordings or spec.impacts or spec.controller):
        yield ("rig",), "makes no recordings; set recordings of prbs or stationary to at least 1"


def names_are_unique(experiment: Experiment) -> Found:
    """Yield a problem for each recording with a name that an earlier recording already has."""
    rig = experiment.spec.rig
    points = [(q.pressure_bar, q.speed_rpm) for q in rig.operating_points] if rig else []
    twice: dict[Location, int] = {
        ("rig", "operating_points", i): points.index(point) for i, point in enumerate(points) if points.index(point) < i
    }
    for here, first in twice.items():
        yield here, f"the same operating point as operating_points[{first}]; delete one of the two"
    seen: set[str] = set()
    for q in planned_recordings(experiment.spec, experiment.imports):
        if q.location in twice:
            continue  # reported above, once for all recordings of the point
        if q.name in seen:
            where = (*q.location, "name") if q.imported and "recordings" in q.location else q.location
            yield where, f"a second recording named {q.name!r}; each needs a name (or operating point) of its own"
        seen.add(q.name)


def load_experiment(
    path: str | Path,
    results: str | Path | None = None,
    *,
    changes: Sequence[str] = (),
    announce: Callable[[str], None] | None = None,
    form_only: bool = False,
    text: str | None = None,
) -> Experiment:
    """Return the experiment of a file, after all checks that are possible before a run.

    Parameters
    ----------
    path : path
        The YAML.
    results : path, optional
        Folder of the results, instead of the folder that the file names.
    changes : sequence of str
        Values other than those of the file, each as ``KEY=VALUE``; see `gbid.core.yaml_file.with_changes`.
    announce : callable, optional
        Told in one line of each Python file with equations whose content is new to this user, before it is executed.
    form_only : bool
        Whether to check keys, types and ranges alone; nothing that the file names is then read or executed.
    text : str, optional
        Text in place of the content of the file.

    Returns
    -------
    Experiment
        The checked experiment.

    Raises
    ------
    ExperimentError
        With all problems at once, each with file, line, column, key and what to do.
    """
    path = given_path(path)
    try:
        file = read_yaml(path, text)
    except UsageError as error:
        position, _, text = str(error).partition(": ")
        raise ExperimentError([Problem(position, "", text)]) from None
    file = with_changes(file, changes) if changes else file
    spec, faults = _parse(file.data)
    if faults:
        # The other values are checked as well, so that the user sees all problems at once.
        spec = _parse(_without(file.data, faults))[0]
    problems = [Problem(file.position(location), dotted(location), text) for location, text in faults.items()]
    if spec is not None:
        folder = Path(results) if results else path.parent / (spec.results or f"results/{file_stem(spec.name)}")
        experiment = Experiment(file, spec, folder)
        if announce is not None and not form_only:
            for line in new_code(experiment):
                announce(line)
        forget_failures()
        across = [] if form_only else find_experiment_problems(experiment)
        problems += [experiment.problem(place, text) for place, text in across if not _touches(place, faults)]
        if not problems:
            return experiment
    raise ExperimentError(in_file_order(problems))


def _parse(data: Any) -> tuple[ExperimentFile | None, dict[Location, str]]:
    """Return the parsed file, or its faults of keys, types and ranges by location."""
    try:
        return ExperimentFile.model_validate(data), {}
    except ValidationError as error:
        return None, schema_faults(ExperimentFile, data, error)


def _without(data: Any, locations: Iterable[Location]) -> Any:
    """Return a copy of the data without some values; None if a whole section would be removed."""
    data = deepcopy(data)
    for location in locations:
        if not location:  # a key that is no text
            return None
        node = data
        for key in location[:-1]:
            node = node[key]
        if not isinstance(node, dict) or isinstance(node.get(location[-1]), dict | list):
            return None
        node.pop(location[-1], None)
    return data


def _touches(location: Location, others: Iterable[Location]) -> bool:
    """Return whether a removed value may cause a problem: equal keys, or one above the other."""
    return any(location[: len(other)] == other[: len(location)] for other in others)


# ---- JSON schema of the experiment YAML, generated from the models that check it.

DIALECT = "https://json-schema.org/draft/2020-12/schema"
_SEE = re.compile(r"see `(gbid\.[\w.]+)`")
_UNIT = re.compile(r"_(m|s|rad|hz)$")


def experiment_json_schema() -> dict[str, Any]:
    """Return the JSON schema of the experiment YAML, ready for ``json.dumps``.

    The description of a section is its docstring. When the docstring names the function or class of gbid that takes
    the keys ("see `gbid.fit`"), the description of a key is that of the argument with the same name. ``keys.toml``
    describes all other keys.

    Returns
    -------
    dict
        JSON schema, draft 2020-12.
    """
    lines = tomllib.loads(Path(__file__).with_name("keys.toml").read_text(encoding="utf-8"))
    schema = ExperimentFile.model_json_schema(by_alias=True, mode="validation")
    for section in (schema, *schema.get("$defs", {}).values()):
        description = section.get("description", "")
        described = _described_arguments(description)
        section["title"] = section.get("title", "").removesuffix("Section")
        known = lines.get("" if section is schema else section["title"], {})
        section["description"] = _plain(description)
        for key, value in section.get("properties", {}).items():
            value.pop("title", None)  # pydantic makes it from the key, which the reader sees already
            text = described.get(key) or described.get(_UNIT.sub("", key)) or ""
            text = known.get(key) or ("" if text.startswith("See ") else text) or lines["any"].get(key) or text
            if text:
                value.setdefault("description", text)
    for key, value in schema["properties"].items():
        schema["properties"][key] = _without_null(value)
    return {"$schema": DIALECT, **schema, "title": "gbid experiment"}


def _without_null(value: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of an optional section without null, because the checks refuse an empty section."""
    kinds = [kind for kind in value.get("anyOf", []) if kind != {"type": "null"}]
    if len(kinds) != 1 or "$ref" not in kinds[0]:
        return value
    return {**kinds[0], **{key: word for key, word in value.items() if key not in ("anyOf", "default")}}


def _described_arguments(docstring: str) -> dict[str, str]:
    """Return the argument descriptions of the function or class that a docstring names, by argument."""
    target = _SEE.search(docstring)
    if not target:
        return {}
    text = inspect.getdoc(pkgutil.resolve_name(target[1])) or ""  # of a method, too
    section = re.search(r"^(?:Parameters|Attributes)\n-+\n(.*?)(?=^\w[\w ]*\n-+\n|\Z)", text, re.MULTILINE | re.DOTALL)
    entries = re.findall(r"^(\S[^\n]*)\n((?:[ \t]+[^\n]*\n?|\n)+)", section[1] if section else "", re.MULTILINE)
    return {
        argument.strip().lstrip("*"): _plain(body)
        for heading, body in entries
        for argument in heading.partition(" : ")[0].split(",")
    }


def _plain(markdown: str) -> str:
    """Return the text of a docstring without markup, one line per paragraph."""
    paragraphs = inspect.cleandoc(markdown).strip().split("\n\n")
    text = "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)
    return re.sub(r"`+([^`]*)`+", r"\1", text)


# ---- Checks of the recordings before a run: readable files, equal sample times, length, disk space.

PER_UNKNOWN = 10
"""Smallest number of samples per unknown of a fit."""
_PER_FIT, _PER_FIGURE = 120_000, 400_000  # size of one result in bytes
_STATED = 1.1  # factor for the names, units and times that files contain beside the samples


def peek_recordings(experiment: Experiment) -> tuple[dict[str, Peek], list[tuple[PlannedRecording, GbidError]]]:
    """Return the length and sample time of each recording.

    For recordings of the rig, the settings determine both; for files, the head of each file is read.

    Returns
    -------
    dict of str to Peek
        Length and sample time by name, for the recordings that can be read.
    list of (PlannedRecording, GbidError)
        Recordings that cannot be read, each with its error.
    """
    heads: dict[str, Peek] = {}
    broken: list[tuple[PlannedRecording, GbidError]] = []
    rig = experiment.spec.rig
    for name, planned in experiment.recordings.items():
        if planned.imported is None:
            assert rig is not None
            seconds = rig.duration_s if planned.excited else rig.stationary.duration_s or rig.duration_s
            heads[name] = Peek(round(seconds / rig.sample_time_s), rig.sample_time_s)
            continue
        try:
            mapping = ImportMapping.from_dict(mapping_of(planned.imported))
            heads[name] = peek(experiment.data_file(planned.imported), mapping)
        except GbidError as error:
            broken.append((planned, error))
    return heads, broken


def sample_times_differ(experiment: Experiment, seen: Mapping[str, Peek]) -> Iterator[str]:
    """Yield a text for each recording of a fit whose sample time differs from most of its recordings."""
    for fit in experiment.spec.fits:
        known = [q.name for q in experiment.fit_recordings(fit) if q.name in seen]
        if any(seen[name].is_irregular for name in known):
            continue
        rounded = {name: float(f"{seen[name].sample_time:.4g}") for name in known}
        usual, count = Counter(rounded.values()).most_common(1)[0] if known else (0.0, 0)
        for name in known:
            if rounded[name] != usual:
                yield (
                    f"recording {name!r}: sample time {seen[name].sample_time:g} s; {count} of {len(known)} recordings "
                    f"of fit {fit} have {usual:g} s: correct sample_time_s or its time column, or use another fit"
                )


def recordings_too_short(experiment: Experiment, seen: Mapping[str, Peek]) -> Iterator[str]:
    """Yield a text for each model whose recordings have too few samples for its unknowns.

    The unknowns are the free parameters, those of trends and hum, and one initial state for each recording.
    """
    for fit, section in experiment.spec.fits.items():
        structure = structure_or_none(experiment, fit)
        if structure is None:
            continue
        free = [q for q in structure.parameters if q.name not in section.fixed]
        shared, n_states = len(free), dict.fromkeys(seen, kind_of(structure).anatomy().n_states)
        with suppress(GbidError):  # another check reports it
            used = [q.name for q in experiment.fit_recordings(fit)]
            states = initial_states(structure, free, section.initial_state, used)
            n_states |= dict(zip(used, np.sum(~states.known, axis=1).tolist(), strict=True))
        with suppress(UsageError):  # another check reports it
            shared += len(fit_disturbances(experiment, fit, structure).names)
        for names in fit_models(experiment, fit).values():
            known = [name for name in names if name in seen]
            samples, unknowns = (
                sum(seen[name].n_samples for name in known),
                shared + sum(n_states[name] for name in known),
            )
            if known and samples < PER_UNKNOWN * unknowns:
                yield (
                    f"recording {', '.join(known)}: {samples} samples for the {unknowns} unknowns of fit {fit}; "
                    f"at least {PER_UNKNOWN * unknowns} are needed: record longer, or fix some parameters"
                )


def too_many_harmonics(experiment: Experiment, seen: Mapping[str, Peek]) -> Iterator[str]:
    """Yield a text where the last harmonic of the run-out map lies beyond half the sampling rate of a recording."""
    prefilter = experiment.spec.prefilter
    if prefilter is None or prefilter.method != "harmonics" or prefilter.harmonics == "auto":
        return
    if "harmonics" not in prefilter.model_fields_set:  # the default is no choice of the user
        return
    for name, head in seen.items():
        turns = abs(experiment.recordings[name].conditions.get("speed_rpm", 0.0)) / 60
        if turns and prefilter.harmonics * turns >= 0.5 / head.sample_time:
            yield (
                f"prefilter: harmonics = {prefilter.harmonics}, but at {60 * turns:g} rpm samples of "
                f"{head.sample_time:g} s show at most {ceil(0.5 / (head.sample_time * turns)) - 1}: give fewer, or auto"
            )


def controllers_too_slow(experiment: Experiment) -> Iterator[str]:
    """Yield a text for each controller that samples a mode of the rig less than twice in a period."""
    rig, sections = experiment.spec.rig, experiment.spec.controller.items()
    steps = {name: section.sample_time_s for name, section in sections if section.sample_time_s is not None}
    if rig is None or not steps:
        return
    plants = (rig_model(experiment).plant_at(point.pressure_bar, point.speed_rpm) for point in rig.operating_points)
    fastest = max((frequency for plant in plants for frequency, _ in plant.modes()[:2]), default=0.0)
    for name, step in steps.items():
        if step * fastest >= 0.5:
            yield (
                f"controller {name}: sample_time_s = {step:g} s, but the machine has a mode at {fastest:.4g} Hz: at "
                f"most {0.5 / fastest:.2g} s is needed to control it, better a tenth of that"
            )


def disk_space(experiment: Experiment, seen: Mapping[str, Peek]) -> tuple[int, int]:
    """Return the estimated size of all results and the free disk space.

    Returns
    -------
    needed, free : int
        Sizes [bytes]. Results that exist already are not subtracted.
    """
    spec = experiment.spec
    needed = 0.0
    for name, head in seen.items():
        planned = experiment.recordings[name]
        copies = 2 if spec.prefilter is not None and planned.excited else 1
        channels = 1 + sum(len(channels) for channels in planned.signals.values())
        needed += _STATED * 8 * copies * channels * head.n_samples
    for fit in spec.fits:
        needed += (_PER_FIT + _PER_FIGURE * (fit in spec.figures)) * len(fit_models(experiment, fit))
    path = experiment.results.absolute()
    folder = next(folder for folder in (path, *path.parents) if folder.is_dir())
    return int(needed), shutil.disk_usage(folder).free


def check_experiment(experiment: Experiment, quick: bool = False) -> tuple[list[str], int, tuple[int, int]]:
    """Return the problems of an experiment's recordings, those of their signals among them unless `quick`.

    Returns
    -------
    problems, exit_code, sizes
        As `find_data_problems` returns.
    """
    problems, code, sizes = find_data_problems(experiment)
    reported = "\n".join(problems)
    for planned, text, severity in find_import_problems(experiment) if experiment.spec.imported and not quick else ():
        if text not in reported:
            problems.append(f"{experiment.file.position(planned.location)}: {text}")
            code = max(code, severity)
    return problems, code, sizes


def find_data_problems(experiment: Experiment) -> tuple[list[str], int, tuple[int, int]]:
    """Return the problems of the recordings that can be found before a run.

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
    needed, free = disk_space(experiment, seen)
    checks = (sample_times_differ, recordings_too_short, too_many_harmonics)
    faults = [*dict.fromkeys(text for check in checks for text in check(experiment, seen))]
    faults += controllers_too_slow(experiment)
    if needed > free:
        sizes = f"the results need about {file_size(needed)}, {file_size(free)} are free"
        faults.append(f"{experiment.results}: {sizes}; make room, or write elsewhere with --results")
    texts += [f"{experiment.file.path}: {text}" for text in faults]
    return texts, max(code, DataError.exit_code if faults else 0), (needed, free)
