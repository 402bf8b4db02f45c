"""The nominal actuator: the most central of many models, and those that lie off (paper, Sec. 3.7, Fig. 8)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from gbid.arrays import FloatArray
from gbid.brief import brief, estimates
from gbid.errors import DataError, UsageError
from gbid.identify import FitResult, FitTable, TableEntry, tabulate

ACTUATOR = tuple(f"{name}_{axis}" for axis in "xy" for name in ("p1", "p2", "kappa"))
"""Parameters of an actuator model: a slow pole, a fast pole and a gain for each axis (Eq. 12)."""

_MAD = 1.4826  # standard deviation of a normal variable over its median absolute deviation
_EFFICIENCY = 0.37  # of the median absolute deviation, beside the standard deviation, for normal data
_LEAST = 3.5  # Iglewicz and Hoaglin, How to Detect and Handle Outliers (1993)
_FALSE_ALARM = 0.05  # probability that any entry is named when all are normal


@dataclass(frozen=True)
class ActuatorOutlier:
    """A parameter of a model that lies off those of the others.

    Attributes
    ----------
    model, parameter : str
    kind : {"pole", "gain"}
    value : float
        [rad/s] for a pole, [m/m] for a gain.
    typical : float
        Median over the models.
    z : float
        Deviation of the logarithm in robust standard deviations.
    """

    model: str
    parameter: str
    kind: str
    value: float
    typical: float
    z: float

    @property
    def reason(self) -> str:
        """The finding in words."""
        unit = " rad/s" if self.kind == "pole" else ""
        return (
            f"{self.parameter} = {self.value:.4g}{unit}, median {self.typical:.4g}{unit}: "
            f"{self.z:+.1f} robust standard deviations"
        )


@dataclass(frozen=True, eq=False)
class NominalActuator:
    """The most central of many actuator models; n models, six parameters.

    Attributes
    ----------
    name : str
        The model that was chosen.
    parameters : dict of str to float
        Its poles [rad/s], the slow one first, and gains.
    std : dict of str to float
        Their standard deviations from its fit; nan where there is none.
    models : tuple of str, n
        The models that it was chosen from.
    parameter_names : tuple of str, 6
    values : (n, 6) array
        Parameters of all models, the slow pole first.
    z : (n, 6) array
        Deviations of their logarithms from the medians, in robust standard deviations.
    distances : (n,) array
        Mean distance of each model to the others, in robust standard deviations; the smallest is the chosen one's.
    limit : float
        The `z` beyond which a parameter lies off.
    outliers : tuple of ActuatorOutlier
        The farthest first.
    left_out : tuple of str
        Models that were not looked at, and why.
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

    def __repr__(self) -> str:
        return brief(
            self,
            f"{self.name}, the most central of {len(self.models)} models",
            parameters=estimates(self.parameters, self.std, self.parameters),
            outliers=f"{len(self.outliers)} beyond {self.limit:g} robust standard deviations",
            left_out=self.left_out,
        )


def nominal_actuator(models: FitTable | Sequence[FitResult], fit: str | None = None) -> NominalActuator:
    """Choose the most central of many actuator models, and name those that lie off.

    Parameters
    ----------
    models : FitTable or sequence of FitResult
        Fits of `gbid.PiezoPair`, or others with its parameters. Fits that failed or did not converge are left out.
    fit : str, optional
        Which fit of a table with several.

    Returns
    -------
    NominalActuator

    Raises
    ------
    UsageError
        When the fits do not have the parameters of an actuator, or a table holds several fits and `fit` is not given.
    DataError
        When none of them converged.

    Notes
    -----
    Poles and gains scatter by factors, so their logarithms are compared. The two poles of an axis are sorted: a fit
    may find them in either order. Each column is centred by its median and scaled by its median absolute deviation,
    which outliers do not move. The nominal model is the medoid: the one with the smallest sum of distances to all
    others (Kaufman and Rousseeuw, *Finding Groups in Data*, 1990), so it is a model that was identified, as the
    paper's No. 39, and consistent in itself, which a mean or a median of each parameter is not. Distances are not
    squared, so far ones do not pull.

    The scale of a column is no smaller than the typical standard deviation of its estimates, so that what those
    explain is no outlier. A parameter lies off when ``|z| > 3.5`` (Iglewicz and Hoaglin 1993), or more where so many
    numbers are looked at that normal ones would go beyond by chance, and where the scale is known roughly only: the
    limit is a quantile of Student's distribution, with 0.37 (n - 1) degrees of freedom, the efficiency of the scale.
    Other rules that were weighed: the Mahalanobis distance from a robust
    covariance (needs many more models than parameters), and the model with the best cross-validation (the fits of
    actuators differ by hundredths of a percent, which says little about poles).
    """
    table = _one_fit(models, fit)
    missing = [name for name in ACTUATOR if name not in table.parameter_names]
    if missing:
        raise UsageError(
            f"no actuator models: they have no {', '.join(missing)}; give fits of PiezoPair (structure: piezo_pair)"
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
    limit = max(_LEAST, float(-stdtrit(freedom, _FALSE_ALARM / (2 * z.size))))
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
        raise UsageError(f"the table holds the fits {', '.join(several)}; say which one: fit={several[0]!r}")
    return models


def _robust_z(logs: FloatArray, own: FloatArray) -> FloatArray:
    """Standardise by medians, columns apart; `own` are the standard deviations of the single estimates."""
    deviation = logs - np.median(logs, axis=0)
    scale = _MAD * np.median(np.abs(deviation), axis=0)
    typical = [np.median(column[np.isfinite(column)]) if np.isfinite(column).any() else 0.0 for column in own.T]
    return np.asarray(deviation / np.maximum(np.maximum(scale, typical), 1e-9))
