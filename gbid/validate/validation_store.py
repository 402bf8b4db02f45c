"""Summaries of validation in HDF5 and CSV, nominal actuators in YAML; see docs/file-formats.md."""

from __future__ import annotations

import math
import sys
import warnings
from pathlib import Path

from gbid import hdf5
from gbid.atomic import atomic_path
from gbid.errors import ChangedFileWarning, DataError
from gbid.naming.paths import given_path
from gbid.tables.table import Table, Value, plain_table
from gbid.validate.central import ACTUATOR, NominalActuator
from gbid.validate.scores import PointSummary, ValidationSummary
from gbid.yaml_file import read_yaml, write_yaml

KIND = hdf5.FileKind("validation_summary", "make it again with `gbid crossval`")
ACTUATORS_KIND = "actuators"


def save_validation_summary(summary: ValidationSummary, path: str | Path, overwrite: bool = False) -> None:
    """Write a summary of a cross-validation to an HDF5 file.

    Parameters
    ----------
    summary : ValidationSummary
        The summary.
    path : str or path
        The file.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When the file cannot be written.
    """
    hdf5.save(summary, path, KIND, overwrite)


def load_validation_summary(path: str | Path) -> ValidationSummary:
    """Return the summary in a file of `save_validation_summary`.

    Parameters
    ----------
    path : str or path
        The file.

    Returns
    -------
    ValidationSummary
        The summary.

    Raises
    ------
    DataError
        When the file is missing, damaged or of another kind.
    """
    return hdf5.load(path, KIND, ValidationSummary)


def summary_csv_table(summary: ValidationSummary) -> Table:
    """Return a table of mean and std of the fit percent, a row for each output: all pairs, then each point."""
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
    """Write a nominal actuator to a YAML file; its block ``actuators`` is that of a model file.

    Parameters
    ----------
    nominal : NominalActuator
        The nominal actuator.
    path : path
        The file.
    source : str
        Source of the model; by default the name of the chosen model.
    overwrite : bool
        Whether an existing file may be replaced.
    comment : str
        First line of the file, without ``#``.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When the file cannot be written.
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
    with atomic_path(given_path(path), overwrite) as part:
        write_yaml({key: value for key, value in contents.items() if value not in ([], {})}, part, comment)


def load_actuators(path: str | Path) -> dict[str, float]:
    """Return the parameters of a nominal actuator for `gbid.LPVModel`.

    Parameters
    ----------
    path : str or path
        YAML file of `save_nominal_actuator` or of an experiment.

    Returns
    -------
    dict of str to float
        Actuator parameters by name.

    Raises
    ------
    UsageError
        When the file is missing or not YAML.
    DataError
        When the file is of another kind, or a parameter is missing or not a positive number.

    Warns
    -----
    ChangedFileWarning
        When the file was changed by hand after gbid wrote it.
    """
    file = read_yaml(given_path(path))
    data = file.data
    found = data.get("actuators")
    if data.get("kind") != ACTUATORS_KIND or not isinstance(found, dict):
        raise DataError(f"{path}: not a file with a nominal actuator (kind: {ACTUATORS_KIND}); run `gbid run`")
    for name in ACTUATOR:
        value = found.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= sys.float_info.max:
            raise DataError(f"{path}: actuators.{name} = {value!r}; expected a positive number")
    for note in file.notes:
        warnings.warn(note, ChangedFileWarning, stacklevel=2)
    return {name: float(found[name]) for name in ACTUATOR}


def _known(value: float) -> float | None:
    return None if math.isnan(value) else float(value)
