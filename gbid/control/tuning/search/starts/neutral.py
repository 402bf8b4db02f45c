"""Gains from which a search can begin, and the typical rate of the loops there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.search.loop_family import LoopFamily
from gbid.control.tuning.search.spectrum import eigenvalues
from gbid.control.tuning.search.starts.spread import spread_points
from gbid.errors import UsageError

_TRIED = 64


def usable_start(
    families: Sequence[LoopFamily], given: Sequence[FloatArray], lower: FloatArray, upper: FloatArray, seed: int
) -> FloatArray:
    """Return the first of given gains, or else of random ones, for which all loops have finite eigenvalues.

    Raises
    ------
    UsageError
        When there are none.
    """
    random = spread_points(_TRIED, len(lower), seed)
    for x in (*given, *(lower + random * (upper - lower))):
        if all(np.isfinite(eigenvalues(family.states(x))).all() for family in families):
            return np.asarray(x)
    raise UsageError(
        f"the closed-loop matrices are not finite at the start nor at {_TRIED} random gains within the bounds; check "
        "the function and its bounds"
    )


def typical_rate(families: Sequence[LoopFamily], x: FloatArray) -> float:
    """Return the geometric mean of the magnitudes of the eigenvalues, which is the unit of rates.

    Raises
    ------
    UsageError
        When a matrix is not finite.
    """
    every = [np.abs(eigenvalues(family.states(x))) for family in families]
    for family, sizes in zip(families, every, strict=True):
        for label, finite in zip(family.labels, np.isfinite(sizes.max(axis=1)).tolist(), strict=True):
            if not finite:
                raise UsageError(
                    f"{label}: the closed-loop matrix is not finite at the start; check the plant, also those drawn "
                    "from its uncertainty, or the function and its bounds"
                )
    sizes = np.concatenate([sizes.ravel() for sizes in every])
    sizes = sizes[sizes > 1e-9 * sizes.max()] if sizes.any() else np.ones(1)
    return float(np.exp(np.log(sizes).mean()))
