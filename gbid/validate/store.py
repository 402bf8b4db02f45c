"""Summaries of validation in HDF5 and CSV, nominal actuators in YAML; documented in docs/file-formats.md."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gbid import hdf5
from gbid.atomic import atomic_path
from gbid.errors import DataError
from gbid.tables.table import Table, Value, plain_table
from gbid.validate.central import ACTUATOR, NominalActuator
from gbid.validate.scores import PointSummary, ValidationSummary, WorstPair
from gbid.yaml_file import read_yaml, write_yaml

KIND = "validation_summary"
ACTUATORS_KIND = "actuators"
_TEXT = h5py.string_dtype()
_COUNTS = ("n_pairs", "n_models", "n_recordings")
_ARRAYS = {
    "mean": ("%", "mean of the fit percent, outputs"),
    "std": ("%", "standard deviation of the fit percent"),
    "median": ("%", "median of the fit percent"),
    "least": ("%", "smallest fit percent"),
    "greatest": ("%", "largest fit percent"),
    "edges": ("%", "edges of the histograms, outputs by bins + 1"),
    "counts": ("1", "pairs in each bin, outputs by bins"),
    "below": ("1", "pairs below the first edge"),
    "infinity_norm_mean": ("as attribute output_units", "mean of the largest deviations"),
    "infinity_norm_max": ("as attribute output_units", "largest deviation of all pairs"),
}
_POINT = {
    "pressure_bar": ("bar", "supply pressure"),
    "speed_rpm": ("rpm", "shaft speed"),
    "n_pairs": ("1", "pairs of the operating point"),
    "mean": ("%", "mean of the fit percent, points by outputs"),
    "std": ("%", "standard deviation of the fit percent, points by outputs"),
    "infinity_norm": ("as attribute output_units", "largest deviation, points by outputs"),
}
_WORST_TEXTS, _WORST_NUMBERS = ("model", "recording", "output"), ("fit_percent", "infinity_norm")


def save_validation_summary(summary: ValidationSummary, path: str | Path, overwrite: bool = False) -> None:
    """Write a summary of a cross-validation to an HDF5 file.

    Parameters
    ----------
    summary : ValidationSummary
    path : str or path
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When it cannot be written.
    """
    with hdf5.writing(path, KIND, overwrite) as file:
        for name in _COUNTS:
            file.attrs[name] = getattr(summary, name)
        _write_texts(file, output_names=summary.output_names, output_units=summary.output_units, failed=summary.failed)
        for name, (unit, long_name) in _ARRAYS.items():
            hdf5.add_dataset(file, name, getattr(summary, name), unit, long_name)
        points = file.create_group("points")
        for name, (unit, long_name) in _POINT.items():
            values = np.array([getattr(point, name) for point in summary.points])
            hdf5.add_dataset(points, name, values, unit, long_name)
        worst = file.create_group("worst")
        _write_texts(worst, **{name: [getattr(pair, name) for pair in summary.worst] for name in _WORST_TEXTS})
        for name in _WORST_NUMBERS:
            unit = "%" if name == "fit_percent" else "as the output's"
            values = np.array([getattr(pair, name) for pair in summary.worst], dtype=float)
            hdf5.add_dataset(worst, name, values, unit, name.replace("_", " "))


def load_validation_summary(path: str | Path) -> ValidationSummary:
    """Read a summary that `save_validation_summary` wrote.

    Parameters
    ----------
    path : str or path

    Raises
    ------
    DataError
        When the file is missing, damaged or of another kind.
    """
    with hdf5.reading(path, KIND) as file:
        arrays: dict[str, Any] = {name: hdf5.read_dataset(file, name) for name in _ARRAYS}
        columns = {name: hdf5.read_dataset(file["points"], name) for name in _POINT}
        points = [
            PointSummary(float(p), float(w), int(n), *rest) for p, w, n, *rest in zip(*columns.values(), strict=True)
        ]
        texts = [_texts(file["worst"], name) for name in _WORST_TEXTS]
        numbers = [hdf5.read_dataset(file["worst"], name).tolist() for name in _WORST_NUMBERS]
        arrays |= {name: int(hdf5.read_attribute(file, name)) for name in _COUNTS}
        return ValidationSummary(
            output_names=_texts(file, "output_names"),
            output_units=_texts(file, "output_units"),
            **arrays,
            worst=tuple(WorstPair(*row) for row in zip(*texts, *numbers, strict=True)),
            points=tuple(points),
            failed=_texts(file, "failed"),
        )


def summary_csv_table(summary: ValidationSummary) -> Table:
    """Mean and standard deviation of the fit percent, a row for each output: of all pairs, then of each point."""
    names = ("pressure_bar", "speed_rpm", "output", "pairs", "mean", "std", "infinity_norm", "unit")
    rows: list[list[Value]] = []
    every = PointSummary(math.nan, math.nan, summary.n_pairs, summary.mean, summary.std, summary.infinity_norm_max)
    for point in (every, *summary.points):
        where: list[Value] = ["all", "all"] if point is every else [_known(point.pressure_bar), _known(point.speed_rpm)]
        for j, (output, unit) in enumerate(zip(summary.output_names, summary.output_units, strict=True)):
            numbers = [_known(column[j]) for column in (point.mean, point.std, point.infinity_norm)]
            rows.append([*where, output, point.n_pairs, *numbers, unit])
    note = "fit percent of simulations over pairs of model and recording; infinity_norm: largest error"
    return plain_table(names, rows, [note])


def save_nominal_actuator(
    nominal: NominalActuator, path: str | Path, *, source: str = "", overwrite: bool = False, comment: str = ""
) -> None:
    """Write a nominal actuator as YAML; its block ``actuators`` is that of a model file.

    Parameters
    ----------
    nominal : NominalActuator
    path : path
    source : str
        Where the model comes from; the name of the chosen one by default.
    overwrite : bool
        Whether an existing file may be replaced.
    comment : str
        First line of the file, without ``#``.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When it cannot be written.
    """
    said = source or f"{nominal.name}, the most central of {len(nominal.models)} models"
    contents = {
        "kind": ACTUATORS_KIND,
        "schema_version": 1,
        "name": nominal.name,
        "actuators": {**nominal.parameters, "source": said},
        "std": {name: value for name, value in nominal.std.items() if math.isfinite(value)},
        "chosen_from": len(nominal.models),
        "outliers": [{"model": o.model, "parameter": o.parameter, "reason": o.reason} for o in nominal.outliers],
        "left_out": list(nominal.left_out),
    }
    with atomic_path(Path(path), overwrite) as part:
        write_yaml({key: value for key, value in contents.items() if value not in ([], {})}, part)
        if comment:
            part.write_text(f"# {comment}\n{part.read_text(encoding='utf-8')}", encoding="utf-8")


def load_actuators(path: str | Path) -> dict[str, float]:
    """Read the parameters of a nominal actuator, as `gbid.LPVModel` takes them.

    Parameters
    ----------
    path : str or path
        The YAML that `save_nominal_actuator` or an experiment wrote.

    Raises
    ------
    UsageError
        When the file is missing or no YAML.
    DataError
        When it is another file, or a parameter is missing or no positive number.
    """
    data = read_yaml(Path(path)).data
    found = data.get("actuators")
    if data.get("kind") != ACTUATORS_KIND or not isinstance(found, dict):
        raise DataError(f"{path}: not a file with a nominal actuator (kind: {ACTUATORS_KIND}); `gbid run` makes one")
    for name in ACTUATOR:
        value = found.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
            raise DataError(f"{path}: actuators.{name} = {value!r}; expected a positive number")
    return {name: float(found[name]) for name in ACTUATOR}


def _known(value: float) -> float | None:
    return None if math.isnan(value) else float(value)


def _write_texts(item: h5py.Group, **texts: Any) -> None:
    for name, values in texts.items():
        item.attrs.create(name, list(values), shape=(len(values),), dtype=_TEXT)


def _texts(item: h5py.HLObject, name: str) -> tuple[str, ...]:
    return tuple(str(text) for text in np.atleast_1d(hdf5.read_attribute(item, name)))
