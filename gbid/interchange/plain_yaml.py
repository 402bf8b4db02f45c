"""Export of models as plain YAML."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from gbid.atomic import atomic_path
from gbid.identify import FitResult
from gbid.interchange.mat_file import Exportable
from gbid.lpv import LPVModel, save_model
from gbid.naming.paths import given_path
from gbid.structure import LinearModel
from gbid.yaml_file import write_yaml


def save_yaml(what: Exportable, path: str | Path, *, overwrite: bool = False) -> Path:
    """Write a model as YAML, and return the path of the file.

    An LPV model is written as a model file, which `gbid.load_model` reads. Other models are written as plain values.

    Parameters
    ----------
    what : LinearModel, FitResult or LPVModel
        The model to export.
    path : path
        The new file.
    overwrite : bool
        Whether an existing file may be replaced.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When the file cannot be written.
    """
    path = given_path(path)
    if isinstance(what, LPVModel):
        save_model(what, path, overwrite)
        return path
    contents = _fit(what) if isinstance(what, FitResult) else {"kind": "linear_model", **_model(what)}
    with atomic_path(path, overwrite) as part:
        write_yaml(contents, part)
    return path


def _model(model: LinearModel) -> dict[str, Any]:
    matrices = {letter: getattr(model, letter) for letter in ("A", "B", "C", "D", "K", "B_delayed", "delay")}
    return {
        "name": model.name,
        "dt": model.dt,
        "input_names": list(model.input_names),
        "output_names": list(model.output_names),
        "state_names": list(model.state_names),
        **{letter: matrix.tolist() for letter, matrix in matrices.items() if matrix is not None},
    }


def _fit(fit: FitResult) -> dict[str, Any]:
    return {
        "kind": "fit",
        "structure": fit.structure,
        "recordings": list(fit.recordings),
        "status": str(fit.status),
        "success": bool(fit.success),
        "parameters": {
            name: {
                "estimate": float(value),
                "std": float(fit.std[name]) if math.isfinite(fit.std[name]) else None,
                "unit": fit.units.get(name, ""),
                "free": name in fit.free,
            }
            for name, value in fit.parameters.items()
        },
        "fit_percent": fit.fit_percent.tolist(),
        "model": _model(fit.linear_model),
    }
