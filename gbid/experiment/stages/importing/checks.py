"""Checks of the import section: its files exist, and its mappings are valid."""

from __future__ import annotations

from gbid.errors import DataError, UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.problems import Found
from gbid.experiment.stages.importing.plan import data_file, mapping_of
from gbid.recording import ImportMapping
from gbid.recording.importers.formats import file_formats


def data_can_be_read(experiment: Experiment) -> Found:
    """Yield problems of data files and mappings; the contents of the files are checked later."""
    section = experiment.spec.imported
    if section is None:
        return
    folder = experiment.folder / section.data_folder
    if not folder.is_dir():
        yield ("import", "data_folder"), f"no folder {folder}; give it relative to the experiment file"
    yield from experiment.imports.problems
    reported: set[str] = set()
    for found in experiment.imports.files:
        entry, here = found.entry, found.location
        path = data_file(experiment, entry)
        listed = "recordings" in here
        if not listed and str(here) in reported:
            continue  # all files of a folder share one mapping
        reported.add(str(here))
        here_file = (*here, "file") if listed else here
        file_format = file_formats().get(path.suffix.lower())
        if file_format is None:
            yield here_file, f"unknown ending {path.suffix!r}; expected one of {', '.join(file_formats())}"
        elif folder.is_dir() and not path.is_file():
            yield here_file, f"no file {path}; put it there, or correct the name or data_folder"
        here_mapping = here if listed else here[:2]
        try:
            mapping = ImportMapping.from_dict(mapping_of(entry))
        except (UsageError, DataError) as error:
            yield here_mapping, str(error)
            continue
        may_be_stated = file_format is None or file_format.states_sample_time
        if mapping.sample_time is None and mapping.time is None and not may_be_stated:
            yield here_mapping, "neither sample_time_s nor time is given; give the sample time or the time column"
