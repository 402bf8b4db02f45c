"""Export to MATLAB: a mat file with the numbers, and a function that builds the objects."""

from __future__ import annotations

from pathlib import Path

from gbid.control import ControllerDesign
from gbid.export.matlab import save_mat
from gbid.export.target import ExportItem, ExportRequest, ExportTarget, controller_models
from gbid.identify import FitResult
from gbid.lpv import LPVModel
from gbid.structure import LinearModel


def write_matlab(item: ExportItem, request: ExportRequest) -> list[Path]:
    """Write the mat files and functions of an item, and return the files.

    Raises
    ------
    UsageError
        When a file exists and `overwrite` is not set.
    """
    what = item.what
    models = controller_models(item.name, what, request.at) if isinstance(what, ControllerDesign) else {item.name: what}
    return [
        path
        for name, model in models.items()
        for path in save_mat(model, request.folder / f"{name}.mat", overwrite=request.overwrite)
    ]


TARGET = ExportTarget(
    "MATLAB data with a function for ss and idss", (LinearModel, FitResult, LPVModel, ControllerDesign), write_matlab
)
