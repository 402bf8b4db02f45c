"""Read an experiment YAML: first its form, then what it means."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from gbid.errors import UsageError
from gbid.experiment.folders import FoundFiles, find_files
from gbid.experiment.plan import PlannedRecording, planned_recordings
from gbid.experiment.problems import ExperimentError, Location, Problem, dotted, in_file_order, schema_text
from gbid.experiment.schema import ExperimentFile
from gbid.yaml_file import YamlFile, read_yaml


@dataclass(frozen=True, eq=False)
class Experiment:
    """An experiment file, its positions, and where its results go.

    Attributes
    ----------
    file : YamlFile
        The YAML with the line and column of each value.
    spec : ExperimentFile
        Its contents.
    results : pathlib.Path
        Folder of the results.
    """

    file: YamlFile
    spec: ExperimentFile
    results: Path

    @property
    def folder(self) -> Path:
        """Folder of the YAML, from where its paths count."""
        return self.file.path.parent

    @cached_property
    def recordings(self) -> Mapping[str, PlannedRecording]:
        """Recordings that the rig makes or the import reads, by name."""
        return {planned.name: planned for planned in planned_recordings(self.spec, self.imports.files)}

    @cached_property
    def imports(self) -> FoundFiles:
        """Files that the import section names or finds in its folder, as they are when first asked for."""
        section = self.spec.imported
        return find_files(section, self.folder) if section is not None else FoundFiles((), ())

    @cached_property
    def points(self) -> Mapping[str, list[PlannedRecording]]:
        """Recordings by operating point."""
        found: dict[str, list[PlannedRecording]] = {}
        for planned in self.recordings.values():
            found.setdefault(planned.point, []).append(planned)
        return found

    @cached_property
    def fits_of(self) -> Mapping[str, list[str]]:
        """Names of the fits that a recording is used in, by its name."""
        found: dict[str, list[str]] = {}
        for fit in self.spec.fits:
            for planned in self.fit_recordings(fit):
                found.setdefault(planned.name, []).append(fit)
        return found

    def matching(self, patterns: tuple[str, ...]) -> list[PlannedRecording]:
        """List recordings whose names match any of the patterns, in the experiment's order."""
        return [q for q in self.recordings.values() if any(fnmatchcase(q.name, p) for p in patterns)]

    def fit_recordings(self, fit: str) -> list[PlannedRecording]:
        """List the recordings of a fit; all excited ones when it names none."""
        patterns = self.spec.fits[fit].recordings
        return self.matching(patterns) if patterns else [q for q in self.recordings.values() if q.excited]

    def problem(self, location: Location, text: str) -> Problem:
        """Build a problem at the position of a key."""
        return Problem(self.file.position(location), dotted(location), text)


def load_experiment(path: str | Path, results: str | Path | None = None) -> Experiment:
    """Load an experiment file and check all that can be known before anything runs.

    Parameters
    ----------
    path : path
        The YAML.
    results : path, optional
        Folder of the results in place of the one that the file names.

    Returns
    -------
    Experiment

    Raises
    ------
    ExperimentError
        With all problems at once, each with file, line, column, key and what to do.
    """
    from gbid.experiment.checks import find_experiment_problems  # after this module: checks need Experiment

    path = Path(path)
    try:
        file = read_yaml(path)
    except UsageError as error:
        position, _, text = str(error).partition(": ")
        raise ExperimentError([Problem(position, "", text)]) from None
    spec, faults = _parse(file.data)
    removed = [location for location, _ in faults]
    if faults:
        # The meaning of the rest is looked at as well, so that nobody has to come back for it.
        spec = _parse(_without(file.data, removed))[0]
    problems = [Problem(file.position(location), dotted(location), text) for location, text in faults]
    if spec is not None:
        folder = Path(results) if results else path.parent / (spec.results or f"results/{spec.name}")
        experiment = Experiment(file, spec, folder)
        found = find_experiment_problems(experiment)
        problems += [experiment.problem(place, text) for place, text in found if not _touches(place, removed)]
        if not problems:
            return experiment
    raise ExperimentError(in_file_order(problems))


def _parse(data: Any) -> tuple[ExperimentFile | None, list[tuple[Location, str]]]:
    """Check the form: keys, types, ranges."""
    try:
        return ExperimentFile.model_validate(data), []
    except ValidationError as error:
        found = error.errors(include_url=False)
        # A list whose entries are wrong is told by these; that it then has too few is no second mistake.
        inside = {e["loc"][:-1] for e in found}
        return None, [
            schema_text(ExperimentFile, e) for e in found if not (e["type"] == "too_short" and e["loc"] in inside)
        ]


def _without(data: Any, locations: Sequence[Location]) -> Any:
    """Copy the data without some of its numbers and words; None when a whole block would have to go."""
    data = deepcopy(data)
    for location in locations:
        node = data
        for key in location[:-1]:
            node = node[key]
        if not isinstance(node, dict) or isinstance(node.get(location[-1]), dict | list):
            return None
        node.pop(location[-1], None)
    return data


def _touches(location: Location, others: Sequence[Location]) -> bool:
    """Whether a problem may come from a value that was left out: the same key, or one above or below it."""
    return any(location[: len(other)] == other[: len(location)] for other in others)
