"""Export of controllers as C source."""

from __future__ import annotations

from pathlib import Path

from gbid.control import ControllerDesign, export_c
from gbid.exporters.at_points import controller_models
from gbid.exporters.export_target import ExportItem, ExportRequest, ExportTarget


def write_c(item: ExportItem, request: ExportRequest) -> list[Path]:
    """Write source and header of a controller, and return the files.

    Raises
    ------
    UsageError
        When a file exists and `overwrite` is not set.
    """
    assert isinstance(item.what, ControllerDesign)
    models = controller_models(item.name, item.what, request.at)
    return [
        path
        for name, model in models.items()
        for path in export_c(request.folder / f"{name}.c", model, number=request.number, overwrite=request.overwrite)
    ]


TARGET = ExportTarget("controllers as C source", (ControllerDesign,), write_c)
