"""Progress of a search for gains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from gbid.hdf5 import Stored


@dataclass(frozen=True)
class SearchStep:
    """Progress of a search after one stage.

    Attributes
    ----------
    stage : str
        ``"global"``, ``"local"``, ``"basin hopping"``, ``"cut"`` (a peak between grid frequencies was added),
        ``"certificate"`` (the design was certified or improved) or ``"points"`` (worst points were added).
    count : int
        Number of designs evaluated so far.
    value : float
        Best objective so far, damping factor or decay rate [1/s].
    violation : float
        Largest relative violation of a limit by this design; 0 when all limits hold.
    """

    stage: str
    count: Annotated[int, Stored("1", "designs evaluated so far")]
    value: Annotated[float, Stored("", "best aim so far, damping factor or decay rate [1/s]")]
    violation: Annotated[float, Stored("1", "by how much its worst limit is exceeded")]
