"""Experiment for a gas bearing drafted from a folder of measured files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gbid.experiment.draft.draft_data import find_harmonics, read_data
from gbid.experiment.draft.draft_options import DraftOptions
from gbid.experiment.draft.draft_text import draft_text
from gbid.experiment.draft.file_survey import survey
from gbid.experiment.stages.importing.file_names import name_of


@dataclass(frozen=True)
class Draft:
    """Drafted experiment.

    Attributes
    ----------
    text : str
        The YAML.
    notes : tuple of str
        What was found and assumed.
    """

    text: str
    notes: tuple[str, ...]


def draft_experiment(options: DraftOptions, target: Path) -> Draft:
    """Return an experiment for a gas bearing with the recordings of a folder.

    Columns, units, operating points, kinds of recordings, the part with a constant speed and the harmonics of run-out
    are found in the files and their names, unless they are given.

    Parameters
    ----------
    options : DraftOptions
        The folder, and what is given.
    target : pathlib.Path
        Folder that the experiment will be written to.

    Raises
    ------
    UnansweredError
        When something is neither found nor given.
    UsageError
        When what is given does not fit the files.
    DataError
        When a file cannot be read.
    """
    files, others = survey(options)
    data = read_data(options, files)
    runout = find_harmonics(data.files)
    notes = [*data.notes, *runout.words]
    if others:
        notes.append(f"left out, of a kind that is not imported: {', '.join(others)}")
    return Draft(draft_text(name_of(target.name), target, options, data, runout), tuple(notes))
