"""Plants of a design from what a user gives: an LPV model, linear models, fits, or a list of these."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gbid.arrays import ComplexArray, FloatArray
from gbid.control.controllers.scheduled import Scheduled
from gbid.control.loop.sampled import exact_plant
from gbid.control.tuning.plants.loops_at_points import LoopsAtPoints
from gbid.control.tuning.plants.model_loops import ModelLoops, checked_models
from gbid.control.tuning.plants.plant_set import PlantSet
from gbid.control.tuning.plants.sampled_loops import SampledLoops, Sampling
from gbid.control.tuning.plants.uncertainty import Uncertainty
from gbid.control.tuning.search.loop_delay import PADE_ORDER, loop_delay
from gbid.control.tuning.search.loop_family import loop_equations
from gbid.errors import UsageError
from gbid.identify import FitResult
from gbid.lpv import ACTUATOR_PARAMETERS, Domain, LPVFit, LPVModel
from gbid.poles import is_real
from gbid.structure import LinearModel
from gbid.structure.linear import Structure

Point = tuple[float, float]
PlantLike = LPVModel | LPVFit | LinearModel | FitResult
"""What `gbid.tune` takes as a plant."""


@dataclass(frozen=True, eq=False)
class DesignPlants:
    """Plants of a design.

    Attributes
    ----------
    continuous : PlantSet
        Loops in continuous time, with the delay of sampling when there is one.
    sampled : PlantSet or None
        Sampled loops; None for a continuous design.
    points : (m, 2) array
        Points of the loops.
    plant : LinearModel
        One of the plants in continuous time.
    slowest : tuple of float
        Slowest decay of the oscillatory modes of each open loop [1/s].
    lpv : LPVModel or None
        The LPV model; None for given models.
    domain : Domain or None
        Domain over which the design must hold.
    unfinished : tuple of FitResult
        Plants that are fits which did not converge.
    """

    continuous: PlantSet
    sampled: PlantSet | None
    points: FloatArray
    plant: LinearModel
    slowest: tuple[float, ...]
    lpv: LPVModel | None = None
    domain: Domain | None = None
    unfinished: tuple[FitResult, ...] = ()


def plants_of(
    model: PlantLike | Sequence[PlantLike],
    structure: Structure | Scheduled,
    operating_points: Sequence[Point] | Literal["domain"] | None,
    actuator: Mapping[str, float] | None,
    uncertainty: Uncertainty | None,
    sampling: Sampling | None,
    channels: tuple[Sequence[str] | None, Sequence[str] | None],
) -> DesignPlants:
    """Return the plants of a design; the arguments are those of `gbid.tune`.

    Raises
    ------
    UsageError
        When a model is of another kind, or when arguments do not belong to it.
    """
    if uncertainty is not None and not isinstance(uncertainty, Uncertainty):
        raise UsageError(f"uncertainty is a {type(uncertainty).__name__}; give gbid.Uncertainty(covariance)")
    if isinstance(model, LPVFit):
        model = model.model
    if isinstance(model, LPVModel):
        if channels != (None, None):
            raise UsageError("tune: inputs and outputs choose channels of linear models; an LPV model has r and p")
        return _of_lpv(model, structure, operating_points, actuator, uncertainty, sampling)
    given = list(model) if isinstance(model, Sequence) else [model]
    if not given:
        raise UsageError("tune: no models")
    if uncertainty is not None:
        raise UsageError("tune: uncertainty belongs to an LPV model; give the drawn models in the list")
    models = [one for each in given for one in _linear(each, operating_points, actuator, sampling is not None)]
    for name, value in (("operating_points", operating_points), ("actuator", actuator)):
        if value is not None and not any(isinstance(each, LPVModel | LPVFit) for each in given):
            raise UsageError(f"tune: {name} belongs to LPV models; leave it out")
    chosen = checked_models(models, structure, *channels)
    assert not isinstance(structure, Scheduled)
    continuous = ModelLoops(structure, chosen, delay_s=_delay(sampling))
    sampled = None if sampling is None else ModelLoops(structure, chosen, sampling)
    slowest = tuple(slowest_mode(one.poles()) for one in chosen)
    unfinished = tuple(each for each in given if isinstance(each, FitResult) and not each.success)
    return DesignPlants(continuous, sampled, continuous.points, chosen[0], slowest, unfinished=unfinished)


def _of_lpv(
    lpv: LPVModel,
    structure: Structure | Scheduled,
    operating_points: Sequence[Point] | Literal["domain"] | None,
    actuator: Mapping[str, float] | None,
    uncertainty: Uncertainty | None,
    sampling: Sampling | None,
) -> DesignPlants:
    machine = _with_actuators(lpv, actuator)
    points = _points(lpv, operating_points)
    slowest = tuple(slowest_mode(lpv.at(float(P), float(Omega)).poles()) for P, Omega in points)
    delay_s = _delay(sampling)
    late = replace(machine, pade_order=PADE_ORDER) if delay_s else machine
    equations = loop_equations(late, structure, delay_s=delay_s)
    continuous = LoopsAtPoints(structure, equations, points, uncertainty, late, delay_s)
    sampled = None if sampling is None else SampledLoops(continuous, machine, sampling)
    plant = machine.plant_at(float(points[0, 0]), float(points[0, 1]))
    domain = lpv.domain if isinstance(operating_points, str) else None
    return DesignPlants(continuous, sampled, points, plant, slowest, machine, domain)


def _with_actuators(lpv: LPVModel, actuator: Mapping[str, float] | None) -> LPVModel:
    given = lpv.actuators if actuator is None else actuator
    missing = [name for name in ACTUATOR_PARAMETERS if name not in given]
    if missing:
        raise UsageError(f"model {lpv.name!r} has no actuator {', '.join(missing)}; give actuator={{...}}")
    return lpv if actuator is None else replace(lpv, actuators=dict(actuator))


def _delay(sampling: Sampling | None) -> float:
    return 0.0 if sampling is None else loop_delay(sampling.sample_time, sampling.computation_s)


def _linear(
    given: PlantLike,
    operating_points: Sequence[Point] | Literal["domain"] | None,
    actuator: Mapping[str, float] | None,
    exact: bool,
) -> list[LinearModel]:
    """Return the linear models of one entry of a list: one for each operating point of an LPV model."""
    if isinstance(given, LPVFit):
        given = given.model
    if isinstance(given, LPVModel):
        machine = _with_actuators(given, actuator)
        places = [(float(P), float(Omega)) for P, Omega in _points(machine, operating_points)]
        return [exact_plant(machine, *place) if exact else machine.plant_at(*place) for place in places]
    found = given.model if isinstance(given, FitResult) else given
    if not isinstance(found, LinearModel):
        raise UsageError(
            f"tune: a {type(given).__name__} is no plant; give an LPV model, a LinearModel (of a nonlinear one its "
            "linearise(x0, u0)), a fit, or a list of these"
        )
    return [found]


def _points(lpv: LPVModel, given: Sequence[Point] | str | None) -> FloatArray:
    """Return operating points (m, 2), checked against the domain; of a whole domain its corners and middles."""
    if isinstance(given, str):
        if given != "domain":
            raise UsageError(f"operating_points = {given!r}; give a list of (pressure_bar, speed_rpm) or 'domain'")
        (p0, p1), (w0, w1) = lpv.domain.pressure_bar, lpv.domain.speed_rpm
        return np.array([(p, w) for p in (p0, (p0 + p1) / 2, p1) for w in (w0, (w0 + w1) / 2, w1)])
    points = lpv.operating_points if given is None else given
    try:
        array = np.array([(float(P), float(Omega)) for P, Omega in points])
    except (TypeError, ValueError):
        raise UsageError("operating_points: give a list of (pressure_bar, speed_rpm)") from None
    if not len(array):
        raise UsageError(
            f"model {lpv.name!r} lists no operating points; give operating_points=[(pressure, speed), ...]"
        )
    lpv.domain.check(array[:, 0], array[:, 1], f"model {lpv.name!r}")
    return array


def slowest_mode(poles: ComplexArray) -> float:
    """Return the slowest decay [1/s] of the oscillatory modes, negative when one is unstable."""
    pairs = poles[~is_real(poles)]
    return float(-pairs.real.max()) if len(pairs) else 0.0
