"""Estimates to which surfaces are fitted: one row for each recording, without failed fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from gbid.arrays import BoolArray, FloatArray
from gbid.brief import Brief
from gbid.errors import DataError, UsageError
from gbid.hdf5 import NOT_STORED, Stored
from gbid.identify.result import FitResult
from gbid.identify.table.fit_table import FitTable
from gbid.lpv.basis import SCHEDULING
from gbid.structure import KEY_PARAMETERS


@dataclass(frozen=True, eq=False)
class Estimates(Brief):
    """Estimated parameters of n recordings at their operating points.

    Attributes
    ----------
    recordings : tuple of str
        Names of the recordings.
    points : (n, n_variables) array
        Operating points; of a gas bearing pressure [bar] and speed [rpm].
    values : (n, k) array
        Estimates in the order of `parameters`; of a gas bearing SI per kg.
    covariance : (n, k, k) array
        Covariance of each row; nan where a fit has none.
    left_out : tuple of str
        ``"name: reason"`` of each fit that was left out.
    parameters : tuple of str, k
        Names of the parameters; by default the key parameters of a gas bearing.
    scheduling : tuple of str, n_variables
        Names of the scheduling variables; by default pressure_bar and speed_rpm.
    """

    recordings: tuple[str, ...]
    points: Annotated[FloatArray, Stored("bar and rpm", "operating points of the recordings", "n 2")]
    values: Annotated[FloatArray, Stored("SI per kg", "estimates, recordings by parameters", "n k")]
    covariance: Annotated[FloatArray, Stored("SI per kg", "their covariances", "n k k")]
    left_out: tuple[str, ...] = ()
    parameters: Annotated[tuple[str, ...], NOT_STORED] = KEY_PARAMETERS
    scheduling: Annotated[tuple[str, ...], NOT_STORED] = SCHEDULING

    def __post_init__(self) -> None:
        n, k = len(self.recordings), len(self.parameters)
        shapes = {"points": (n, len(self.scheduling)), "values": (n, k), "covariance": (n, k, k)}
        for name, shape in shapes.items():
            array = np.asarray(getattr(self, name), float)
            if array.shape != shape:
                raise UsageError(f"estimates: {name} has shape {array.shape}, expected {shape}")
            object.__setattr__(self, name, array)

    def rows(self, keep: Sequence[int]) -> Estimates:
        """Return the estimates of some recordings, by their positions."""
        names = tuple(self.recordings[i] for i in keep)
        own = np.array(keep, dtype=int)
        return replace(
            self, recordings=names, points=self.points[own], values=self.values[own], covariance=self.covariance[own]
        )


def as_estimates(
    fits: FitTable | Sequence[FitResult] | Estimates,
    points: Sequence[Sequence[float]] | None = None,
    parameters: tuple[str, ...] = KEY_PARAMETERS,
    scheduling: tuple[str, ...] = SCHEDULING,
) -> Estimates:
    """Return the estimates of a table, or of fit results with their operating points.

    Parameters
    ----------
    fits : FitTable, sequence of FitResult, or Estimates
        Fits with all parameters.
    points : sequence of points, optional
        Operating point of each fit result, in the order of `scheduling`; a table contains those of a gas bearing.
    parameters, scheduling : tuple of str
        Names of parameters and scheduling variables.

    Returns
    -------
    Estimates
        Estimates without fits that failed or have values that are not finite.

    Raises
    ------
    UsageError
        When a fit result has no operating point, or when a parameter is missing.
    DataError
        When no fit remains.
    """
    if isinstance(fits, Estimates):
        return _finite(fits, np.ones(len(fits.recordings), dtype=bool))
    if isinstance(fits, Sequence):
        return _of_results(fits, points, parameters, scheduling)
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


def _of_results(
    fits: Sequence[FitResult],
    points: Sequence[Sequence[float]] | None,
    parameters: tuple[str, ...],
    scheduling: tuple[str, ...],
) -> Estimates:
    what = f"({', '.join(scheduling)})"
    if points is None or len(points) != len(fits):
        given = "none" if points is None else str(len(points))
        raise UsageError(f"points: give the {what} of each of the {len(fits)} fits; there are {given}")
    names, values, covariances = [], [], []
    for fit in fits:
        name = " + ".join(fit.recordings)
        missing = [key for key in parameters if key not in fit.parameters]
        if missing:
            raise UsageError(f"fit of {name!r} has no {', '.join(missing)}; the surfaces need {', '.join(parameters)}")
        names.append(name)
        values.append([fit.parameters[key] for key in parameters])
        covariances.append(_covariance_of(fit, parameters))
    try:
        grid = np.array([np.asarray(point, float).reshape(len(scheduling)) for point in points])
    except (TypeError, ValueError):
        raise UsageError(f"points: give {what} as numbers for each fit") from None
    k = len(parameters)
    found = Estimates(
        tuple(names),
        grid.reshape(-1, len(scheduling)),
        np.reshape(values, (-1, k)),
        np.reshape(np.array(covariances), (len(names), k, k)),
        parameters=parameters,
        scheduling=scheduling,
    )
    return _finite(found, np.array([fit.success for fit in fits], dtype=bool))


def _covariance_of(fit: FitResult, parameters: tuple[str, ...]) -> FloatArray:
    """Return the covariance of some parameters, with zero rows for fixed ones."""
    position: Mapping[str, int] = {name: i for i, name in enumerate(fit.free)}
    k = len(parameters)
    found = np.zeros((k, k))
    own = [i for i, key in enumerate(parameters) if key in position]
    there = [position[parameters[i]] for i in own]
    found[np.ix_(own, own)] = fit.covariance[np.ix_(there, there)]
    return found


def _finite(found: Estimates, success: BoolArray) -> Estimates:
    """Return the estimates without failed fits and values that are not finite; list these by name."""
    keep, left_out = [], list(found.left_out)
    for i, name in enumerate(found.recordings):
        bad = [key for key, v in zip(found.parameters, found.values[i], strict=True) if not np.isfinite(v)]
        if not np.isfinite(found.points[i]).all():
            left_out.append(f"{name}: no operating point ({' and '.join(found.scheduling)})")
        elif not success[i]:
            left_out.append(f"{name}: its fit did not converge")
        elif bad:
            left_out.append(f"{name}: {', '.join(bad)} not finite")
        else:
            keep.append(i)
    if not keep:
        reasons = "; ".join(left_out[:3]) or "there are none"
        raise DataError(f"there is no fit to which surfaces can be fitted ({reasons})")
    return replace(found.rows(keep), left_out=tuple(left_out))
