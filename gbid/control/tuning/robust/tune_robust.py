"""Robust design: the damping that holds with a stated probability, verified on fresh draws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gbid.arrays import FloatArray, is_finite, is_whole
from gbid.brief import Brief, Description, brief
from gbid.control.controllers.scheduled import Scheduled, with_schedule
from gbid.control.controllers.structures import controller_structure
from gbid.control.tuning.gain_result import GainResult
from gbid.control.tuning.goals.goal import DesignContext, Goal, limits_of
from gbid.control.tuning.plants.plants_of import plants_of
from gbid.control.tuning.plants.sampled_loops import Sampling
from gbid.control.tuning.plants.uncertainty import Uncertainty
from gbid.control.tuning.robust.plant_draws import HOLDS, PlantDraws, lower_bound, on_draws
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.starts.neutral import typical_rate
from gbid.control.tuning.tune import tune
from gbid.errors import UsageError
from gbid.lpv import LPVFit, LPVModel
from gbid.structure.linear import Structure

_FRESH_SEED = 7919


@dataclass(frozen=True, eq=False)
class RobustDesign(Brief):
    """Design for plants drawn from an uncertainty.

    Attributes
    ----------
    result : GainResult
        The design, optimal for the nominal plant and the drawn plants in `plants`.
    probability, confidence : float
        Probability of the promise, and its confidence.
    promised : float
        Objective that a plant reaches with this probability, at this confidence, from the fresh draws and whatever
        their distribution is; minus infinity when there are too few of them.
    keeps_limits : float
        Lower confidence bound of the probability that a plant keeps all limits.
    fresh : PlantDraws
        Performance on fresh draws, which the design has not seen.
    trained : PlantDraws
        Performance on the draws from which the plants were chosen.
    plants : tuple of int
        Draws for which the design was optimised, besides the nominal plant.
    """

    result: GainResult
    probability: float
    confidence: float
    promised: float
    keeps_limits: float
    fresh: PlantDraws
    trained: PlantDraws
    plants: tuple[int, ...]

    @property
    def holds(self) -> bool:
        """Whether the promise is finite and the limits hold with the stated probability at this confidence."""
        return bool(np.isfinite(self.promised) and self.keeps_limits >= self.probability)

    def _brief(self) -> Description:
        return brief(
            self,
            f"{self.result.objective} {self.promised:.4g} with probability {self.probability:g}",
            limits=f"kept with probability {self.keeps_limits:.4g} or more",
            confidence=f"{self.confidence:g}, from {len(self.fresh.value)} fresh draws",
            nominal=f"{self.result.value:.4g} is reached by the plants of the design",
            gains=self.result.gains,
        )


def tune_robust(
    model: LPVFit | LPVModel,
    controller: str | Structure | Scheduled = "P",
    *,
    goals: Sequence[Goal],
    probability: float = 0.95,
    confidence: float = 0.95,
    uncertainty: Uncertainty | None = None,
    draws: int = 200,
    fresh: int = 500,
    seed: int = 0,
    rounds: int = 12,
    start: Mapping[str, float] | None = None,
    **options: Any,
) -> RobustDesign:
    """Return a design whose objective and limits hold with a stated probability over the uncertainty of the plant.

    Parameters
    ----------
    model : LPVFit or LPVModel
        The plant. A fit brings its uncertainty: the covariance of its coefficients and the scatter between recordings.
    controller : str, Structure or Scheduled
        As for `gbid.tune`.
    goals : sequence of Goal
        Objectives and limits, as for `gbid.tune`.
    probability : float
        Share of all plants that must reach the objective and keep the limits, between 0.5 and 1.
    confidence : float
        Confidence of the promise.
    uncertainty : Uncertainty, optional
        In place of that of the fit; its covariance and scatter are used.
    draws, fresh : int
        Number of draws for the design, and of others for its verification.
    seed : int
        Seed of the draws; the fresh ones have another one.
    rounds : int
        Largest number of plants that are added to the nominal one; 0 tries the nominal design.
    start : dict of str to float, optional
        Gains as an additional start value.
    **options
        Further options of `gbid.tune`, such as `operating_points` and `sample_time`.

    Returns
    -------
    RobustDesign

    Raises
    ------
    UsageError
        When there is no uncertainty, when the probability is not allowed, and as for `gbid.tune`.

    Notes
    -----
    The design starts with the nominal plant. In each round it is tried on all draws. While more than the allowed share
    of them fails, the plant at the edge of that share is added and the design optimised again. So it does not serve the
    few worst plants that the probability leaves out. The promise comes from the fresh draws, by an order statistic.
    """
    for name, value, least in (("draws", draws, 10), ("fresh", fresh, 1), ("seed", seed, 0), ("rounds", rounds, 0)):
        if not is_whole(value, least):
            raise UsageError(f"tune_robust: {name} = {value!r}; give an integer of at least {least}")
    if not (is_finite(probability) and 0.5 <= probability < 1 and is_finite(confidence) and 0 < confidence < 1):
        raise UsageError(
            f"tune_robust: probability = {probability!r}, confidence = {confidence!r}; give 0.5 to 1, and 0 to 1"
        )
    machine, known = _plant_and_uncertainty(model, uncertainty, draws, seed)
    structure = controller if isinstance(controller, Scheduled) else controller_structure(controller)
    structure = with_schedule(structure, machine.domain)
    trial = _Trial(machine, structure, tuple(goals or ()), options)
    chosen: tuple[int, ...] = ()
    # the share of failures that is allowed in the draws leaves room for the confidence on the fresh ones
    target = min(probability + (1 - probability) * 0.4, 1 - 0.5 / draws)
    result, gains = trial.design((), known, start), start
    for _ in range(rounds):
        gains = dict(result.gains)
        seen = trial.on(known, gains)
        failing = _shortfall(seen, result.value)
        if float((failing > 0).mean()) <= 1 - target or not result.success:
            break
        edge = np.argsort(-failing)[int(np.floor((1 - target) * draws))]
        if int(edge) in chosen:
            break
        chosen = (*chosen, int(edge))
        result = trial.design(chosen, known, gains)
    seen = trial.on(known, dict(result.gains))
    others = trial.on(replace(known, draws=fresh, seed=seed + _FRESH_SEED), dict(result.gains))
    return RobustDesign(
        result,
        probability,
        confidence,
        others.promised(probability, confidence),
        lower_bound(float(others.keeps_limits.mean()), fresh, confidence),
        others,
        seen,
        chosen,
    )


@dataclass(frozen=True, eq=False)
class _Trial:
    """Designs and trials of one plant, structure and list of goals."""

    lpv: LPVModel
    structure: Structure | Scheduled
    goals: tuple[Goal, ...]
    options: Mapping[str, Any]

    def design(self, chosen: tuple[int, ...], known: Uncertainty, start: Mapping[str, float] | None) -> GainResult:
        """Return the design for the nominal plant and chosen draws."""
        plants = replace(known, chosen=chosen) if chosen else None
        options = {**self.options, **({"starts": 1} if chosen and "starts" not in self.options else {})}
        return tune(self.lpv, self.structure, goals=self.goals, uncertainty=plants, start=start, **options)

    def on(self, drawn: Uncertainty, gains: Mapping[str, float]) -> PlantDraws:
        """Return the performance of gains on all draws."""
        take = {key: self.options.get(key) for key in ("operating_points", "actuator")}
        sampling, T = None, self.options.get("sample_time")
        if T is not None:
            late = self.options.get("computation_s")
            sampling = Sampling(T, T if late is None else late, self.options.get("method", "tustin"))
        args = self.lpv, self.structure, take["operating_points"], take["actuator"], drawn, sampling, (None, None)
        design = plants_of(*args)
        plants = design.sampled or design.continuous
        x = np.array([gains[p.name] for p in self.structure.parameters])
        nominal = plants.family(design.points, range(len(design.points)))
        limits = limits_of(self.goals, DesignContext(design.plant))
        low, high = (np.array([getattr(p, side) for p in self.structure.parameters]) for side in ("lower", "upper"))
        problem = GainProblem((nominal,), limits, low, high, typical_rate((nominal,), x))
        return on_draws(problem, plants, design.points, x, drawn.draws)


def _shortfall(seen: PlantDraws, value: float) -> FloatArray:
    """Return by how much each plant misses the objective of the design or a limit, in relative units."""
    return np.asarray(np.maximum((value - seen.value) / max(abs(value), 1e-6) - 1e-3, seen.violation - HOLDS))


def _plant_and_uncertainty(
    model: LPVFit | LPVModel, uncertainty: Uncertainty | None, draws: int, seed: int
) -> tuple[LPVModel, Uncertainty]:
    if uncertainty is not None and not isinstance(uncertainty, Uncertainty):
        raise UsageError(f"uncertainty is a {type(uncertainty).__name__}; give gbid.Uncertainty(covariance)")
    if uncertainty is not None and uncertainty.covariance is None:
        raise UsageError("tune_robust: give the covariance of the coefficients; samples cannot be drawn anew")
    if isinstance(model, LPVFit):
        known = uncertainty or Uncertainty(model.covariance, scatter=model.scatter)
        return model.model, replace(known, draws=draws, seed=seed)
    if uncertainty is None:
        raise UsageError(f"tune_robust: model {model.name!r} has no uncertainty; give an LPV fit, or uncertainty=")
    return model, replace(uncertainty, draws=draws, seed=seed)
