"""Export of models as CSV tables and as plain YAML."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gbid.core.arrays import FloatArray
from gbid.core.errors import UsageError
from gbid.core.files import atomic_path
from gbid.core.names import given_path
from gbid.core.tables import Table, Value, plain_table, write_csv
from gbid.core.yaml_file import write_yaml
from gbid.export.matlab import Exportable
from gbid.identify import FitResult, FrequencyData
from gbid.lpv import LPVModel
from gbid.lpv.model_file import SI_UNITS, save_model
from gbid.structure import KEY_PARAMETERS, LinearModel
from gbid.structure.models import phase_in_degrees


def save_csv(
    what: Exportable | FrequencyData,
    path: str | Path,
    *,
    frequency_hz: npt.ArrayLike | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a model as a CSV table, and return the path of the file.

    The first line has the headings. Numbers have all digits and a decimal point; the separator is a comma. The table
    of a `LinearModel` has its matrices, one entry per line with the names of its row and column. The table of a
    `FitResult` has its parameters with standard deviation and unit, and that of a `LPVModel` the coefficients of Eq.
    16. With `frequency_hz` the table has the frequency response of the model or fit: magnitude and phase [deg] of
    each pair of channels, the phase without jumps as `bode` has it.

    Parameters
    ----------
    what : LinearModel, FitResult, LPVModel or FrequencyData
        The model to export, or measured frequency responses, which `FrequencyData.read` reads again.
    path : path
        The new file.
    frequency_hz : (n,) array, optional
        Frequencies [Hz].
    overwrite : bool
        Whether an existing file may be replaced.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set, or when `frequency_hz` is given for an LPV model.
    DataError
        When the file cannot be written.
    """
    path = given_path(path)
    if frequency_hz is not None:
        if isinstance(what, FrequencyData):
            raise UsageError(f"{path}: measured responses already have frequencies; remove frequency_hz")
        if isinstance(what, LPVModel):
            raise UsageError(
                f"{path}: an LPV model has a frequency response at one operating point only; "
                "give what.at(pressure_bar, speed_rpm)"
            )
        table = _responses(what.linear_model if isinstance(what, FitResult) else what, np.atleast_1d(frequency_hz))
    elif isinstance(what, LPVModel):
        what.need_bearing(None)
        table = _coefficients(what)
    elif isinstance(what, FitResult):
        table = _parameters(what)
    elif isinstance(what, FrequencyData):
        table = what.table()
    else:
        table = _matrices(what)
    with atomic_path(path, overwrite) as part:
        write_csv(table, part)
    return path


def _matrices(model: LinearModel) -> Table:
    x, u, y = model.state_names, model.input_names, model.output_names
    rows: list[Sequence[Value]] = []
    for letter, values, down, across in (
        ("A", model.A, x, x),
        ("B", model.B, x, u),
        ("C", model.C, y, x),
        ("D", model.D, y, u),
        ("K", model.K, x, y),
        ("B_delayed", model.B_delayed, x, u),
    ):
        if values is not None:
            entries = np.ndenumerate(values)
            rows += [(letter, i + 1, j + 1, down[i], across[j], float(value)) for (i, j), value in entries]
    for j, value in enumerate(() if model.delay is None else model.delay):
        rows.append(("delay", 1, j + 1, "s", u[j], float(value)))
    if model.dt is not None:
        rows.append(("dt", 1, 1, "s", "", float(model.dt)))
    return plain_table(("matrix", "row", "column", "row_name", "column_name", "value"), rows)


def _parameters(fit: FitResult) -> Table:
    rows = [
        (name, float(value), float(fit.std[name]), fit.units.get(name, ""), "yes" if name in fit.free else "no")
        for name, value in fit.parameters.items()
    ]
    return plain_table(("parameter", "estimate", "std", "unit", "free"), rows)


def _coefficients(model: LPVModel) -> Table:
    rows: list[Sequence[Value]] = [
        (key, SI_UNITS[key.split("_")[0]], *model.coefficients[key]) for key in KEY_PARAMETERS
    ]
    return plain_table(("parameter", "unit", *model.terms), rows)


def _responses(model: LinearModel, frequency_hz: FloatArray) -> Table:
    response = model.frequency_response(frequency_hz)
    pairs = [(i, j) for i in range(response.shape[1]) for j in range(response.shape[2])]
    names = [f"{model.output_names[i]}/{model.input_names[j]}" for i, j in pairs]
    phase = phase_in_degrees(model, frequency_hz)
    shown = [values for i, j in pairs for values in (abs(response[:, i, j]), phase[:, i, j])]
    heads = ("frequency_hz", *(f"{what} {name}" for name in names for what in ("magnitude", "phase_deg")))
    return plain_table(heads, np.column_stack([frequency_hz, *shown]).tolist())


# ---- Export of models as plain YAML.


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
