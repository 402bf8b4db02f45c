"""Export as tables: matrices, parameters and frequency response."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gbid.control import ControllerDesign
from gbid.export.tables import save_csv
from gbid.export.target import ExportItem, ExportRequest, ExportTarget, controller_models
from gbid.identify import FitResult
from gbid.lpv import LPVModel
from gbid.structure import LinearModel

_N_FREQUENCIES = 400


def write_tables(item: ExportItem, request: ExportRequest) -> list[Path]:
    """Write the tables of an item, and return the files.

    Raises
    ------
    UsageError
        When a file exists and `overwrite` is not set.
    """
    what = item.what
    if isinstance(what, ControllerDesign):
        models = controller_models(item.name, what, request.at)
        return [path for name, model in models.items() for path in _linear(name, model, request)]
    if isinstance(what, LPVModel):
        return [save_csv(what, request.folder / f"{item.name}_coefficients.csv", overwrite=request.overwrite)]
    if isinstance(what, FitResult):
        parameters = save_csv(what, request.folder / f"{item.name}_parameters.csv", overwrite=request.overwrite)
        return [parameters, *_linear(item.name, what.linear_model, request, what.sample_time)]
    return _linear(item.name, what, request)


def _linear(name: str, model: LinearModel, request: ExportRequest, sample_time: float | None = None) -> list[Path]:
    dt = sample_time or model.dt
    top = 2500.0 if dt is None else 0.5 / dt
    frequency = np.geomspace(top / 2500.0, top, _N_FREQUENCIES)
    matrices, response = (request.folder / f"{name}_{word}.csv" for word in ("matrices", "response"))
    return [
        save_csv(model, matrices, overwrite=request.overwrite),
        save_csv(model, response, frequency_hz=frequency, overwrite=request.overwrite),
    ]


TARGET = ExportTarget(
    "tables of matrices, parameters and frequency responses",
    (LinearModel, FitResult, LPVModel, ControllerDesign),
    write_tables,
)
