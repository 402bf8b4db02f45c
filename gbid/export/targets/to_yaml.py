"""Export as plain YAML."""

from __future__ import annotations

from pathlib import Path

from gbid.control import ControllerDesign
from gbid.export.tables import save_yaml
from gbid.export.target import ExportItem, ExportRequest, ExportTarget, controller_models
from gbid.identify import FitResult
from gbid.lpv import LPVModel
from gbid.structure import LinearModel


def write_plain(item: ExportItem, request: ExportRequest) -> list[Path]:
    """Write the YAML files of an item, and return the files.

    Raises
    ------
    UsageError
        When a file exists and `overwrite` is not set.
    """
    what = item.what
    models = controller_models(item.name, what, request.at) if isinstance(what, ControllerDesign) else {item.name: what}
    return [
        save_yaml(model, request.folder / f"{name}.yaml", overwrite=request.overwrite) for name, model in models.items()
    ]


TARGET = ExportTarget("plain YAML", (LinearModel, FitResult, LPVModel, ControllerDesign), write_plain)
