"""Static maps and piezo curves in HDF5 (kinds ``static_map`` and ``piezo_curve``), and their rows for CSV."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from gbid.characterise.piezo import PiezoCurve
from gbid.characterise.static_map import StaticMap
from gbid.hdf5 import FileKind, read_fields, reading, write_fields, writing

Result = TypeVar("Result", StaticMap, PiezoCurve)

_REMEDY = "make it again with `gbid static`"
_KINDS: dict[type, FileKind] = {
    StaticMap: FileKind("static_map", _REMEDY),
    PiezoCurve: FileKind("piezo_curve", _REMEDY),
}


def save_static(result: StaticMap | PiezoCurve, path: str | Path, overwrite: bool = False) -> None:
    """Write a static map or a piezo curve to an HDF5 file.

    Parameters
    ----------
    result : StaticMap or PiezoCurve
        The result.
    path : path
        The new file.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When the file cannot be written.
    """
    source, output = result.units
    units = {"in": source, "out": output, "gain": f"{output}/{source}", "gain^2": f"({output}/{source})^2"}
    with writing(path, _KINDS[type(result)], overwrite) as file:
        write_fields(file, result, units)


def load_static(path: str | Path, kind: type[Result]) -> Result:
    """Return the static map or piezo curve in a file of `save_static`.

    Parameters
    ----------
    path : path
        The file.
    kind : type
        `StaticMap` or `PiezoCurve`.

    Returns
    -------
    StaticMap or PiezoCurve
        The result.

    Raises
    ------
    DataError
        When the file is missing, unreadable, incomplete or of the other kind.
    """
    with reading(path, _KINDS[kind]) as file:
        return read_fields(file, kind)


def static_rows(result: StaticMap | PiezoCurve) -> list[dict[str, Any]]:
    """Return rows for CSV, one for each plateau; names have their units in brackets."""
    source, output = result.units
    if isinstance(result, PiezoCurve):
        creep = np.concatenate([[np.nan], result.creep])
        saturated = np.concatenate([[False], result.saturated])
        return [
            {
                "recording": result.name,
                "plateau": k + 1,
                "direction": int(result.direction[k]),
                f"command [{source}]": float(result.command[k]),
                f"{result.channel} [{output}]": float(result.position[k]),
                f"{result.channel}_std [{output}]": float(result.position_std[k]),
                "creep": float(creep[k]),
                "saturated": bool(saturated[k]),
            }
            for k in range(len(result.command))
        ]
    return [
        {
            "recording": result.sources[int(result.recording[k])],
            "begin [s]": float(result.time[k, 0]),
            "direction": int(result.direction[k]),
            **_columns(result.input_names, source, result.input_mean[k], result.input_std[k]),
            **_columns(result.output_names, output, result.output_mean[k], result.output_std[k]),
            **{
                f"{name}_residual [{output}]": float(value)
                for name, value in zip(result.output_names, result.residual[k], strict=True)
            },
        }
        for k in range(len(result.command))
    ]


def _columns(names: Sequence[str], unit: str, values: Sequence[float], errors: Sequence[float]) -> dict[str, float]:
    columns = {}
    for name, value, error in zip(names, values, errors, strict=True):
        columns[f"{name} [{unit}]"], columns[f"{name}_std [{unit}]"] = float(value), float(error)
    return columns
