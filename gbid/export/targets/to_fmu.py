"""Export as co-simulation units (FMI 2.0): plants over pressure and speed, and loops with a controller."""

from __future__ import annotations

from pathlib import Path

from gbid.control import ControllerDesign
from gbid.core.errors import UsageError
from gbid.export.fmu import save_fmu
from gbid.export.target import ExportItem, ExportRequest, ExportTarget
from gbid.lpv import LPVModel, load_model


def write_unit(item: ExportItem, request: ExportRequest) -> list[Path]:
    """Write the unit of a plant, or of a controller with its plant, and return the file.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set, when the plant of a controller is not found, or when a unit
        cannot be made.
    """
    if isinstance(item.what, ControllerDesign):
        plant, path = _plant_of(item.what, request), request.folder / f"{item.name}_loop.fmu"
        return [save_fmu(plant, path, controller=item.what, overwrite=request.overwrite)]
    assert isinstance(item.what, LPVModel)
    return [save_fmu(item.what, request.folder / f"{item.name}.fmu", overwrite=request.overwrite)]


def _plant_of(design: ControllerDesign, request: ExportRequest) -> LPVModel:
    """Return the model for which a controller was designed: one of those beside it, or one that comes with gbid."""
    models = [other.what for other in request.beside if isinstance(other.what, LPVModel)]
    for model in models:
        if model.name == design.plant:
            return model
    try:
        return load_model(design.plant)
    except UsageError as error:
        raise UsageError(
            f"the plant {design.plant!r} of controller {design.name!r} is not among what is exported: {error}"
        ) from None


TARGET = ExportTarget("co-simulation units (FMI 2.0) of plants and loops", (LPVModel, ControllerDesign), write_unit)
