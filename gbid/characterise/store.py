"""Static maps and piezo curves in HDF5 (kinds ``static_map`` and ``piezo_curve``) and as tidy csv."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np

from gbid.characterise.piezo import PiezoCurve
from gbid.characterise.static_map import StaticMap
from gbid.hdf5 import add_dataset, read_attribute, read_dataset, reading, writing

Stored = TypeVar("Stored", StaticMap, PiezoCurve)

# Unit of each dataset, of the input ("in"), the output ("out") or one of its own, and its name in words.
_MAP = {
    "gain": ("gain", "static gains"),
    "covariance": ("gain^2", "covariance of the gains, row by row"),
    "offset": ("out", "equilibrium without input, for each recording"),
    "rms": ("out", "rms deviation from linear"),
    "largest": ("out", "largest deviation from linear"),
    "hysteresis": ("out", "largest difference between up and down branch"),
    "hysteresis_std": ("out", "standard error of the hysteresis"),
    "recording": ("1", "number of the recording"),
    "axis": ("1", "input whose staircase it belongs to; -1 rest, -2 several"),
    "direction": ("1", "way of the last step"),
    "command": ("in", "level of the command"),
    "input_mean": ("in", "steady input"),
    "input_std": ("in", "standard error of the steady input"),
    "output_mean": ("out", "steady output"),
    "output_std": ("out", "standard error of the steady output"),
    "residual": ("out", "deviation from linear"),
    "drift": ("out", "change over the steady part"),
    "time": ("s", "begin and end of the steady part"),
}
_CURVE = {
    "command": ("in", "level of the command"),
    "position": ("out", "stationary position"),
    "position_std": ("out", "standard error of the stationary position"),
    "time": ("s", "begin of the plateau"),
    "direction": ("1", "way of the last step"),
    "hysteresis": ("out", "largest difference between up and down branch"),
    "hysteresis_std": ("out", "standard error of the hysteresis"),
    "hysteresis_at": ("in", "command at which it occurs"),
    "hysteresis_share": ("1", "hysteresis over the range of positions"),
    "step": ("in", "commanded steps"),
    "step_gain": ("gain", "change of position over commanded step"),
    "creep": ("1", "creep over the plateau relative to the step"),
    "saturated": ("1", "steps at the end of the travel"),
    "uniformity": ("1", "standard deviation over mean of the step gains"),
    "response_time": ("s", "time since the step"),
    "responses": ("out", "position since each step less that before it"),
}
_KINDS: dict[type, tuple[str, dict[str, tuple[str, str]]]] = {
    StaticMap: ("static_map", _MAP),
    PiezoCurve: ("piezo_curve", _CURVE),
}


def save_static(result: StaticMap | PiezoCurve, path: str | Path, overwrite: bool = False) -> None:
    """Store a static map or a piezo curve.

    Parameters
    ----------
    result : StaticMap or PiezoCurve
    path : path
        The new file.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When it cannot be written.
    """
    kind, table = _KINDS[type(result)]
    source, output = result.units
    units = {"in": source, "out": output, "gain": f"{output}/{source}", "gain^2": f"({output}/{source})^2"}
    with writing(path, kind, overwrite) as file:
        for name, (unit, words) in table.items():
            add_dataset(file, name, getattr(result, name), units.get(unit, unit), words)
        for item in fields(result):
            value = getattr(result, item.name)
            if item.name in table:
                continue
            if isinstance(value, Mapping):
                file.create_group(item.name).attrs.update(value)
            elif isinstance(value, tuple):
                file.attrs.create(item.name, list(value), dtype=h5py.string_dtype(), shape=(len(value),))
            else:
                file.attrs[item.name] = value


def load_static(path: str | Path, kind: type[Stored]) -> Stored:
    """Read what `save_static` stored.

    Parameters
    ----------
    path : path
    kind : type
        `StaticMap` or `PiezoCurve`.

    Returns
    -------
    StaticMap or PiezoCurve

    Raises
    ------
    DataError
        When the file is missing, unreadable, incomplete or of the other kind.
    """
    word, table = _KINDS[kind]
    values: dict[str, Any] = {}
    with reading(path, word) as file:
        for item in fields(kind):
            if item.name in table:
                array = read_dataset(file, item.name)
                values[item.name] = float(array) if array.ndim == 0 else array
            elif item.name == "conditions":
                values[item.name] = {key: float(value) for key, value in file[item.name].attrs.items()}
            else:
                found = read_attribute(file, item.name)
                plain = found if isinstance(found, str) else int(found) if np.ndim(found) == 0 else None
                values[item.name] = tuple(str(text) for text in found) if plain is None else plain
    return kind(**values)


def static_rows(result: StaticMap | PiezoCurve) -> list[dict[str, Any]]:
    """One row for each plateau, ready for csv: names with their units in brackets."""
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
