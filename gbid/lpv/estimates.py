"""Estimates to which surfaces are fitted: one row for each recording, without failed fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal, NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from gbid.core.arrays import BoolArray, FloatArray
from gbid.core.brief import Brief
from gbid.core.errors import DataError, UsageError
from gbid.core.hdf5 import NOT_STORED, Stored
from gbid.identify.result import FitResult
from gbid.identify.table import FitTable
from gbid.lpv.model import Domain
from gbid.structure import KEY_PARAMETERS
from gbid.structure.scheduled import SCHEDULING, Exponents, exponents_of, monomials, term_name

# ---- Terms over the scheduling variables as well-conditioned regressors, and whether operating points determine them.

Order = int | Literal["auto"] | Sequence[str]
HIGHEST_ORDER = 3  # highest order that is compared; the model of a gas bearing has the six terms of Eq. 16 only
_PLURAL = dict(zip(SCHEDULING, ("pressures", "speeds"), strict=True))
_UNDETERMINED = 1e-9  # terms are not determined when a singular value is below this share of the largest


class Orthonormal(NamedTuple):
    """Regressors made orthogonal over the operating points.

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
    """Return the powers up to an order, without those of a variable that is the same at all points (n, n_variables)."""
    fixed = np.ptp(points, axis=0) == 0
    powers = exponents_of(order, points.shape[1])
    return tuple(e for e in powers if not any(power and fixed[i] for i, power in enumerate(e)))


def possible_order(points: FloatArray, scheduling: Sequence[str] = SCHEDULING) -> int | tuple[str, ...]:
    """Return the highest order up to 2 that operating points determine, as the argument ``order`` takes it.

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
    """Return an order as it is written in YAML: ``2``, or ``["1", "P", "P^2"]``."""
    return str(order) if isinstance(order, int) else "[" + ", ".join(f'"{term}"' for term in order) + "]"


def chosen_exponents(order: int | Sequence[str], scheduling: Sequence[str] = SCHEDULING) -> Exponents:
    """Return the powers of the scheduling variables of an order, or of terms by name.

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
        raise UsageError(f"order = {order!r}: {problem}; there are {', '.join(names)}, or {orders}, 'auto'")
    return tuple(possible[names.index(name)] for name in sorted(chosen, key=names.index))


def orthonormal(points: FloatArray, exponents: Exponents, scheduling: Sequence[str] = SCHEDULING) -> Orthonormal:
    """Return terms that are orthogonal over the points, because the numbers in bar and rpm differ by large factors.

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
    """Refuse operating points that do not determine the terms; see `orthonormal`."""
    why_not = _undetermined(points, exponents, scheduling)
    if why_not:
        order = order_words(possible_order(points, scheduling))
        raise DataError(f"{why_not}; add operating points, or choose a lower order, such as order: {order}")


def _undetermined(points: FloatArray, exponents: Exponents, scheduling: Sequence[str]) -> str:
    """Return why operating points do not determine the terms; an empty text when they do."""
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
        """Return the estimates of some recordings, by their positions."""
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
    estimates = Estimates(
        tuple(" + ".join(names) for names in fits.recordings),
        np.stack([fits.pressure_bar, fits.speed_rpm], axis=-1),
        fits.values[:, columns],
        fits.covariance_of(KEY_PARAMETERS),
    )
    return _finite(estimates, fits.success)


def _of_results(
    fits: Sequence[FitResult],
    points: Sequence[Sequence[float]] | Sequence[float] | None,
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
    estimates = Estimates(
        tuple(names),
        grid.reshape(-1, len(scheduling)),
        np.reshape(values, (-1, k)),
        np.reshape(np.array(covariances), (len(names), k, k)),
        parameters=parameters,
        scheduling=scheduling,
    )
    return _finite(estimates, np.array([fit.success for fit in fits], dtype=bool))


def _covariance_of(fit: FitResult, parameters: tuple[str, ...]) -> FloatArray:
    """Return the covariance of some parameters, with zero rows for fixed ones."""
    position: Mapping[str, int] = {name: i for i, name in enumerate(fit.free)}
    covariance = np.zeros((len(parameters), len(parameters)))
    free = [i for i, key in enumerate(parameters) if key in position]
    in_fit = [position[parameters[i]] for i in free]
    covariance[np.ix_(free, free)] = fit.covariance[np.ix_(in_fit, in_fit)]
    return covariance


def _finite(estimates: Estimates, success: BoolArray) -> Estimates:
    """Return the estimates without failed fits and values that are not finite; list these by name."""
    keep, left_out = [], list(estimates.left_out)
    for i, name in enumerate(estimates.recordings):
        bad = [key for key, v in zip(estimates.parameters, estimates.values[i], strict=True) if not np.isfinite(v)]
        if not np.isfinite(estimates.points[i]).all():
            left_out.append(f"{name}: no operating point ({' and '.join(estimates.scheduling)})")
        elif not success[i]:
            left_out.append(f"{name}: its fit did not converge")
        elif bad:
            left_out.append(f"{name}: {', '.join(bad)} not finite")
        else:
            keep.append(i)
    if not keep:
        reasons = "; ".join(left_out[:3]) or "there are none"
        raise DataError(f"there is no fit to which surfaces can be fitted ({reasons})")
    return replace(estimates.rows(keep), left_out=tuple(left_out))


# ---- Linear regression of vectors with known covariances and an unknown scatter between them (mixed-effects model).
#
# .. math:: y_i = X_i c + b_i + e_i, \quad b_i \sim (0, S), \quad e_i \sim (0, C_i)
#
# The parameters of the machine differ from one recording to the next, by far more than the covariance C_i of each
# estimate. S is the covariance of this scatter. It is estimated by restricted maximum likelihood (Patterson and
# Thompson, 1971). For known C_i the EM algorithm maximises the likelihood and keeps S positive semidefinite (Laird and
# Ware, 1982).

_TOLERANCE = 1e-4  # change of S in one step, relative to the variance of the residuals
_LEAST = 1e-3  # smallest eigenvalue of the start value of S, in the same units
_MOST = 500  # largest number of steps
_ALONE = 0.99  # leverage from which a row is fitted by its own: less than a tenth of its error is in its residual


class MixedFit(NamedTuple):
    """Coefficients and scatter of a mixed-effects model.

    Attributes
    ----------
    coefficients : (m,) array
        Coefficients c.
    covariance : (m, m) array
        Covariance of the coefficients, ``(sum X_i' V_i^-1 X_i)^-1`` with ``V_i = C_i + S``.
    scatter : (k, k) array
        S.
    steps : int
        Number of EM steps.
    settled : bool
        Whether S has converged.
    """

    coefficients: FloatArray
    covariance: FloatArray
    scatter: FloatArray
    steps: int
    settled: bool


class Weighted(NamedTuple):
    """Generalised least-squares solution for given V: coefficients (m,), covariance (m, m), residuals (n, k)."""

    coefficients: FloatArray
    covariance: FloatArray
    residuals: FloatArray


def generalised(y: FloatArray, X: FloatArray, V: FloatArray) -> Weighted:
    """Return the generalised least-squares solution.

    Parameters
    ----------
    y : (n, k) array
        Observations.
    X : (n, k, m) array
        Regressors of each row.
    V : (n, k, k) array
        Covariance of each row of y; rows are independent.
    """
    weighted = np.linalg.solve(V, X)  # V^-1 X
    information = np.einsum("ikm,ikl->ml", X, weighted, optimize=True)
    covariance = _inverse(information)
    coefficients = covariance @ np.einsum("ikm,ik->m", weighted, y, optimize=True)
    return Weighted(coefficients, covariance, y - X @ coefficients)


def with_scatter(y: FloatArray, X: FloatArray, C: FloatArray, start: FloatArray | None = None) -> MixedFit:
    """Return the coefficients and the scatter by restricted maximum likelihood.

    Parameters
    ----------
    y : (n, k) array
        Observations, scaled to the order of one.
    X : (n, k, m) array
        Regressors of each row.
    C : (n, k, k) array
        Covariance of the error of each row.
    start : (k, k) array, optional
        Start value of the scatter; by default from moments.

    Returns
    -------
    MixedFit
    """
    n, k = y.shape
    residuals = generalised(y, X, np.broadcast_to(np.eye(k), C.shape)).residuals
    freedom = max(1.0, n - X.shape[2] / k)
    size = np.sqrt(np.mean(residuals**2, axis=0) * n / freedom)
    size = np.where(size > 0, size, 1.0)  # EM works on scaled data with residuals of size one
    outer = np.outer(size, size)
    y, X, C = y / size, X / size[:, None], C / outer
    spread = residuals.T @ residuals / freedom / outer
    S = _positive(spread - C.mean(axis=0)) if start is None else start / outer
    # Recordings of one operating point have equal rows of X, so sums over points need fewer operations.
    _, first, group = np.unique(X.reshape(n, -1), axis=0, return_index=True, return_inverse=True)
    alike, distinct = group.ravel()[:, None] == np.arange(len(first)), X[first]
    change, step = np.inf, 0
    while change >= _TOLERANCE and step < _MOST:
        step += 1
        inverse = np.linalg.inv(C + S)
        coefficients, covariance = _by_point(y, distinct, alike, inverse)
        residuals = y - X @ coefficients
        gain = S @ inverse
        b = np.einsum("ikl,il->ik", gain, residuals)
        surface = (distinct @ covariance @ distinct.transpose(0, 2, 1))[group.ravel()]
        rest = S - gain @ S + gain @ surface @ gain.transpose(0, 2, 1)
        following = (b.T @ b + rest.sum(axis=0)) / n
        change = float(np.abs(following - S).max())
        S = 0.5 * (following + following.T)
    coefficients, covariance = _by_point(y, distinct, alike, np.linalg.inv(C + S))
    return MixedFit(coefficients, covariance, S * outer, step, change < _TOLERANCE)


def _by_point(
    y: FloatArray, distinct: FloatArray, alike: BoolArray, inverse: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return coefficients (m,) and their covariance by generalised least squares, with sums over operating points."""
    weights = np.einsum("ip,ikl->pkl", alike, inverse, optimize=True)
    targets = np.einsum("ip,ikl,il->pk", alike, inverse, y, optimize=True)
    transposed = distinct.transpose(0, 2, 1)
    covariance = _inverse((transposed @ (weights @ distinct)).sum(axis=0))
    return covariance @ np.einsum("pmk,pk->m", transposed, targets), covariance


def _positive(matrix: FloatArray) -> FloatArray:
    """Replace eigenvalues that are not positive by small ones, because EM cannot leave a singular start value."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.maximum(values, _LEAST)) @ vectors.T)


def _inverse(information: FloatArray) -> FloatArray:
    """Return the inverse of a positive definite matrix, computed with scaling."""
    scale = 1 / np.sqrt(np.diag(information))
    return np.asarray(np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale))


def sandwich(y: FloatArray, X: FloatArray, V: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Return the covariance of generalised least-squares coefficients without the assumption that V is right, (m, m).

    The residuals replace the errors. They are enlarged for rows with large leverage (HC3: MacKinnon and White, 1985).
    """
    inverse, weighted, pull = _leverage(X, V)
    scores = _scores(y - X @ coefficients, pull, weighted) @ inverse
    return np.asarray(scores.T @ scores)


class LocalCovariance(NamedTuple):
    """Covariance of coefficients (m, m), and rows whose residual says nothing, because they alone are fitted (n,)."""

    covariance: FloatArray
    alone: BoolArray


def tempered_sandwich(
    y: FloatArray, X: FloatArray, V: FloatArray, coefficients: FloatArray, factors: tuple[float, float] = (1.0, 1.0)
) -> LocalCovariance:
    """Return the covariance of generalised least-squares coefficients, where rows may scatter unequally.

    The sandwich of `sandwich` takes the covariance of each row from its own residual. Where few rows determine a value
    of the surface, that is a mean over few squares. So the covariance of row i is a weighted mean of the two,
    ``(e_i e_i' + h_i V_i) / (1 + h_i)``, with the residual e_i of HC3 and the leverage h_i of the row, which is one
    over the number of rows that determine its value. V_i counts as one more row beside these. A row that is fitted
    exactly has no residual; there V_i alone is taken.

    Parameters
    ----------
    y, X, V : arrays
        As in `generalised`.
    coefficients : (m,) array
        Its solution.
    factors : (float, float)
        Factors on the covariance from residuals and on that from V, for data that are clipped.
    """
    inverse, weighted, pull = _leverage(X, V)
    leverage = np.einsum("ikk->i", pull) / y.shape[1]
    alone = np.linalg.eigvals(pull).real.max(axis=1) > _ALONE
    share = np.where(alone, 0.0, 1 / (1 + leverage))
    scores = _scores(y - X @ coefficients, np.where(alone[:, None, None], 0.0, pull), weighted) @ inverse
    from_residuals = (scores * share[:, None]).T @ scores
    from_model = inverse @ np.einsum("i,ikm,ikl->ml", 1 - share, X, weighted, optimize=True) @ inverse
    covariance = factors[0] * from_residuals + factors[1] * from_model
    return LocalCovariance(0.5 * (covariance + covariance.T), alone)


def _leverage(X: FloatArray, V: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the inverse of the information (m, m), V^-1 X (n, k, m), and the leverages (n, k, k)."""
    weighted = np.asarray(np.linalg.solve(V, X), float)
    inverse = _inverse(np.einsum("ikm,ikl->ml", X, weighted, optimize=True))
    return inverse, weighted, X @ inverse @ weighted.transpose(0, 2, 1)


def _scores(residuals: FloatArray, pull: FloatArray, weighted: FloatArray) -> FloatArray:
    """Return the gradient of each row at its residual as if the row had not been fitted, (n, m)."""
    without = np.linalg.solve(np.eye(pull.shape[1]) - pull, residuals[:, :, None])
    return np.asarray((weighted.transpose(0, 2, 1) @ without)[:, :, 0])


# ---- Outliers from the surfaces: a robust rule that finds them, and Huber's estimate that gives them less weight.

_MAD = 1.4826  # standard deviation of a normal variable over its median absolute deviation
_LEAST_OUTLIERS = 3.5  # Iglewicz and Hoaglin, How to Detect and Handle Outliers (1993)
_FALSE_ALARM = 0.05  # probability of at least one outlier when all entries are normal
HUBER = 1.345  # standard deviations; 95 % efficient for normal errors (Huber, Robust Statistics, 1981)
CLIPPING_SLOPE = 1 - 2 * float(ndtr(-HUBER))  # mean slope of the clipping function
_DENSITY = float(
    np.exp(-(HUBER**2) / 2) / np.sqrt(2 * np.pi)
)  # density of a standard normal variable at HUBER; the next line is the variance of a clipped one
_VARIANCE = CLIPPING_SLOPE - 2 * HUBER * _DENSITY + 2 * HUBER**2 * float(ndtr(-HUBER))
_ROUNDS, _SETTLED = 30, 1e-2  # of a standard deviation


@dataclass(frozen=True)
class Outlier:
    """Recording far from the surface of one parameter.

    Attributes
    ----------
    recording, parameter : str
        Names of the recording and of the parameter.
    deviation : float
        Estimate minus surface, SI per kg.
    standardised : float
        Deviation in robust standard deviations.
    """

    recording: str
    parameter: str
    deviation: Annotated[float, Stored("SI per kg", "estimate minus surface")]
    standardised: Annotated[float, Stored("1", "the same in robust standard deviations")]


def standardised(residuals: FloatArray, V: FloatArray) -> FloatArray:
    """Return residuals (n, k) over their standard deviations.

    `V` (n, k, k) gives the ratio of the standard deviations of the rows. The scale of each column comes from the
    median, so that an outlier that has enlarged `V` is still found.
    """
    z = residuals / np.sqrt(np.einsum("ikk->ik", V))
    return np.asarray(z / _scale(z))


def _scale(z: FloatArray) -> FloatArray:
    return np.maximum(_MAD * np.median(np.abs(z), axis=0), 1e-12)


def threshold(count: int) -> float:
    """Return the largest standardised residual that is not an outlier.

    It is 3.5, and larger for many entries, because some normal values then exceed 3.5 by chance.
    """
    return max(_LEAST_OUTLIERS, float(-ndtri(_FALSE_ALARM / (2 * count))))


def outliers(
    recordings: tuple[str, ...], residuals: FloatArray, z: FloatArray, parameters: tuple[str, ...] = KEY_PARAMETERS
) -> tuple[Outlier, ...]:
    """Return the entries of (n, k) arrays beyond the threshold, the largest first."""
    limit = threshold(z.size)
    found = [
        Outlier(recordings[i], parameters[j], float(residuals[i, j]), float(z[i, j]))
        for i, j in zip(*np.nonzero(np.abs(z) > limit), strict=True)
    ]
    return tuple(sorted(found, key=lambda o: -abs(o.standardised)))


class HuberEstimate(NamedTuple):
    """Huber's estimate.

    Attributes
    ----------
    coefficients : (m,) array
        Coefficients.
    scatter : (k, k) array
        Scatter, corrected for the clipping.
    clipped : (n, k) array
        Data with clipped residuals.
    cost : float
        Factor on the covariance of the coefficients that accounts for the clipping.
    """

    coefficients: FloatArray
    scatter: FloatArray
    clipped: FloatArray
    cost: float


def huber_estimate(y: FloatArray, X: FloatArray, C: FloatArray | None) -> HuberEstimate:
    """Return Huber's estimate by modified residuals, which are clipped at 1.345 standard deviations.

    Parameters
    ----------
    y : (n, k) array
        Observations.
    X : (n, k, m) array
        Regressors of each row.
    C : (n, k, k) array or None
        Covariance of the error of each row, to which scatter is added; None for rows of equal weight.
    """
    n, k = y.shape
    S = np.zeros((k, k)) if C is None else with_scatter(y, X, C).scatter
    V = np.broadcast_to(np.eye(k), (n, k, k)) if C is None else C + S
    coefficients, clipped = generalised(y, X, V).coefficients, y
    for _ in range(_ROUNDS):
        surface = X @ coefficients
        sigma = np.sqrt(np.einsum("ikk->ik", V))
        size = HUBER * sigma * _scale((y - surface) / sigma)
        inside = np.clip(y - surface, -size, size)
        clipped = surface + inside
        if C is not None:
            S = with_scatter(surface + inside / np.sqrt(_VARIANCE), X, C, start=S).scatter
            V = C + S
        fit = generalised(clipped, X, V)
        moved = np.abs(fit.coefficients - coefficients) / np.sqrt(np.diag(fit.covariance))
        coefficients = fit.coefficients
        if moved.max() < _SETTLED:
            break
    return HuberEstimate(coefficients, S, clipped, _VARIANCE / CLIPPING_SLOPE**2)
