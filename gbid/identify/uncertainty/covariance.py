"""Covariance of the estimates: for white residuals, and a robust one for coloured residuals."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import null_space

from gbid.arrays import BoolArray, FloatArray, IntArray
from gbid.identify.nlp.shooting import Shooting
from gbid.identify.uncertainty.bootstrap import Bootstrap, Estimator, bootstrap_factors
from gbid.identify.uncertainty.by_windows import grows, information_by_windows
from gbid.identify.uncertainty.error_model import ErrorModel
from gbid.identify.uncertainty.information import information_over_records
from gbid.identify.uncertainty.score_covariance import Transform, covariance_of, transformed

_UNDETERMINED = 1e-13  # largest eigenvalue of the scaled information for which a direction is not determined
# Smallest such eigenvalue for which exact Hessian and coloured scores are more than rounding. Below it the curvature is
# that of Gauss-Newton, and the scores are those of white errors.
_RESOLVED = 1e-8
FLATTEST = 1e-4
"""Smallest curvature of a minimum, as a part of the Gauss-Newton curvature."""
_ACTIVE = 1e-4  # of the size of a constraint that lies on its bound
_BLOCK = 64  # samples of a block of the pass


class Covariance(NamedTuple):
    """Uncertainty of the free parameters, when initial states are estimated, too.

    Attributes
    ----------
    white : (n_p, n_p) array
        Covariance for white residuals.
    robust : (n_p, n_p) array
        Covariance for coloured residuals.
    flatness : float
        Smallest ratio of the curvature of the cost to the Gauss-Newton curvature, over all directions. It is about one
        for white residuals, and NaN when it was not computed. Below `FLATTEST` the point is not a minimum, and the
        robust covariance uses the Gauss-Newton curvature.
    undetermined : (n_directions, n_p) array
        Unit directions, in parameters scaled by their curvature, that the data do not determine; usually empty.
    condition : float
        Condition number of the scaled information matrix.
    bootstrap : (n_p, n_p) array or None
        Robust covariance with the standard deviations that a bootstrap gives.
    models : tuple of ErrorModel
        Model of the errors of each record; empty where the robust covariance is the white one.
    """

    white: FloatArray
    robust: FloatArray
    flatness: float
    undetermined: FloatArray
    condition: float
    bootstrap: FloatArray | None = None
    models: tuple[ErrorModel, ...] = ()

    def scaled(self, white: float, robust: float) -> Covariance:
        """Return the covariances times these factors."""
        bootstrap = None if self.bootstrap is None else self.bootstrap * robust
        return self._replace(white=self.white * white, robust=self.robust * robust, bootstrap=bootstrap)


def covariance(
    problem: Shooting,
    theta: FloatArray,
    starts: FloatArray,
    record_window: IntArray,
    error_products: FloatArray,
    held: BoolArray,
    *,
    known_starts: BoolArray | None = None,
    coloured: bool = False,
    bootstrap: Bootstrap | None = None,
) -> Covariance:
    """Return the covariance of the parameters at an estimate.

    Parameters
    ----------
    problem : Shooting
        Shooting problem of the fit.
    theta : (n_p,) array
        Free parameters.
    starts : (n_windows, n) array
        Initial states of the windows.
    record_window : (n_records,) integer array
        First window of each record.
    error_products : (n_y, n_y) array
        Sum of the products of errors, ``sum e e'``.
    held : (n_p,) boolean array
        Parameters on a bound; they count as known, and their rows are zero.
    known_starts : (n_records, n) boolean array, optional
        Initial states that were given instead of estimated; by default none.
    coloured : bool
        Whether residuals are coloured. If not, the robust covariance is the white one. If so, it uses a model of the
        residuals and the exact Hessian of the cost, which needs further passes.
    bootstrap : Bootstrap, optional
        Number of draws and seed of a bootstrap of the robust covariance, which counts residuals as coloured.

    Returns
    -------
    Covariance
        The covariances.

    Notes
    -----
    With the Hessian H of ``sum e' W e / 2`` by parameters and initial states, and the covariance J of its gradient
    ``sum psi' W e``, the estimates have the covariance ``H^-1 J H^-1`` (Ljung, System Identification,
    Secs. 9.2 to 9.4). White residuals do not depend on the past. Then the Gauss-Newton approximation
    ``H = sum psi' W psi`` is sufficient, and with the covariance Lambda of the residuals
    ``J = sum psi' W Lambda W psi``. For coloured residuals H also contains ``-sum psi_i' W d psi_j``, which is its
    largest part along the disturbance gain. Their J is that of `gbid.identify.uncertainty.score_covariance`. A prior
    adds its information to H, and to J as a measurement with its variance does.
    """
    n_p, modelled = problem.n_theta, coloured or bootstrap is not None
    n_all = n_p + len(record_window) * problem.n_states
    weight = problem.weight(error_products)
    settled = np.zeros((len(record_window), problem.n_states), bool) if known_starts is None else known_starts
    freedom = max(1.0, problem.n_samples - (n_all - int(settled.sum())) / len(weight))
    shaped = weight @ (error_products / freedom) @ weight
    share = float(np.trace(shaped)) / float(np.trace(weight))
    # Weighted by the inverse of the covariance of the errors, one pass gives both.
    alike = np.allclose(shaped, share * weight, rtol=1e-9, atol=1e-9 * share * float(np.abs(weight).max()))
    if grows(problem, theta, starts):
        found = information_by_windows(problem, theta, starts, record_window, weight, shaped, known_starts=settled)
    else:
        found = information_over_records(
            problem, _BLOCK, theta, starts, record_window, weight, shaped=None if alike else shaped, observed=modelled
        )

    # The weight is one over the total error, that of the likelihood one over its variance: they differ by this.
    unit = float(np.trace(weight @ error_products)) / (problem.n_samples * len(weight))
    known = unit * _known(problem, theta, starts, n_all)
    keep = np.concatenate([~held, ~settled.ravel()])
    kept = np.ix_(keep, keep)
    H = (found.hessian + known)[kept]
    J_white = ((share * found.hessian if alike else found.shaped) + known * unit)[kept]

    scale = np.sqrt(np.maximum(np.diag(H), np.finfo(float).tiny))
    free = _along_constraints(problem, theta, starts, n_all)[:, keep] / scale
    along = null_space(free) if len(free) else np.eye(len(scale))
    eigenvalues, vectors = np.linalg.eigh(along.T @ (H / np.outer(scale, scale)) @ along)
    vectors = along @ vectors
    dark = eigenvalues < _UNDETERMINED * eigenvalues[-1]
    root = vectors[:, ~dark] / np.sqrt(eigenvalues[~dark]) / scale[:, None]  # root root' is the inverse
    flatness, n_kept = np.nan, int((~held).sum())

    def over_parameters(J: FloatArray, onto: FloatArray) -> FloatArray:
        result = np.zeros((n_p, n_p))
        result[np.ix_(~held, ~held)] = (onto @ J @ onto.T)[:n_kept, :n_kept]
        return result

    J_white = root.T @ J_white @ root
    white = robust = over_parameters(J_white, root)
    drawn, models = None, list[ErrorModel]()
    if modelled:
        # Unlike a generator, `map` does not hold the sensitivities while their transform is in use.
        transforms: Iterable[Transform] = map(partial(transformed, kept=np.flatnonzero(keep)), found.sensitivities)
        transforms = transforms if bootstrap is None else list(transforms)  # draws take them again and again
        J, models = covariance_of(transforms, weight, root)
        J_known = root.T @ (known * unit)[kept] @ root
        J += J_known
        blurred = eigenvalues[~dark] < _RESOLVED * eigenvalues[-1]
        onto = root
        if found.observed is not None:
            exact = root.T @ (found.observed + known)[kept] @ root
            own, axes = np.linalg.eigh(_with_rounding(exact, blurred, np.eye(len(blurred))))
            flatness = float(own[0])
            onto = root @ (axes / own) @ axes.T if flatness >= FLATTEST else root
        robust = over_parameters(_with_rounding(J, blurred, J_white), onto)
        if bootstrap is not None:
            estimator = Estimator(weight, root, onto, J_known, blurred)
            factors = np.ones(n_p)
            factors[~held] = bootstrap_factors(list(transforms), models, estimator, bootstrap)[:n_kept]
            drawn = robust * np.outer(factors, factors)

    directions = np.zeros((int(dark.sum()), n_p))
    directions[:, ~held] = vectors[:n_kept, dark].T
    # A direction of initial states alone does not concern the parameters.
    directions = directions[np.linalg.norm(directions, axis=1) > 1e-2]
    condition = float(eigenvalues[-1] / max(eigenvalues[0], np.finfo(float).tiny))
    return Covariance(white, robust, flatness, directions, condition, drawn, tuple(models))


def _known(problem: Shooting, theta: FloatArray, starts: FloatArray, n_all: int) -> FloatArray:
    """Return the information of prior and extra cost on parameters and initial states, (n_all, n_all)."""
    known = np.diag(np.concatenate([problem.prior.information, np.zeros(n_all - problem.n_theta)]))
    if problem.extra is not None:
        known[np.ix_(problem.extra.used, problem.extra.used)] += problem.extra.at(theta, starts).hessian
    return known


def _along_constraints(problem: Shooting, theta: FloatArray, starts: FloatArray, n_all: int) -> FloatArray:
    """Return the slopes of the active constraints of the caller, (n_active, n_all): along them nothing moves."""
    if problem.extra is None:
        return np.zeros((0, n_all))
    values = problem.extra.at(theta, starts)
    active = ~np.isnan(problem.extra.off_bound(values.rows, _ACTIVE))
    slopes = np.zeros((int(active.sum()), n_all))
    slopes[:, problem.extra.used] = values.slopes[active]
    return slopes


def _with_rounding(matrix: FloatArray, blurred: BoolArray, instead: FloatArray) -> FloatArray:
    """Return a matrix with another one in the directions that rounding has blurred."""
    result = matrix.copy()
    result[blurred], result[:, blurred] = instead[blurred], instead[:, blurred]
    return result
