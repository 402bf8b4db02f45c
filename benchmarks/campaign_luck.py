"""Chance in the surfaces of a campaign: how they would be if the machine had scattered otherwise between recordings.

The error of one campaign is a smooth surface. Where it is large by chance, it is so in a whole region. So the share of
points within three standard deviations is one number of a wide distribution. Here it is taken over many campaigns. Each
has new machines, drawn as the rig draws them, and to their parameters the errors are added that the fits of the one
campaign have about their own machines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

import gbid
from gbid.core.arrays import FloatArray
from gbid.lpv import Estimates
from gbid.rig import RotorBearingTruth, Scatter, scattered
from gbid.structure import KEY_PARAMETERS

CAMPAIGNS = 200
ENOUGH = 0.95  # share of the points within three standard deviations


def luck(
    fits: Sequence[gbid.FitResult],
    points: Sequence[tuple[float, float]],
    errors: FloatArray,
    scatter: Scatter,
    grid: tuple[FloatArray, FloatArray],
    seed: int = 0,
) -> dict[str, Any]:
    """Return the mean share of points within three standard deviations, and how many campaigns have enough of them.

    The errors over standard deviations are those at the operating points, rms over the campaigns: the least, the mean
    and the largest of all points and parameters.

    Parameters
    ----------
    fits : sequence of FitResult
        Fits of a campaign, for their covariances.
    points : sequence of (pressure [bar], speed [rpm])
        Their operating points.
    errors : (n_fits, 14) array
        Estimates minus the parameters of the machine of each recording.
    scatter : Scatter
        Scatter between recordings.
    grid : (n,) array, (n,) array
        Points of the domain.
    seed : int
        Seed of the machines.
    """
    truth = gbid.load_model("theisen2016")
    places = np.unique(np.array(points, float), axis=0).T
    true, there, shares, squares = truth.key_parameters(*grid), truth.key_parameters(*places), [], []
    for lpv in _campaigns(fits, points, lambda _: errors, scatter, seed):
        found, std = lpv.model.key_parameters(*grid), np.sqrt(np.einsum("nii->ni", lpv.uncertainty_at(*grid)))
        shares.append([np.mean(np.abs(found[k] - true[k]) < 3 * std[:, i]) for i, k in enumerate(KEY_PARAMETERS)])
        at, own = lpv.model.key_parameters(*places), np.einsum("nii->ni", lpv.uncertainty_at(*places))
        squares.append([(at[k] - there[k]) ** 2 / own[:, i] for i, k in enumerate(KEY_PARAMETERS)])
    every, relative = np.array(shares), np.sqrt(np.mean(squares, axis=0))
    return {
        "campaigns": CAMPAIGNS,
        "mean_within": dict(zip(KEY_PARAMETERS, every.mean(axis=0).tolist(), strict=True)),
        "with_enough": dict(zip(KEY_PARAMETERS, (every >= ENOUGH).mean(axis=0).tolist(), strict=True)),
        "rms_of_error_over_std": {
            "least": float(relative.min()),
            "mean": float(relative.mean()),
            "most": float(relative.max()),
        },
        "with_enough_of_all": float((every >= ENOUGH).all(axis=1).mean()),
    }


def luck_at_best(
    fits: Sequence[gbid.FitResult],
    points: Sequence[tuple[float, float]],
    scatter: Scatter,
    grid: tuple[FloatArray, FloatArray],
    seed: int = 0,
) -> float:
    """Return the share of campaigns in which all fourteen parameters have enough points, if nothing were wrong.

    The fits have the errors that their covariances say, and the standard deviation of each surface at each point is
    known exactly: it is the rms of its error over the campaigns. No method with honest intervals has a larger share.

    Parameters
    ----------
    fits, points, scatter, grid, seed
        As in `luck`.
    """

    def as_they_say(rng: np.random.Generator) -> FloatArray:
        covariances = [_key_covariance(fit) for fit in fits]
        return np.array([rng.multivariate_normal(np.zeros(len(one)), one) for one in covariances])

    true = gbid.load_model("theisen2016").key_parameters(*grid)
    errors = np.array(
        [
            [found[key] - true[key] for key in KEY_PARAMETERS]
            for lpv in _campaigns(fits, points, as_they_say, scatter, seed)
            for found in [lpv.model.key_parameters(*grid)]
        ]
    )
    within = np.abs(errors) < 3 * np.sqrt(np.mean(errors**2, axis=0))
    return float((within.mean(axis=2) >= ENOUGH).all(axis=1).mean())


def _campaigns(
    fits: Sequence[gbid.FitResult],
    points: Sequence[tuple[float, float]],
    errors_of: Callable[[np.random.Generator], FloatArray],
    scatter: Scatter,
    seed: int,
) -> Iterator[gbid.LpvFit]:
    """Return the surfaces of campaigns with new machines, to whose parameters errors of fits are added."""
    truth, rng = gbid.load_model("theisen2016"), np.random.default_rng(seed)
    known = gbid.fit_lpv(fits, points).estimates
    machines = [
        RotorBearingTruth.from_parameters({key: float(v) for key, v in truth.key_parameters(*point).items()})
        for point in points
    ]
    for _ in range(CAMPAIGNS):
        drawn = [scattered(machine, scatter, rng)[0].key_parameters() for machine in machines]
        values = np.array([[own[key] for key in KEY_PARAMETERS] for own in drawn]) + errors_of(rng)
        yield gbid.fit_lpv(Estimates(known.recordings, known.points, values, known.covariance))


def _key_covariance(fit: gbid.FitResult) -> FloatArray:
    own = [fit.free.index(key) for key in KEY_PARAMETERS]
    return np.asarray(fit.covariance[np.ix_(own, own)])
