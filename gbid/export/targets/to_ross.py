"""Export of identified bearings as bearing elements of ROSS, over speed, one file for each injection pressure."""

from __future__ import annotations

from pathlib import Path

from gbid.core.errors import UsageError
from gbid.core.files import atomic_path
from gbid.export.ross import bearing_element
from gbid.export.target import ExportItem, ExportRequest, ExportTarget
from gbid.lpv import LPVModel


def write_elements(item: ExportItem, request: ExportRequest) -> list[Path]:
    """Write the bearing elements of a model as TOML of ROSS, and return the files.

    Raises
    ------
    UsageError
        When no mass is given, when ROSS is not installed, or when a file exists and `overwrite` is not set.
    """
    assert isinstance(item.what, LPVModel)
    model = item.what
    if request.mass_kg is None:
        raise UsageError(f"model {model.name!r} is per unit mass, ROSS needs N/m: give the modal mass with --mass KG")
    identified = sorted({pressure for pressure, _ in model.operating_points})
    files = []
    for pressure in identified or sorted(set(model.domain.pressure_bar)):
        name = f"{item.name}_p{pressure:g}"
        element = bearing_element(model, 0, mass_kg=request.mass_kg, pressure_bar=pressure, tag=name)
        path = request.folder / f"{name}.toml"
        with atomic_path(path, request.overwrite) as part:
            written = part.with_suffix(".toml")  # ROSS takes the format from the ending
            element.save(written)
            written.replace(part)
        files.append(path)
    return files


TARGET = ExportTarget("bearing elements of ROSS over speed (needs --mass)", (LPVModel,), write_elements)
