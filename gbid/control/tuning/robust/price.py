"""Price of robustness: the damping that holds with a probability, over that probability."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from gbid.brief import Brief, Description, brief
from gbid.control.controllers.scheduled import Scheduled
from gbid.control.tuning.goals.goal import Goal
from gbid.control.tuning.robust.tune_robust import RobustDesign, tune_robust
from gbid.errors import UsageError
from gbid.lpv import LPVFit, LPVModel
from gbid.structure.linear import Structure


@dataclass(frozen=True, eq=False)
class PriceOfRobustness(Brief):
    """Robust designs for rising probabilities, beside what the nominal design promises.

    Attributes
    ----------
    probabilities : tuple of float
        Probabilities, rising.
    designs : tuple of RobustDesign
        One for each probability.
    nominal : float
        Objective of the nominal design on the nominal plant.
    of_nominal : tuple of float
        Objective that the nominal design reaches with each probability.
    limits_of_nominal : float
        Share of the fresh plants in which the nominal design keeps the limits.
    """

    probabilities: tuple[float, ...]
    designs: tuple[RobustDesign, ...]
    nominal: float
    of_nominal: tuple[float, ...]
    limits_of_nominal: float

    @property
    def promised(self) -> tuple[float, ...]:
        """Objective that each design promises with its probability."""
        return tuple(design.promised for design in self.designs)

    def _brief(self) -> Description:
        lines = {
            f"probability {p:g}": f"{d.promised:.4g}, limits {d.keeps_limits:.3g}"
            for p, d in zip(self.probabilities, self.designs, strict=True)
        }
        return brief(self, f"nominal {self.nominal:.4g}, limits kept by {self.limits_of_nominal:.3g}", **lines)


def price_of_robustness(
    model: LPVFit | LPVModel,
    controller: str | Structure | Scheduled = "P",
    *,
    goals: Sequence[Goal],
    probabilities: Sequence[float] = (0.5, 0.8, 0.9, 0.95, 0.98),
    **options: Any,
) -> PriceOfRobustness:
    """Return robust designs for several probabilities: what robustness costs in damping.

    Parameters
    ----------
    model, controller, goals
        As for `tune_robust`.
    probabilities : sequence of float
        Probabilities, in any order.
    **options
        Further options of `tune_robust`.

    Returns
    -------
    PriceOfRobustness

    Raises
    ------
    UsageError
        When there are no probabilities, and as for `tune_robust`.
    """
    try:
        rising = tuple(sorted({float(p) for p in probabilities}))
    except (TypeError, ValueError):
        rising = ()
    if not rising:
        raise UsageError(f"price_of_robustness: probabilities = {probabilities!r}; give a list such as [0.5, 0.9]")
    designs: list[RobustDesign] = []
    start = options.pop("start", None)
    for probability in rising:
        designs.append(tune_robust(model, controller, goals=goals, probability=probability, start=start, **options))
        start = dict(designs[-1].result.gains)
    plain = tune_robust(model, controller, goals=goals, probability=0.5, rounds=0, **options)
    confidence = plain.confidence
    return PriceOfRobustness(
        rising,
        tuple(designs),
        plain.result.value,
        tuple(plain.fresh.promised(p, confidence) for p in rising),
        float(plain.fresh.keeps_limits.mean()),
    )
