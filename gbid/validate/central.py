"""Nominal actuator (most central of many models) with outliers, its file, and the CSV summary of a validation."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import scipy

from gbid.core.arrays import FloatArray
from gbid.core.brief import Brief, Description, brief, estimates
from gbid.core.errors import ChangedFileWarning, DataError, UsageError
from gbid.core.figures import Figure, Pictured
from gbid.core.files import atomic_path
from gbid.core.names import given_path
from gbid.core.tables import Column, Entry, Row, Table, Value, finite_or_none, plain_table
from gbid.core.yaml_file import read_yaml, write_yaml
from gbid.identify import FitResult, FitTable
from gbid.identify.table import TableEntry, tabulate
from gbid.structure import PiezoPair
from gbid.validate.crossval import PointSummary, ValidationSummary

ACTUATOR = tuple(f"{name}_{axis}" for axis in "xy" for name in ("p1", "p2", "kappa"))
"""Parameters of an actuator model: a slow pole, a fast pole and a gain for each axis (Eq. 12)."""

_MAD = 1.4826  # standard deviation of a normal variable over its median absolute deviation
_EFFICIENCY = 0.37  # efficiency of the median absolute deviation relative to the standard deviation, for normal data
_LEAST = 3.5  # Iglewicz and Hoaglin, How to Detect and Handle Outliers (1993)
_FALSE_ALARM = 0.05  # probability of at least one outlier when all entries are normal


@dataclass(frozen=True)
class ActuatorOutlier:
    """Outlier among actuator models: one parameter differs much from the other models.

    Attributes
    ----------
    model, parameter : str
        Names of the model and of the parameter.
    kind : {"pole", "gain"}
        Kind of parameter.
    value : float
        Value in this model, [rad/s] for a pole, [m/m] for a gain.
    typical : float
        Median over the models, in the same unit.
    z : float
        Deviation of the logarithm from the median, in robust standard deviations.
    """

    model: str
    parameter: str
    kind: str
    value: float
    typical: float
    z: float

    @property
    def reason(self) -> str:
        """Description of the outlier: parameter, value, median and deviation."""
        unit = " rad/s" if self.kind == "pole" else ""
        return (
            f"{self.parameter} = {self.value:.4g}{unit}, median {self.typical:.4g}{unit}: "
            f"{self.z:+.1f} robust standard deviations"
        )


@dataclass(frozen=True, eq=False)
class NominalActuator(Brief, Pictured):
    """Nominal actuator: the most central of n actuator models with six parameters.

    Attributes
    ----------
    name : str
        Name of the chosen model.
    parameters : dict of str to float
        Its poles [rad/s], the slow one first, and gains [m/m].
    std : dict of str to float
        Their standard deviations from its fit; nan where they are unknown.
    models : tuple of str, n
        Names of all models that were compared.
    parameter_names : tuple of str, 6
        Names of the parameters, in the order of the columns below.
    values : (n, 6) array
        Parameters of all models, the slow pole first [rad/s, m/m].
    z : (n, 6) array
        Deviations of their logarithms from the medians, in robust standard deviations.
    distances : (n,) array
        Mean distance of each model to the others, in robust standard deviations. The chosen model has the smallest.
    limit : float
        Largest absolute `z` that is not an outlier.
    outliers : tuple of ActuatorOutlier
        Outliers, the farthest first.
    left_out : tuple of str
        Models that were not compared, with the reason.
    """

    name: str
    parameters: dict[str, float]
    std: dict[str, float]
    models: tuple[str, ...]
    parameter_names: tuple[str, ...]
    values: FloatArray
    z: FloatArray
    distances: FloatArray
    limit: float
    outliers: tuple[ActuatorOutlier, ...]
    left_out: tuple[str, ...]

    def _brief(self) -> Description:
        return brief(
            self,
            f"{self.name}, the most central of {len(self.models)} models",
            parameters=estimates(self.parameters, self.std, self.parameters),
            outliers=f"{len(self.outliers)} beyond {self.limit:g} robust standard deviations",
            left_out=self.left_out,
        )

    def document(self) -> Row:
        """Return the nominal actuator and the outliers with reasons as plain values, for JSON."""
        return {
            "model": self.name,
            "parameters": self.parameters,
            "std": self.std,
            "chosen_from": len(self.models),
            "distance": float(self.distances.min()),
            "outliers": [{**asdict(outlier), "reason": outlier.reason} for outlier in self.outliers],
            "left_out": list(self.left_out),
        }

    def tables(self) -> list[Table]:
        """Return the tables of poles, gains and (where found) outliers."""
        units = {p.name: p.unit for pair in (PiezoPair(), PiezoPair(poles="any")) for p in pair.parameters}
        first: tuple[Entry, ...] = (self.name, f"of {len(self.models)} models")
        rows: list[list[Entry]] = [
            [first[i] if i < 2 else "", name, value, self.std[name], units.get(name, "")]
            for i, (name, value) in enumerate(self.parameters.items())
        ]
        columns = [
            Column("most central model"),
            Column("parameter"),
            Column("value", format=5),
            Column("std", format=2),
        ]
        off: list[list[Entry]] = [[q.model, q.reason] for q in self.outliers]
        off += [["left out", text] for text in self.left_out]
        outliers = Table("outliers", [Column("model"), Column("why", wrap=True)], off)
        chosen = Table("nominal actuator", [*columns, Column("unit")], rows)
        return [chosen, outliers] if off else [chosen]

    def figures(self) -> list[Figure]:
        """Return the figures of gains and poles of all models."""
        caption = f"Gains and poles of {len(self.models)} actuator models; the nominal one is {self.name}"
        return [Figure("plot_actuator_parameters", f"{caption}, {len(self.outliers)} values lie off", (self,))]


def nominal_actuator(models: FitTable | Sequence[FitResult], fit: str | None = None) -> NominalActuator:
    """Return the most central of many actuator models, and the outliers.

    Parameters
    ----------
    models : FitTable or sequence of FitResult
        Fits of `gbid.PiezoPair`, or others with its parameters. Fits that failed or did not converge are left out.
    fit : str, optional
        Name of the fit, when a table has several.

    Returns
    -------
    NominalActuator

    Raises
    ------
    UsageError
        When the fits do not have the parameters of an actuator, or when a table has several fits and `fit` is not
        given.
    DataError
        When no fit converged.

    Notes
    -----
    Poles and gains scatter by factors, so their logarithms are compared. The two poles of an axis are sorted, because a
    fit may find them in either order. Each column is centred by its median and scaled by its median absolute deviation;
    outliers change neither. The nominal model is the medoid: the model with the smallest sum of distances to all others
    (Kaufman and Rousseeuw, *Finding Groups in Data*, 1990). So it is one of the identified models, as No. 39 in the
    paper, and its parameters belong together; this does not hold for a mean or median of each parameter. Distances are
    not squared, so far models have little effect.

    The scale of a column is at least the median standard deviation of its estimates, so that a deviation within the
    uncertainty of the estimates is not an outlier. A parameter is an outlier when ``|z| > 3.5`` (Iglewicz and Hoaglin
    1993). The limit is larger for many parameters, because some normal values then exceed 3.5 by chance, and for few
    models, because the scale is then uncertain. It is a quantile of Student's t distribution with 0.37 (n - 1)
    degrees of freedom, where 0.37 is the efficiency of the scale.

    Two other rules were considered. The Mahalanobis distance from a robust covariance needs many more models than
    parameters. The best cross-validation does not separate the models: fits of actuators differ by hundredths of a
    percent, which does not determine the poles.
    """
    table = _one_fit(models, fit)
    if missing := [name for name in ACTUATOR if name not in table.parameter_names]:
        raise UsageError(
            f"the fits are not actuator models, they have no {', '.join(missing)}; give fits of PiezoPair "
            "with real poles (structure: piezo_pair)"
        )
    values = np.column_stack([table.parameter(name) for name in ACTUATOR])
    std = np.column_stack([table.std[:, table.parameter_names.index(name)] for name in ACTUATOR])
    for slow in (0, 3):
        swapped = np.flatnonzero(values[:, slow] > values[:, slow + 1])[:, None]
        values[swapped, [slow, slow + 1]] = values[swapped, [slow + 1, slow]]
        std[swapped, [slow, slow + 1]] = std[swapped, [slow + 1, slow]]
    good = table.success & (np.nan_to_num(values) > 0).all(axis=1)
    left_out = tuple(f"{table.model[i]}: {table.status[i]}" for i in np.flatnonzero(~good))
    if not good.any():
        raise DataError(f"none of {len(table)} actuator fits converged; the first: {left_out[0]}")
    values, std = values[good], std[good]
    names = tuple(str(name) for name in table.model[good])
    logs = np.log(values)
    z = _robust_z(logs, std / values)
    distances = np.linalg.norm(z[:, None] - z[None], axis=2).sum(axis=1) / max(1, len(z) - 1)
    chosen = int(np.argmin(distances))
    freedom = max(1.0, _EFFICIENCY * (len(z) - 1))
    limit = max(_LEAST, float(-scipy.special.stdtrit(freedom, _FALSE_ALARM / (2 * z.size))))
    medians = np.exp(np.median(logs, axis=0))
    off = [
        ActuatorOutlier(
            names[i],
            ACTUATOR[j],
            "gain" if ACTUATOR[j].startswith("kappa") else "pole",
            float(values[i, j]),
            float(medians[j]),
            float(z[i, j]),
        )
        for i, j in zip(*np.nonzero(np.abs(z) > limit), strict=True)
    ]
    return NominalActuator(
        name=names[chosen],
        parameters=dict(zip(ACTUATOR, values[chosen].tolist(), strict=True)),
        std=dict(zip(ACTUATOR, std[chosen].tolist(), strict=True)),
        models=names,
        parameter_names=ACTUATOR,
        values=values,
        z=z,
        distances=distances,
        limit=limit,
        outliers=tuple(sorted(off, key=lambda o: -abs(o.z))),
        left_out=left_out,
    )


def _one_fit(models: FitTable | Sequence[FitResult], fit: str | None) -> FitTable:
    if not isinstance(models, FitTable):
        if not models:
            raise DataError("no actuator models to choose from; fit some first")
        return tabulate([TableEntry("actuators", r.recordings[0], r.recordings, {}, r) for r in models])
    if fit is not None:
        return models.select(fit=fit)
    several = list(dict.fromkeys(models.fit.tolist()))
    if len(several) > 1:
        raise UsageError(f"the table holds the fits {', '.join(several)}; choose one: fit={several[0]!r}")
    return models


def _robust_z(logs: FloatArray, std: FloatArray) -> FloatArray:
    """Return columns standardised by median and robust scale (at least the median standard deviation)."""
    deviation = logs - np.median(logs, axis=0)
    scale = _MAD * np.median(np.abs(deviation), axis=0)
    typical = [np.median(column[np.isfinite(column)]) if np.isfinite(column).any() else 0.0 for column in std.T]
    return np.asarray(deviation / np.maximum(np.maximum(scale, typical), 1e-9))


# ---- CSV summary of a validation, and YAML file of a nominal actuator; see docs/file-formats.md.

ACTUATORS_KIND = "actuators"


def summary_csv_table(summary: ValidationSummary) -> Table:
    """Return mean and std of the fit percent as a table with rows for outputs, overall and by operating point."""
    names = ("pressure_bar", "speed_rpm", "output", "pairs", "mean", "std", "infinity_norm", "unit")
    rows: list[list[Value]] = []
    every = PointSummary(math.nan, math.nan, summary.n_pairs, summary.mean, summary.std, summary.infinity_norm_max)
    for point in (every, *summary.points):
        place = map(finite_or_none, (point.pressure_bar, point.speed_rpm))
        where: list[Value] = ["all", "all"] if point is every else list(place)
        for j, (output, unit) in enumerate(zip(summary.output_names, summary.output_units, strict=True)):
            numbers = [finite_or_none(column[j]) for column in (point.mean, point.std, point.infinity_norm)]
            rows.append([*where, output, point.n_pairs, *numbers, unit])
    note = "fit percent of simulations over pairs of model and recording; infinity_norm: largest error"
    return plain_table(names, rows, [note])


def save_nominal_actuator(
    nominal: NominalActuator, path: str | Path, *, source: str = "", overwrite: bool = False
) -> None:
    """Write a nominal actuator to a YAML file, with a block ``actuators`` as in model files.

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

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When the file cannot be written.
    """
    origin = source or f"{nominal.name}, the most central of {len(nominal.models)} models"
    contents = {
        "kind": ACTUATORS_KIND,
        "schema_version": 1,
        "name": nominal.name,
        "actuators": {**nominal.parameters, "source": origin},
        "std": {name: value for name, value in nominal.std.items() if math.isfinite(value)},
        "chosen_from": len(nominal.models),
        "outliers": [{"model": o.model, "parameter": o.parameter, "reason": o.reason} for o in nominal.outliers],
        "left_out": list(nominal.left_out),
    }
    with atomic_path(given_path(path), overwrite) as part:
        write_yaml({key: value for key, value in contents.items() if value not in ([], {})}, part)


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
    values = data.get("actuators")
    if data.get("kind") != ACTUATORS_KIND or not isinstance(values, dict):
        raise DataError(f"{path}: not a file with a nominal actuator (kind: {ACTUATORS_KIND}); run `gbid run`")
    for name in ACTUATOR:
        value = values.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= sys.float_info.max:
            raise DataError(f"{path}: actuators.{name} = {value!r}; expected a positive number")
    for note in file.notes:
        warnings.warn(note, ChangedFileWarning, stacklevel=2)
    return {name: float(values[name]) for name in ACTUATOR}
