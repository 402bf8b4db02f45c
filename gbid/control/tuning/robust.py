"""Robust design: damping that holds with a stated probability on drawn plants, and the price of robustness."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any

import numpy as np
import scipy
from annotated_types import Ge, Lt

from gbid.control.controllers.structures import Scheduled, controller_structure, with_schedule
from gbid.control.tuning.goals import Goal, limits_of
from gbid.control.tuning.plants import (
    LpvPlants,
    PlantLike,
    PlantsLike,
    TuneOptions,
    Uncertainty,
    plants_of,
    root_of,
)
from gbid.control.tuning.problem import GainProblem, SearchStep
from gbid.control.tuning.result import GainResult
from gbid.control.tuning.search import typical_rate
from gbid.control.tuning.tune import tuned
from gbid.core.arrays import FloatArray
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import UsageError
from gbid.core.option_types import Allowed, Count, CountOrZero, Finite, Positive
from gbid.identify import FitResult
from gbid.lpv import Domain, LPVFit, LPVModel
from gbid.structure import LinearModel
from gbid.structure.linear import Structure

_BLOCK = 300
HOLDS = 1e-3
"""Relative violation up to which a limit counts as kept by a drawn plant, whose peaks are found on a grid."""


@dataclass(frozen=True, eq=False)
class PlantDraws(Brief):
    """Performance of a design on drawn plants: for each plant its worst value over the operating points.

    Attributes
    ----------
    value : (n,) array
        Objective: smallest damping factor, or slowest decay [1/s].
    violation : (n,) array
        Largest relative violation of a limit; at most 0 where all limits hold.
    """

    value: FloatArray
    violation: FloatArray

    @property
    def keeps_limits(self) -> FloatArray:
        """Whether each plant satisfies all limits, as 0 or 1 (n,)."""
        return (self.violation <= HOLDS).astype(float)

    def share(self, value: float) -> float:
        """Return the share of plants that reach a value and satisfy all limits.

        Parameters
        ----------
        value : float
            Damping factor or decay [1/s].
        """
        return float(((self.value >= value - 1e-9) & (self.violation <= HOLDS)).mean())

    def promised(self, probability: float, confidence: float) -> float:
        """Return the value that a plant reaches with a probability, at a confidence level, for any distribution.

        The value is the k-th smallest of the draws. That a share of at least `probability` of all plants reaches it has
        the confidence ``P(Binomial(n, 1 - probability) >= k)``. Minus infinity when there are too few draws.

        Parameters
        ----------
        probability, confidence : float
            Between 0 and 1.
        """
        n = len(self.value)
        k = int(np.sum(scipy.special.bdtrc(np.arange(n), n, 1 - probability) >= confidence))  # it falls with k
        return float(np.sort(self.value)[k - 1]) if k > 0 else -np.inf


def lower_bound(share: float, n: int, confidence: float) -> float:
    """Return the lower confidence bound of a probability from the share of n trials (Clopper and Pearson 1934)."""
    k = round(share * n)
    return float(scipy.special.betaincinv(k, n - k + 1, 1 - confidence)) if k else 0.0


_FRESH_SEED = 7919


@dataclass(frozen=True, eq=False)
class RobustDesign(Brief):
    """Design for random plants, with its performance on fresh draws.

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
        """Whether the predicted objective is finite and the limits hold with the stated probability and confidence."""
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


@dataclass(frozen=True, eq=False, kw_only=True)
class RobustOptions(TuneOptions):
    """Options that `tune_robust` has in addition to the options of `gbid.tune`.

    Attributes
    ----------
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
    progress : callable, optional
        As for `gbid.tune`.
    """

    probability: Annotated[Finite, Ge(0.5), Lt(1), Allowed("0.5 to 1")] = 0.95
    confidence: Annotated[Positive, Lt(1), Allowed("0 to 1")] = 0.95
    draws: Annotated[int, Ge(10)] = 200
    fresh: Count = 500
    rounds: CountOrZero = 12
    progress: Callable[[SearchStep], None] | None = None


def tune_robust(
    model: PlantLike | Sequence[PlantLike], controller: str | Structure | Scheduled = "P", **options: Any
) -> RobustDesign:
    """Return a design whose objective and limits hold with a stated probability over the uncertainty of the plant.

    Parameters
    ----------
    model : LPVFit, LPVModel, FitResult, or sequence of FitResult and LinearModel
        The plant. A fit of surfaces brings its uncertainty: the covariance of its coefficients and the scatter between
        recordings. Single fits bring the covariance of their parameters: each draw is a linear model of every fit of
        the list, drawn independently to first order in the parameters. Linear models of the list are as they are.
    controller : str, Structure or Scheduled
        As for `gbid.tune`.
    **options
        Options of `gbid.tune`, such as `goals` (objectives and limits, needed), `operating_points` and `sample_time`,
        and those of `RobustOptions`: `probability`, `confidence`, `uncertainty`, `draws`, `fresh`, `seed`
        and `rounds`.

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
    given = RobustOptions(**options)
    given = replace(given, goals=tuple(given.goals or ()))
    probability, confidence, draws, fresh = given.probability, given.confidence, given.draws, given.fresh
    structure = controller if isinstance(controller, Scheduled) else controller_structure(controller)
    if isinstance(model, LPVFit | LPVModel):
        machine, known = _plant_and_uncertainty(model, given)
        structure, drawn = with_schedule(structure, machine.domain), partial(_drawn_surfaces, machine, known)
    else:
        fits = tuple(model) if isinstance(model, Sequence) else (model,)
        if all(isinstance(each, LinearModel) for each in fits):
            raise UsageError("tune_robust: linear models alone have no uncertainty; give the fits that they come from")
        drawn = partial(_drawn_fits, fits)

    def design(chosen: tuple[int, ...], start: Mapping[str, float] | None) -> GainResult:
        few = len(structure.parameters) <= 3  # their search begins with a grid over the whole box, in every round
        starts = 1 if chosen and given.starts is None and not few else given.starts
        options = replace(given, start=start, starts=starts, seed=0)
        plants, options = drawn(options, draws, given.seed, chosen)
        return tuned(plants, structure, options, given.progress)

    def tried(n: int, seed: int, result: GainResult) -> PlantDraws:
        plants, options = drawn(given, n, seed, None)
        return on_draws(plants, structure, options, result.gains, n)

    chosen: tuple[int, ...] = ()
    # the share of failures that is allowed in the draws leaves room for the confidence on the fresh ones
    target = min(probability + (1 - probability) * 0.4, 1 - 0.5 / draws)
    result = design((), given.start)
    for _ in range(given.rounds):
        seen = tried(draws, given.seed, result)
        missed = (result.value - seen.value) / max(abs(result.value), 1e-6) - 1e-3
        failing = np.maximum(missed, seen.violation - HOLDS)  # in relative units, of the objective or of a limit
        if float((failing > 0).mean()) <= 1 - target or not result.keeps_limits:
            break
        edge = np.argsort(-failing)[int(np.floor((1 - target) * draws))]
        if int(edge) in chosen:
            break
        chosen = (*chosen, int(edge))
        result = design(chosen, dict(result.gains))
    seen, others = tried(draws, given.seed, result), tried(fresh, given.seed + _FRESH_SEED, result)
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


_Drawn = tuple[PlantsLike, RobustOptions]
"""The nominal plant with drawn ones, and the options that belong to them."""


def _drawn_surfaces(
    lpv: LPVModel, known: Uncertainty, options: RobustOptions, n: int, seed: int, chosen: tuple[int, ...] | None
) -> _Drawn:
    """Return a model with chosen random draws of its surfaces, or with all n draws."""
    drawn = None if chosen == () else replace(known, draws=n, seed=seed, chosen=chosen)
    return lpv, replace(options, uncertainty=drawn)


def _drawn_fits(
    fits: tuple[PlantLike, ...], options: RobustOptions, n: int, seed: int, chosen: tuple[int, ...] | None
) -> _Drawn:
    """Return fits with models of chosen random draws of their parameters, or of all n draws."""
    rng = np.random.default_rng(seed)
    every = [drawn_models(fit, n, rng) for fit in fits]
    taken = range(n) if chosen is None else chosen
    models = [*fits, *(draws[i] for i in taken for draws in every)]
    speeds = options.speeds_rpm
    return models, replace(options, speeds_rpm=None if speeds is None else [*speeds] * (1 + len(taken)))


def on_draws(
    model: PlantsLike,
    structure: Structure | Scheduled,
    options: RobustOptions,
    gains: Mapping[str, float],
    n: int,
) -> PlantDraws:
    """Return the performance of gains on n drawn plants, without the nominal plant.

    Parameters
    ----------
    model : plant with its draws, or list of models
        The m loops of the nominal plant come first, then m of each draw.
    structure : Structure or Scheduled
        The controller.
    options : RobustOptions
        Goals and points.
    gains : dict of str to float
        Gains by name.
    n : int
        Number of draws.
    """
    speeds = options.speeds_rpm
    over = Domain((0.0, 0.0), (min(speeds), max(speeds))) if speeds else None
    plants = plants_of(model, with_schedule(structure, over), options)
    points, parameters = plants.points, plants.structure.parameters
    m = len(plants.scenarios(points)[0]) // (n + 1)
    x = np.array([gains[p.name] for p in parameters])
    machine = plants.lpv.machine if isinstance(plants, LpvPlants) else None
    limits = limits_of(options.goals or (), plants.plant, machine)
    low, high = (np.array([getattr(p, side) for p in parameters]) for side in ("lower", "upper"))
    plants = plants.within(low, high, limits, x)
    nominal = (plants.family(points, range(m)),)
    problem = GainProblem(nominal, limits, low, high, typical_rate(nominal, x))
    each = max(1, _BLOCK // m)
    values, violations = [], []
    for first in range(1, n + 1, each):
        many = min(each, n + 1 - first)
        rows = problem.by_loop(plants.family(points, range(m * first, m * (first + many))), x)
        by_plant = rows.reshape(len(rows), many, m).max(axis=2)
        values.append([problem.in_units(float(v)) for v in -by_plant[0]])
        violations.append(by_plant[1:].max(axis=0))
    return PlantDraws(np.concatenate(values), np.concatenate(violations))


def drawn_models(fit: PlantLike, n: int, rng: np.random.Generator) -> list[LinearModel]:
    """Return n models of a fit, drawn from the parameter covariance to first order; a plain model is repeated n times.

    Raises
    ------
    UsageError
        When it is no fit of a linear structure, or a drawn delay is negative.
    """
    if isinstance(fit, LinearModel):
        return [fit] * n
    if not isinstance(fit, FitResult) or fit.model_slopes is None:
        raise UsageError(
            "tune_robust: give fits of linear structures (with model_slopes), or an LPV fit or model alone"
        )
    model, slopes = fit.model, fit.model_slopes
    changes = rng.standard_normal((n, len(fit.free))) @ root_of(np.asarray(fit.covariance, float)).T
    assert isinstance(model, LinearModel)
    drawn = []
    for change in changes:
        parts = {
            name: getattr(model, name) + np.tensordot(change, getattr(slopes, name), 1)
            for name in ("A", "B", "C", "D", "B_delayed", "delay")
            if getattr(model, name) is not None
        }
        if "delay" in parts and parts["delay"].min() < 0:
            raise UsageError(f"tune_robust: a drawn plant of {model.name!r} has a negative delay; fix the delays")
        drawn.append(replace(model, **parts))
    return drawn


def _plant_and_uncertainty(model: LPVFit | LPVModel, options: RobustOptions) -> tuple[LPVModel, Uncertainty]:
    plant, known = model.model if isinstance(model, LPVFit) else model, options.uncertainty
    if known is None:
        if not isinstance(model, LPVFit):
            raise UsageError(f"tune_robust: model {model.name!r} has no uncertainty; give an LPV fit, or uncertainty=")
        known = Uncertainty(model.covariance, scatter=model.scatter)
    if known.covariance is None:
        raise UsageError("tune_robust: give the covariance of the coefficients; samples cannot be drawn anew")
    return plant, replace(known, draws=options.draws, seed=options.seed)


# ---- Price of robustness: the damping that holds with a probability, over that probability.


@dataclass(frozen=True, eq=False)
class PriceOfRobustness(Brief):
    """Robust designs for rising probabilities, with the predicted performance of the nominal design.

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
        """Objective that each design reaches with its probability."""
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
    """Return robust designs for several probabilities, which show the loss of damping by robustness.

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
