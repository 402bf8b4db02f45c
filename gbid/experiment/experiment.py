"""Experiment: its file, its contents, and the folder of its results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path

from gbid.experiment.plan import PlannedRecording, planned_recordings
from gbid.experiment.problems import Found, Location, Problem, dotted
from gbid.experiment.schema import ExperimentFile
from gbid.experiment.stages.importing.folders import FoundFiles, find_files
from gbid.share import share_folder
from gbid.yaml_file import YamlFile


@dataclass(frozen=True, eq=False)
class Experiment:
    """Experiment file with its positions, and the folder of its results.

    Attributes
    ----------
    file : YamlFile
        The YAML, with line and column of each value.
    spec : ExperimentFile
        Contents of the YAML.
    results : pathlib.Path
        Folder of the results.
    """

    file: YamlFile
    spec: ExperimentFile
    results: Path

    @property
    def folder(self) -> Path:
        """Folder of the YAML; its relative paths start here."""
        return self.file.path.parent

    def folder_of(self, file: str) -> Path:
        """Return the folder to which a file name is relative: that of the experiment, or the models of gbid."""
        for folder in (self.folder, share_folder("models")):
            if (folder / file).is_file():
                return folder
        return self.folder

    @cached_property
    def recordings(self) -> Mapping[str, PlannedRecording]:
        """Recordings by name: those of the rig, then those of imported files."""
        return {planned.name: planned for planned in planned_recordings(self.spec, self.imports.files)}

    @cached_property
    def imports(self) -> FoundFiles:
        """Files that the import section names or finds in its folder, searched once."""
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
        """Names of the fits that use a recording, by the name of the recording."""
        found: dict[str, list[str]] = {}
        for fit in self.spec.fits:
            for planned in self.fit_recordings(fit):
                found.setdefault(planned.name, []).append(fit)
        return found

    def matching(self, patterns: tuple[str, ...]) -> list[PlannedRecording]:
        """Return the recordings whose names match one of the patterns, in the order of the experiment."""
        return [q for q in self.recordings.values() if any(fnmatchcase(q.name, p) for p in patterns)]

    def fit_recordings(self, fit: str) -> list[PlannedRecording]:
        """Return the recordings of a fit.

        When it names none, all excited ones; of the rig those in the loop for a fit with `loop`, else the others.
        """
        section = self.spec.fits[fit]
        if section.recordings:
            return self.matching(section.recordings)
        closed = section.loop is not None
        excited = (q for q in self.recordings.values() if q.excited)
        return [q for q in excited if q.imported is not None or q.in_loop == closed]

    def problem(self, location: Location, text: str) -> Problem:
        """Return a problem at the position of a key."""
        return Problem(self.file.position(location), dotted(location), text)


Check = Callable[[Experiment], Found]
"""Type of a check: it yields the problems of an experiment. It is silent about values that are missing elsewhere."""
