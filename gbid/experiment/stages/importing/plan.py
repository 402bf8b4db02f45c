"""File and mapping of an imported recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gbid.experiment.experiment import Experiment
from gbid.experiment.stages.importing.schema import ImportedSection


def data_file(experiment: Experiment, entry: ImportedSection) -> Path:
    """Return the path of the file of an imported recording."""
    assert experiment.spec.imported is not None
    return experiment.folder / experiment.spec.imported.data_folder / entry.file


def mapping_of(entry: ImportedSection) -> dict[str, Any]:
    """Return an entry as the mapping for `gbid.import_recording`."""
    mapping = entry.model_dump(exclude={"file", "kind", "remove_mean"}, exclude_none=True)
    for signal in mapping["signals"].values():
        del signal["rests_at_limits"]
    return mapping
