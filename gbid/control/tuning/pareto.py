"""Pareto front of damping and peak sensitivity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gbid.brief import Brief, Description, brief
from gbid.control.tuning.gain_result import GainResult
from gbid.control.tuning.goals.response_goals import PeakSensitivity
from gbid.control.tuning.tune import tune
from gbid.errors import UsageError
from gbid.extras import data_frame
from gbid.lpv import LPVModel


@dataclass(frozen=True)
class ParetoFront(Brief):
    """Best designs under rising limits on the peak of S_o.

    Attributes
    ----------
    caps : tuple of float
        Limits on the peak of S_o, rising.
    designs : tuple of GainResult
        One for each limit.
    """

    caps: tuple[float, ...]
    designs: tuple[GainResult, ...]

    def _brief(self) -> Description:
        designs = {
            f"cap {cap:g}": f"{d.objective} {d.value:.6g}, {d.status}"
            for cap, d in zip(self.caps, self.designs, strict=True)
        }
        return brief(self, f"{len(self.caps)} designs", **designs)

    def to_frame(self) -> Any:
        """Return limit, damping (or decay rate) and gains of each design as a data frame.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        gains = {name: [design.gains[name] for design in self.designs] for name in self.designs[0].gains}
        status = [str(design.status) for design in self.designs]
        return data_frame({"cap": self.caps, "value": self.values, "status": status, **gains})

    @property
    def values(self) -> tuple[float, ...]:
        """Damping factor (or decay rate [1/s]) for each limit; NaN when no design satisfies it."""
        return tuple(design.value if design.success else float("nan") for design in self.designs)


def pareto(lpv: LPVModel, caps: Sequence[float], **options: Any) -> ParetoFront:
    """Return the best designs under several limits on the peak of S_o.

    Parameters
    ----------
    lpv : LPVModel
        Model with actuators.
    caps : sequence of float
        Limits on the peak of S_o, in any order; each above 1.
    **options
        Options of `gbid.tune`, without ``peak_sensitivity``; of ``goals`` those besides it.

    Returns
    -------
    ParetoFront
        The design of the next lower limit is a start value of each search, because it also satisfies the higher
        limit. So a higher limit never gives a worse design.

    Raises
    ------
    UsageError
        When `caps` are not numbers above 1, and as for `gbid.tune`.
    """
    if "peak_sensitivity" in options:
        raise UsageError("pareto: peak_sensitivity is set by caps; leave it out")
    try:
        rising = sorted({float(cap) for cap in caps})
    except (TypeError, ValueError):
        rising = []
    if not rising or not all(np.isfinite(cap) and cap > 1 for cap in rising):
        raise UsageError(f"pareto: caps = {caps!r}; give numbers above 1 (S_o is 1 at high frequencies)")
    designs: list[GainResult] = []
    given, goals = options.pop("start", None), options.pop("goals", None)
    for cap in rising:
        start = designs[-1].gains if designs and designs[-1].success else given
        limit = {"peak_sensitivity": cap} if goals is None else {"goals": [*goals, PeakSensitivity(cap)]}
        designs.append(tune(lpv, start=start, **limit, **options))
    return ParetoFront(tuple(rising), tuple(designs))
