"""Model and controller files of an experiment that were changed after gbid wrote them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from gbid.experiment.experiment import Experiment
from gbid.files.text_checksum import is_changed
from gbid.notes.data_notes import DataNote
from gbid.yaml_file import CHANGED


def changed_files(experiment: Experiment) -> list[str]:
    """Return a text for each YAML file named in an experiment whose checksum is not that of its lines."""
    notes = []
    for name in dict.fromkeys(_named(experiment.file.data)):
        path = experiment.folder_of(name) / name
        with suppress(OSError):  # the stage that needs it reports the error
            if is_changed(path.read_bytes()):
                notes.append(DataNote.CHANGED_BY_HAND(f"{path}: {CHANGED}; it is used as it is now"))
    return notes


def _named(value: Any) -> Iterator[str]:
    if isinstance(value, str) and value.endswith((".yaml", ".yml")) and "\0" not in value:
        yield value
    elif isinstance(value, dict):
        for each in value.values():
            yield from _named(each)
    elif isinstance(value, list):
        for each in value:
            yield from _named(each)
