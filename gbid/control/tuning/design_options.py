"""Options of a design that `gbid.tune` and the experiment YAML have in common, and the sampling of the target."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from gbid.control.loop.close import Method
from gbid.core.option_types import Allowed, Count, CountOrZero, Finite, Number, Positive

Objective = Literal["damping", "decay"]


@dataclass(frozen=True)
class Sampling:
    """Sampling of a loop on the target.

    Parameters
    ----------
    sample_time : float
        T_s [s].
    computation_s : float
        Time from the sample of p to the change of r [s].
    method : {"tustin", "zoh"}
        Discretisation of the controller.
    """

    sample_time: float
    computation_s: float
    method: Method = "tustin"


@dataclass(frozen=True, kw_only=True, eq=False)
class DesignOptions:
    """Options of `gbid.tune` that are also keys of a design in the YAML; see `TuneOptions`."""

    peak_sensitivity: Positive | None = 2.6
    bounds: (
        Annotated[Mapping[str, tuple[Number, Number]], Allowed("(lower, upper) by the names of the gains")] | None
    ) = None
    objective: Objective = "damping"
    method: Method = "tustin"
    start: Annotated[Mapping[str, Finite], Allowed("a dict by the names of the gains")] | None = None
    starts: CountOrZero | None = None
    seed: CountOrZero = 0
    seeds: Count = 1
    evaluations: Count | None = None
    seconds: Positive | None = None
