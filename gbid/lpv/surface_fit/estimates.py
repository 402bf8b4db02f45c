"""Estimates to which surfaces are fitted: one row for each recording, without failed fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from gbid.arrays import BoolArray, FloatArray
from gbid.brief import Brief
from gbid.errors import DataError, UsageError
from gbid.hdf5 import Stored
from gbid.identify.result import FitResult
from gbid.identify.table.fit_table import FitTable
from gbid.structure import KEY_PARAMETERS


@dataclass(frozen=True, eq=False)
class Estimates(Brief):
    """Estimated key parameters of n recordings.

    Attributes
    ----------
    recordings : tuple of str
        Names of the recordings.
    points : (n, 2) array
        Pressure [bar] and speed [rpm].
    values : (n, 14) array
        Estimates in the order of `gbid.structure.KEY_PARAMETERS`, SI per kg.
    covariance : (n, 14, 14) array
        Covariance of each row; nan where a fit has none.
    left_out : tuple of str
        ``"name: reason"`` of each fit that was left out.
    """

    recordings: tuple[str, ...]
    points: Annotated[FloatArray, Stored("bar and rpm", "operating points of the recordings", "n 2")]
    values: Annotated[FloatArray, Stored("SI per kg", "estimates, recordings by parameters", "n k")]
    covariance: Annotated[FloatArray, Stored("SI per kg", "their covariances", "n k k")]
    left_out: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n, k = len(self.recordings), len(KEY_PARAMETERS)
        shapes = {"points": (n, 2), "values": (n, k), "covariance": (n, k, k)}
        for name, shape in shapes.items():
            array = np.asarray(getattr(self, name), float)
            if array.shape != shape:
                raise UsageError(f"estimates: {name} has shape {array.shape}, expected {shape}")
            object.__setattr__(self, name, array)


def as_estimates(
    fits: FitTable | Sequence[FitResult] | Estimates,
    points: Sequence[tuple[float, float]] | None = None,
) -> Estimates:
    """Return the estimates of a table, or of fit results with their operating points.

    Parameters
    ----------
    fits : FitTable, sequence of FitResult, or Estimates
        Fits with all fourteen key parameters.
    points : sequence of (pressure_bar, speed_rpm), optional
        Operating point of each fit result; a table contains them.

    Returns
    -------
    Estimates
        Estimates without fits that failed or have values that are not finite.

    Raises
    ------
    UsageError
        When a fit result has no operating point, or when a key parameter is missing.
    DataError
        When no fit remains.
    """
    if isinstance(fits, Estimates):
        return _finite(fits, np.ones(len(fits.recordings), dtype=bool))
    if isinstance(fits, Sequence):
        return _of_results(fits, points)
    if points is not None:
        raise UsageError("points: a table of fits contains its operating points; leave points out")
    kinds = list(dict.fromkeys(fits.fit.tolist()))
    if len(kinds) > 1:
        raise UsageError(f"the table holds the fits {', '.join(kinds)}; choose one: table.select(fit=...)")
    missing = [key for key in KEY_PARAMETERS if key not in fits.parameter_names]
    if missing:
        raise UsageError(f"the table of fits has no {', '.join(missing)}; the surfaces need all key parameters")
    columns = [fits.parameter_names.index(key) for key in KEY_PARAMETERS]
    found = Estimates(
        tuple(" + ".join(names) for names in fits.recordings),
        np.stack([fits.pressure_bar, fits.speed_rpm], axis=-1),
        fits.values[:, columns],
        fits.covariance_of(KEY_PARAMETERS),
    )
    return _finite(found, fits.success)


def _of_results(fits: Sequence[FitResult], points: Sequence[tuple[float, float]] | None) -> Estimates:
    if points is None or len(points) != len(fits):
        given = "none" if points is None else str(len(points))
        raise UsageError(
            f"points: give the (pressure_bar, speed_rpm) of each of the {len(fits)} fits; there are {given}"
        )
    names, values, covariances = [], [], []
    for fit in fits:
        name = " + ".join(fit.recordings)
        missing = [key for key in KEY_PARAMETERS if key not in fit.parameters]
        if missing:
            raise UsageError(f"fit of {name!r} has no {', '.join(missing)}; the surfaces need all key parameters")
        names.append(name)
        values.append([fit.parameters[key] for key in KEY_PARAMETERS])
        covariances.append(_covariance_of(fit))
    grid = np.array([tuple(map(float, point)) for point in points]).reshape(-1, 2)
    k = len(KEY_PARAMETERS)
    found = Estimates(
        tuple(names), grid, np.reshape(values, (-1, k)), np.reshape(np.array(covariances), (len(names), k, k))
    )
    return _finite(found, np.array([fit.success for fit in fits], dtype=bool))


def _covariance_of(fit: FitResult) -> FloatArray:
    """Return the covariance of the key parameters, with zero rows for fixed ones."""
    position: Mapping[str, int] = {name: i for i, name in enumerate(fit.free)}
    k = len(KEY_PARAMETERS)
    found = np.zeros((k, k))
    own = [i for i, key in enumerate(KEY_PARAMETERS) if key in position]
    there = [position[KEY_PARAMETERS[i]] for i in own]
    found[np.ix_(own, own)] = fit.covariance[np.ix_(there, there)]
    return found


def _finite(found: Estimates, success: BoolArray) -> Estimates:
    """Return the estimates without failed fits and values that are not finite; list these by name."""
    keep, left_out = [], list(found.left_out)
    for i, name in enumerate(found.recordings):
        bad = [key for key, v in zip(KEY_PARAMETERS, found.values[i], strict=True) if not np.isfinite(v)]
        if not np.isfinite(found.points[i]).all():
            left_out.append(f"{name}: no operating point (pressure_bar and speed_rpm)")
        elif not success[i]:
            left_out.append(f"{name}: its fit did not converge")
        elif bad:
            left_out.append(f"{name}: {', '.join(bad)} not finite")
        else:
            keep.append(i)
    if not keep:
        reasons = "; ".join(left_out[:3]) or "there are none"
        raise DataError(f"there is no fit to which surfaces can be fitted ({reasons})")
    rows = np.array(keep)
    return Estimates(
        tuple(found.recordings[i] for i in keep),
        found.points[rows],
        found.values[rows],
        found.covariance[rows],
        tuple(left_out),
    )
