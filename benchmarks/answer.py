"""What one timed method gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Answer:
    """One method on one recording.

    Attributes
    ----------
    time_s : float
        Wall time [s]; what is built or compiled beforehand is not in it.
    cpu_s : float
        Processor time of the same stretch [s]: much less than the wall time tells that the core was shared.
    build_s : float
        Building the symbolic problem [s]; 0 where there is none.
    build_cpu_s : float
        Its processor time [s].
    iterations : int
    loss : float
        Mean squared error summed over outputs [m^2].
    success : bool
    start : dict of str to float
        Start values that were found from the data; empty for a method that was given them.
    """

    time_s: float
    cpu_s: float
    build_s: float
    build_cpu_s: float
    iterations: int
    loss: float
    success: bool
    start: Mapping[str, float] = field(default_factory=dict)
