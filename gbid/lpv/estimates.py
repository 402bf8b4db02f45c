"""Estimates for the fit of surfaces (a row for each recording), and polynomial terms for their operating points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal, NamedTuple

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.brief import Brief
from gbid.core.errors import DataError, UsageError
from gbid.core.hdf5 import NOT_STORED, Stored
from gbid.identify.result import FitResult
from gbid.identify.table import FitTable
from gbid.lpv.model import Domain
from gbid.structure import KEY_PARAMETERS
from gbid.structure.scheduling import SCHEDULING, Exponents, exponents_of, monomials, term_name

# ---- Terms of the surfaces as orthogonal regressors, and whether operating points determine them.

Order = int | Literal["auto"] | Sequence[str]
HIGHEST_ORDER = 3  # highest order that is compared; the model of a gas bearing has the six terms of Eq. 16 only
_PLURAL = dict(zip(SCHEDULING, ("pressures", "speeds"), strict=True))
_UNDETERMINED = 1e-9  # terms are not determined when a singular value is below this share of the largest


class Orthonormal(NamedTuple):
    """Regressors orthogonalised over the operating points.

    Attributes
    ----------
    columns : (n_points, n_terms) array
        Regressors of mean square one, orthogonal to each other.
    back : (n_terms, n_terms) array
        ``coefficients of the terms in bar and rpm = back @ coefficients of the columns``.
    """

    columns: FloatArray
    back: FloatArray


def varying_exponents(points: FloatArray, order: int) -> Exponents:
    """Exponents of terms up to an order in the variables that vary between the points (n, n_variables)."""
    fixed = np.ptp(points, axis=0) == 0
    powers = exponents_of(order, points.shape[1])
    return tuple(e for e in powers if not any(power and fixed[i] for i, power in enumerate(e)))


def possible_order(points: FloatArray, scheduling: Sequence[str] = SCHEDULING) -> int | tuple[str, ...]:
    """Return the highest order up to 2 that the operating points determine, in the form of the argument ``order``.

    It is a list of terms where a variable is the same at all points. Where several vary, one more operating point
    than terms is asked for, because surfaces through all points would fit noise.
    """
    if not len(points):
        return 0
    varying = int((np.ptp(points, axis=0) > 0).sum())
    for order in (2, 1):
        exponents = varying_exponents(points, order)
        enough = len(exponents) + (varying > 1)
        if len(distinct_points(points)) >= enough > 1 and not _undetermined(points, exponents, scheduling):
            return order if varying == points.shape[1] else tuple(term_name(e, scheduling) for e in exponents)
    return 0


def order_words(order: int | Sequence[str]) -> str:
    """Return an order as written in YAML: ``2``, or ``["1", "P", "P^2"]``."""
    return str(order) if isinstance(order, int) else "[" + ", ".join(f'"{term}"' for term in order) + "]"


def chosen_exponents(order: int | Sequence[str], scheduling: Sequence[str] = SCHEDULING) -> Exponents:
    """Return the exponents of the scheduling variables for an order, or for named terms.

    Parameters
    ----------
    order : int or sequence of str
        Order 0 to 2 for a gas bearing, 0 to 3 for other scheduling variables, or names of terms.
    scheduling : sequence of str
        Names of the scheduling variables.

    Raises
    ------
    UsageError
        When there is no such order or term.
    """
    highest = 2 if tuple(scheduling) == SCHEDULING else HIGHEST_ORDER
    possible = exponents_of(highest, len(scheduling))
    names = [term_name(e, scheduling) for e in possible]
    orders = ", ".join(map(str, range(highest + 1)))
    if isinstance(order, int):
        if isinstance(order, bool) or not 0 <= order <= highest:
            raise UsageError(f"order = {order}; choose {orders}, 'auto', or terms out of {', '.join(names)}")
        return exponents_of(order, len(scheduling))
    chosen = (order,) if isinstance(order, str) else tuple(order)
    unknown = [name for name in chosen if name not in names]
    if unknown or not chosen or len(set(chosen)) < len(chosen):
        problem = f"{unknown[0]!r} is not a term" if unknown else "give each term once, and at least one"
        raise UsageError(f"order = {order!r}: {problem}; choose from {', '.join(names)}, or {orders}, 'auto'")
    return tuple(possible[names.index(name)] for name in sorted(chosen, key=names.index))


def orthonormal(points: FloatArray, exponents: Exponents, scheduling: Sequence[str] = SCHEDULING) -> Orthonormal:
    """Return terms orthogonalised over the points: in bar and rpm their sizes differ by large factors.

    Parameters
    ----------
    points : (n, n_variables) array
        Operating points.
    exponents : tuple of tuple of int
        Powers of the scheduling variables in each term.
    scheduling : sequence of str
        Names of the scheduling variables, for messages.

    Returns
    -------
    Orthonormal

    Raises
    ------
    DataError
        When there are fewer operating points than terms, or when they do not determine the terms.
    """
    check_points(points, exponents, scheduling)
    raw = monomials(points, exponents)
    size = np.linalg.norm(raw, axis=0)
    Q, R = np.linalg.qr(raw / size)
    sign = np.where(np.diag(R) < 0, -1.0, 1.0)
    root = np.sqrt(len(points))
    back = np.linalg.solve(R, np.eye(len(R))) * (sign * root) / size[:, None]
    return Orthonormal(Q * (sign * root), back)


def check_points(points: FloatArray, exponents: Exponents, scheduling: Sequence[str] = SCHEDULING) -> None:
    """Refuse operating points that do not determine the terms of a surface; see `orthonormal`."""
    why_not = _undetermined(points, exponents, scheduling)
    if why_not:
        order = order_words(possible_order(points, scheduling))
        raise DataError(f"{why_not}; add operating points, or choose a lower order, such as order: {order}")


def _undetermined(points: FloatArray, exponents: Exponents, scheduling: Sequence[str]) -> str:
    """Return why operating points do not determine the terms; an empty text if they do."""
    names = [term_name(e, scheduling) for e in exponents]
    distinct = distinct_points(points)
    if len(distinct) < len(exponents):
        return f"{len(distinct)} operating points for {len(exponents)} terms ({', '.join(names)})"
    raw = monomials(distinct, exponents)
    size = np.linalg.norm(raw, axis=0)
    empty = [name for name, s in zip(names, size, strict=True) if s == 0]
    if empty:
        return f"operating points: some terms are zero at all of them: {', '.join(empty)}"
    _, s, vectors = np.linalg.svd(raw / size)
    undetermined = vectors[s < _UNDETERMINED * s[0]]
    if not len(undetermined):
        return ""
    involved = np.abs(undetermined).max(axis=0)
    together = ", ".join(name for name, v in zip(names, involved, strict=True) if v > 1e-3)
    levels = "; ".join(
        f"{len(np.unique(distinct[:, i]))} {what} ({', '.join(f'{v:g}' for v in np.unique(distinct[:, i])[:8])})"
        for i, what in enumerate(_PLURAL.get(name, f"values of {name}") for name in scheduling)
    )
    return f"operating points do not determine {together} separately: there are {levels}"


def distinct_points(points: FloatArray) -> FloatArray:
    """Return the distinct operating points, (n_distinct, n_variables), sorted by the first variable, then the next."""
    return np.unique(points, axis=0)


@dataclass(frozen=True, eq=False)
class Estimates(Brief):
    """Estimated parameters of n recordings, with operating points.

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
    points: Annotated[FloatArray, Stored("bar and rpm", "operating points of the recordings", "n v")]
    values: Annotated[FloatArray, Stored("SI per kg", "estimates, recordings by parameters", "n k")]
    covariance: Annotated[FloatArray, Stored("SI per kg", "their covariances", "n k k")]
    left_out: tuple[str, ...] = ()
    parameters: Annotated[tuple[str, ...], NOT_STORED] = KEY_PARAMETERS
    scheduling: Annotated[tuple[str, ...], Stored(late=True)] = SCHEDULING

    def __post_init__(self) -> None:
        n, k = len(self.recordings), len(self.parameters)
        shapes = {"points": (n, len(self.scheduling)), "values": (n, k), "covariance": (n, k, k)}
        for name, shape in shapes.items():
            array = np.asarray(getattr(self, name), float)
            if array.shape != shape:
                raise UsageError(f"estimates: {name} has shape {array.shape}, expected {shape}")
            object.__setattr__(self, name, array)

    @property
    def domain(self) -> Domain:
        """Smallest domain that contains the operating points."""
        lowest, highest = self.points.min(axis=0), self.points.max(axis=0)
        return Domain(*zip(lowest.tolist(), highest.tolist(), strict=True), variables=self.scheduling)

    @property
    def operating_points(self) -> tuple[tuple[float, ...], ...]:
        """Distinct operating points, sorted by the first scheduling variable, then the next."""
        return tuple(tuple(point) for point in distinct_points(self.points).tolist())

    def rows(self, keep: Sequence[int]) -> Estimates:
        """Return the estimates of selected recordings, by position."""
        chosen = np.array(keep, dtype=int)
        return replace(
            self,
            recordings=tuple(self.recordings[i] for i in keep),
            points=self.points[chosen],
            values=self.values[chosen],
            covariance=self.covariance[chosen],
        )


def as_estimates(
    fits: FitTable | Sequence[FitResult] | Estimates,
    points: Sequence[Sequence[float]] | Sequence[float] | None = None,
    parameters: tuple[str, ...] = KEY_PARAMETERS,
    scheduling: tuple[str, ...] = SCHEDULING,
) -> Estimates:
    """Return the estimates in a table of fits, or of fit results with operating points.

    Parameters
    ----------
    fits : FitTable, sequence of FitResult, or Estimates
        Fits with all parameters.
    points : sequence of points, optional
        Operating point of each fit result or row, in the order of `scheduling`; a table contains those over pressure
        and speed.
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
        return _finite(fits, [""] * len(fits.recordings))
    if isinstance(fits, FitTable):
        if points is not None and scheduling == SCHEDULING:
            raise UsageError("points: a table of fits contains its operating points; leave points out")
        grid = np.stack([fits.pressure_bar, fits.speed_rpm], axis=-1)
        if scheduling != SCHEDULING:
            grid = _grid(points, len(fits.recordings), scheduling)
        kinds = list(dict.fromkeys(fits.fit.tolist()))
        if len(kinds) > 1:
            raise UsageError(f"the table holds the fits {', '.join(kinds)}; choose one: table.select(fit=...)")
        missing = [key for key in KEY_PARAMETERS if key not in fits.parameter_names]
        if missing:
            raise UsageError(f"the table of fits has no {', '.join(missing)}; the surfaces need all key parameters")
        columns = [fits.parameter_names.index(key) for key in KEY_PARAMETERS]
        estimates = Estimates(
            tuple(" + ".join(names) for names in fits.recordings),
            grid,
            fits.values[:, columns],
            fits.covariance_of(KEY_PARAMETERS),
            scheduling=scheduling,
        )
        fitted = fits.structure != ""
        rows = zip(fits.success.tolist(), fitted.tolist(), fits.status.tolist(), strict=True)
        return _finite(
            estimates, [_reason(success, str(status) if not fitted else "") for success, fitted, status in rows]
        )
    grid = _grid(points, len(fits), scheduling)
    names, values, covariances = [], [], []
    for fit in fits:
        name = " + ".join(fit.recordings)
        missing = [key for key in parameters if key not in fit.parameters]
        if missing:
            hint = "; for another machine give structure=..." if parameters == KEY_PARAMETERS else ""
            what = ", ".join(parameters)
            raise UsageError(f"fit of {name!r} has no {', '.join(missing)}; the surfaces need {what}{hint}")
        names.append(name)
        values.append([fit.parameters[key] for key in parameters])
        covariances.append(covariance_of(fit, parameters))
    k = len(parameters)
    estimates = Estimates(
        tuple(names),
        grid,
        np.reshape(values, (-1, k)),
        np.reshape(np.array(covariances), (len(names), k, k)),
        parameters=parameters,
        scheduling=scheduling,
    )
    return _finite(estimates, [_reason(fit.success) for fit in fits])


def _grid(
    points: Sequence[Sequence[float]] | Sequence[float] | None, n: int, scheduling: tuple[str, ...]
) -> FloatArray:
    """Return operating points of n fits as an array (n, n_variables)."""
    what = f"({', '.join(scheduling)})"
    if points is None or len(points) != n:
        given = "none" if points is None else str(len(points))
        raise UsageError(f"points: give the {what} of each of the {n} fits; there are {given}")
    try:
        rows = [np.asarray(point, float).reshape(len(scheduling)) for point in points]
    except (TypeError, ValueError):
        raise UsageError(f"points: give {what} as numbers for each fit") from None
    return np.array(rows).reshape(-1, len(scheduling))


def covariance_of(fit: FitResult, parameters: Sequence[str]) -> FloatArray:
    """Return the covariance of selected parameters of a fit; fixed parameters have zero rows and columns."""
    covariance = np.zeros((len(parameters), len(parameters)))
    free = [i for i, key in enumerate(parameters) if key in fit.free]
    places = [fit.free.index(parameters[i]) for i in free]
    covariance[np.ix_(free, free)] = fit.covariance[np.ix_(places, places)]
    return covariance


def _reason(success: bool, failure: str = "") -> str:
    """Return why a recording has no estimates: the failure, or no convergence; an empty text for a converged fit."""
    return "" if success else f"has no fit: {failure}" if failure else "its fit did not converge"


def _finite(estimates: Estimates, reasons: Sequence[str]) -> Estimates:
    """Return the finite estimates of fits that did not fail; other recordings are listed by name."""
    keep, left_out = [], list(estimates.left_out)
    for i, name in enumerate(estimates.recordings):
        bad = [key for key, v in zip(estimates.parameters, estimates.values[i], strict=True) if not np.isfinite(v)]
        if not np.isfinite(estimates.points[i]).all():
            left_out.append(f"{name}: no operating point ({' and '.join(estimates.scheduling)})")
        elif reasons[i]:
            left_out.append(f"{name}: {reasons[i]}")
        elif bad:
            left_out.append(f"{name}: {', '.join(bad)} not finite")
        else:
            keep.append(i)
    if not keep:
        some = "; ".join(left_out[:3]) or "there are none"
        raise DataError(f"no fit can be used for the surfaces: {some}; correct or repeat the fits")
    return replace(estimates.rows(keep), left_out=tuple(left_out))
