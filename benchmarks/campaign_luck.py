"""Chance in the surfaces of a campaign: how they would be if the machine had scattered otherwise between recordings.

The error of one campaign is a smooth surface. Where it is large by chance, it is so in a whole region. So the share of
points within three standard deviations is one number of a wide distribution. Here it is taken over many campaigns. Each
has new machines, drawn as the rig draws them, and to their parameters the errors are added that the fits of the one
campaign have about their own machines.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import gbid
from gbid.arrays import FloatArray
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
    truth, rng = gbid.load_model("theisen2016"), np.random.default_rng(seed)
    known = gbid.fit_lpv(fits, points).estimates
    machines = [
        RotorBearingTruth.from_parameters({key: float(v) for key, v in truth.key_parameters(*point).items()})
        for point in points
    ]
    places = np.unique(np.array(points, float), axis=0).T
    true, there, shares, squares = truth.key_parameters(*grid), truth.key_parameters(*places), [], []
    for _ in range(CAMPAIGNS):
        drawn = [scattered(machine, scatter, rng)[0].key_parameters() for machine in machines]
        values = np.array([[own[key] for key in KEY_PARAMETERS] for own in drawn]) + errors
        lpv = gbid.fit_lpv(Estimates(known.recordings, known.points, values, known.covariance))
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
