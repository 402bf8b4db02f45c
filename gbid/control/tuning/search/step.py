"""Progress of a search for gains."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SearchStep:
    """One entry of a search's history.

    Attributes
    ----------
    stage : str
        ``"global"``, ``"local"``, ``"basin hopping"``, ``"cut"`` (a peak that the grid had missed) or
        ``"points"`` (worst points added).
    count : int
        Designs evaluated so far.
    value : float
        Best aim so far, damping factor or decay rate [1/s].
    violation : float
        By how much its worst limit is exceeded, relative; 0 when all are kept.
    """

    stage: str
    count: int
    value: float
    violation: float
