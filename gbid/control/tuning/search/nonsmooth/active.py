"""Score of a design, and the smooth functions near the worst one at a design."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.search.measure import LoopState


@dataclass(frozen=True)
class Score:
    """Quality of a design: the objective, and the largest relative violation of a limit (0 when all limits hold)."""

    value: float
    violation: float

    @property
    def usable(self) -> bool:
        """Whether the loops have finite matrices and eigenvalues at this design."""
        return bool(np.isfinite(self.value) and np.isfinite(self.violation))


UNUSABLE = Score(-np.inf, np.inf)
"""Score where a matrix or response of a loop is not finite: worse than any other."""


@dataclass(frozen=True)
class ActiveFunction:
    """Smooth function near the worst one: name (kind, family, loop), value, gradient, place in the complex plane.

    For ``"cluster"`` it is the objective of the mean of `size` eigenvalues.
    """

    kind: str
    family: int
    loop: int
    value: float
    slope: FloatArray
    place: complex
    size: int = 1


@dataclass(frozen=True)
class ActiveFunctions:
    """Active functions of the objective (maximised) and of the limits (at most 0) at one design, and its loops."""

    score: Score
    aim: tuple[ActiveFunction, ...]
    limits: tuple[ActiveFunction, ...]
    states: tuple[LoopState, ...] = ()


def merit(score: Score, penalty: float) -> float:
    """Return the merit to be maximised: objective minus a penalty on the largest violation."""
    return score.value - penalty * score.violation if score.usable else -np.inf
