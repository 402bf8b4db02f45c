"""Bootstrap of the standard deviations: the whole way from errors to intervals, again and again, for drawn errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.fft import irfft, rfft

from gbid.arrays import BoolArray, FloatArray
from gbid.errors import UsageError
from gbid.identify.uncertainty.error_model import ErrorModel
from gbid.identify.uncertainty.score_covariance import Transform, covariance_of

StdName = Literal["auto", "bootstrap"]
DRAWS = 200
"""Number of draws by default."""
_FEWEST = 50  # draws from which a quantile of 95 % can be read
_LEVEL = 0.95  # of the intervals that are to hold
_QUANTILE = 1.959963984540054  # of the normal distribution, for this level


@dataclass(frozen=True)
class Bootstrap:
    """Bootstrap of the standard deviations.

    Attributes
    ----------
    draws : int
        Number of draws.
    seed : int
        Seed of the random numbers.
    """

    draws: int
    seed: int


def asked_bootstrap(std: StdName, draws: int | None, seed: int | None) -> Bootstrap | None:
    """Return the bootstrap that is asked for, None for ``std="auto"``.

    Raises
    ------
    UsageError
        When a word or number is wrong, or is given without the bootstrap.
    """
    if std not in ("auto", "bootstrap"):
        raise UsageError(f"std = {std!r}; choose 'auto' or 'bootstrap'")
    if std == "auto":
        for name, value in (("bootstrap_draws", draws), ("bootstrap_seed", seed)):
            if value is not None:
                raise UsageError(f"{name} is for std = 'bootstrap'; give that, too")
        return None
    draws, seed = DRAWS if draws is None else draws, 0 if seed is None else seed
    if draws < _FEWEST:
        raise UsageError(f"bootstrap_draws = {draws}; a 95 % quantile needs at least {_FEWEST} draws")
    if seed < 0:
        raise UsageError(f"bootstrap_seed = {seed}; it must be 0 or above")
    return Bootstrap(draws, seed)


class Estimator(NamedTuple):
    """Linearised estimator: ``psi' W e`` to changes of the unknowns.

    Attributes
    ----------
    weight : (n_y, n_y) array
        Weight W of the errors.
    root : (n_kept, n) array
        Root R of the inverse of the Gauss-Newton Hessian.
    onto : (n_kept, n) array
        Takes ``R' psi' W e`` to the unknowns.
    known : (n, n) array
        Covariance of what the priors add to ``R' psi' W e``.
    blurred : (n,) boolean array
        Coordinates of the root that rounding has blurred; they are left out.
    """

    weight: FloatArray
    root: FloatArray
    onto: FloatArray
    known: FloatArray
    blurred: BoolArray


def bootstrap_factors(
    transforms: list[Transform], models: list[ErrorModel], estimator: Estimator, bootstrap: Bootstrap
) -> FloatArray:
    """Return the factors by which robust standard deviations are to be multiplied, (n_kept,).

    Parameters
    ----------
    transforms : list of Transform
        Sensitivities of each record.
    models : list of ErrorModel
        Model of the errors of each record.
    estimator : Estimator
        Linearised estimator.
    bootstrap : Bootstrap
        Number of draws and seed.

    Notes
    -----
    Studentised sieve bootstrap (Buehlmann, Sieve bootstrap for time series, Bernoulli 3, 1997; Efron and Tibshirani, An
    Introduction to the Bootstrap, Sec. 12.5). Normal errors are drawn from the autoregression of each record. One
    Gauss-Newton step fits them. From its residuals comes a new autoregression, and from that a robust standard
    deviation, as for the data. The factor is the 95 % quantile of the ratio of step to standard deviation, over that of
    the normal distribution. So it contains that the standard deviation itself is estimated, and how far it is off.
    Feedback of errors into sensitivities is not drawn.
    """
    random = np.random.default_rng(bootstrap.seed)
    plain = [t._replace(feedback=None) for t in transforms]
    slopes = [irfft(t.psi, t.size)[..., : len(t.errors)] for t in plain]
    roots = [model.root(t.size) for model, t in zip(models, plain, strict=True)]
    prior = np.linalg.cholesky(estimator.known + 1e-30 * np.eye(len(estimator.known)))
    ratios = np.empty((bootstrap.draws, len(estimator.onto)))
    for ratio in ratios:
        drawn = [_drawn(root, t, random) for root, t in zip(roots, plain, strict=True)]
        score = np.zeros(len(estimator.root))
        for e, psi, t in zip(drawn, slopes, plain, strict=True):
            score[t.columns] += np.einsum("amk,ka->m", psi, e @ estimator.weight, optimize=True)
        z = np.where(estimator.blurred, 0.0, estimator.root.T @ score + prior @ random.normal(size=len(prior)))
        step = estimator.onto @ z
        left = [
            t._replace(errors=e - np.einsum("amk,m->ka", psi, step[t.columns], optimize=True))
            for e, psi, t in zip(drawn, slopes, plain, strict=True)
        ]
        J = covariance_of(left, estimator.weight, estimator.root)[0] + estimator.known
        J[estimator.blurred] = J[:, estimator.blurred] = 0.0
        variance = np.einsum("im,mn,in->i", estimator.onto, J, estimator.onto)
        ratio[:] = np.abs(step) / np.sqrt(np.maximum(variance, np.finfo(float).tiny))
    factors = np.quantile(ratios, _LEVEL, axis=0) / _QUANTILE
    return np.where(factors > 0, factors, 1.0)


def _drawn(root: FloatArray, t: Transform, random: np.random.Generator) -> FloatArray:
    """Return errors of a record with a spectrum, (n_samples, n_y); zero for samples that are left out."""
    white = rfft(random.normal(size=(t.size, root.shape[-1])), axis=0)
    e = irfft(np.einsum("fab,fb->fa", root, white), t.size, axis=0)[: len(t.errors)]
    return np.asarray(e * t.counted[:, None])
