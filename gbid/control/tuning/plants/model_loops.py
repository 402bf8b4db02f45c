"""Loops of given linear models: any plants with named inputs and outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray
from gbid.control.controllers.scheduled import Scheduled
from gbid.control.loop.sampling import sample_plant
from gbid.control.tuning.plants.controller_law import ControllerLaw
from gbid.control.tuning.plants.model_family import model_family
from gbid.control.tuning.plants.plant_set import PlantSet
from gbid.control.tuning.plants.sampled_loops import Sampling, stacked
from gbid.control.tuning.search.loop_delay import PADE_ORDER
from gbid.control.tuning.search.loop_family import LoopFamily
from gbid.errors import UsageError
from gbid.structure import LinearModel, pade_delay, with_pade
from gbid.structure.linear import Structure

_FIRST = 4


@dataclass(frozen=True, eq=False)
class ModelLoops(PlantSet):
    """Loops of given models and one controller; the first column of a point is the index of its model.

    Parameters
    ----------
    structure : Structure
        Structure of the controller.
    models : tuple of LinearModel
        Continuous plants with equal inputs and outputs; delays may be exact.
    sampling : Sampling, optional
        Rate of the target; None for continuous loops, in which exact delays are replaced by Padé delays.
    delay_s : float
        Additional delay of continuous loops by sampling and computation [s].
    """

    structure: Structure
    models: tuple[LinearModel, ...]
    sampling: Sampling | None = None
    delay_s: float = 0.0

    @property
    def points(self) -> FloatArray:
        """One point for each model (m, 2)."""
        return np.column_stack([np.arange(len(self.models), dtype=float), np.zeros(len(self.models))])

    def family(self, points: FloatArray, which: Sequence[int] | None = None) -> LoopFamily:
        """Return the loops of the models at points, or some of them."""
        chosen = points if which is None else points[list(which)]
        models = [self.models[int(i)] for i in chosen[:, 0]]
        labels = tuple(model.name for model in models)
        if len(set(labels)) < len(labels):
            labels = tuple(f"{name} ({int(i) + 1})" for name, i in zip(labels, chosen[:, 0], strict=True))
        smooth = [_late(model, self.delay_s) for model in models]
        size = self.models[0].D.shape[::-1]
        law = ControllerLaw(self.structure, chosen, size)
        continuous = model_family(stacked(smooth), law, labels, None)
        if self.sampling is None:
            return continuous
        T, computation = self.sampling.sample_time, self.sampling.computation_s
        plants = stacked([sample_plant(model, T, computation) for model in models])
        law = ControllerLaw(self.structure, chosen, size, T, self.sampling.method)
        return model_family(plants, law, labels, None, continuous)

    def first(self, points: FloatArray) -> list[int]:
        """Return some models, evenly among all."""
        return sorted({round(i) for i in np.linspace(0, len(points) - 1, _FIRST)})


def _late(model: LinearModel, delay_s: float) -> LinearModel:
    """Return a model with all inputs delayed and its own delays, as Padé delays."""
    smooth = model if model.delay is None else with_pade(model, PADE_ORDER)
    if not delay_s:
        return smooth
    late = pade_delay(delay_s, PADE_ORDER)
    each = np.eye(smooth.D.shape[1])
    a, b, c, d = (np.kron(each, np.array(ca.DM(M))) for M in (late.A, late.B, late.C, late.D))
    A = np.block([[smooth.A, smooth.B @ c], [np.zeros((len(a), len(smooth.A))), a]])
    B, C = np.vstack([smooth.B @ d, b]), np.hstack([smooth.C, smooth.D @ c])
    return replace(smooth, A=A, B=B, C=C, D=smooth.D @ d, K=None, state_names=())


def checked_models(
    models: Sequence[LinearModel],
    structure: Structure | Scheduled,
    inputs: Sequence[str] | None,
    outputs: Sequence[str] | None,
) -> tuple[LinearModel, ...]:
    """Return the models with the chosen channels only, in order.

    Parameters
    ----------
    models : sequence of LinearModel
        Continuous plants.
    structure : Structure
        Structure of the controller.
    inputs, outputs : sequence of str, optional
        Channels of the plant that the controller drives and measures, in the order of its outputs and inputs; by
        default all.

    Raises
    ------
    UsageError
        When a model is sampled or has no such channel, when their number does not fit the controller, or when the
        controller is scheduled.
    """
    if isinstance(structure, Scheduled):
        raise UsageError(f"controller {structure.name!r}: a schedule needs an LPV model, with pressure and speed")
    found = []
    for model in models:
        if model.dt is not None:
            raise UsageError(
                f"model {model.name!r} is sampled at {model.dt:g} s; give the continuous model, and sample_time"
            )
        columns = _places(model, "input", model.input_names, inputs)
        rows = _places(model, "output", model.output_names, outputs)
        for what, n, names in (("outputs", len(columns), structure.outputs), ("inputs", len(rows), structure.inputs)):
            if n != len(names):
                raise UsageError(
                    f"controller {structure.name!r} has {len(names)} {what} ({', '.join(names)}), the plant "
                    f"{model.name!r} {n}; choose channels by inputs= and outputs=, or axes= of the structure"
                )
        found.append(_channels(model, columns, rows))
    return tuple(found)


def _places(model: LinearModel, what: str, names: tuple[str, ...], wanted: Sequence[str] | None) -> list[int]:
    if wanted is not None and len(set(wanted)) < len(wanted):
        raise UsageError(f"{what}s = {wanted!r}: give each {what} once")
    for name in wanted or ():
        if name not in names:
            raise UsageError(f"model {model.name!r} has no {what} {name!r}; there are {', '.join(names)}")
    return list(range(len(names))) if wanted is None else [names.index(name) for name in wanted]


def _channels(model: LinearModel, columns: list[int], rows: list[int]) -> LinearModel:
    delayed = None if model.B_delayed is None else model.B_delayed[:, columns]
    return LinearModel(
        model.A,
        model.B[:, columns],
        model.C[rows],
        model.D[np.ix_(rows, columns)],
        input_names=tuple(model.input_names[i] for i in columns),
        output_names=tuple(model.output_names[i] for i in rows),
        state_names=model.state_names,
        name=model.name,
        B_delayed=delayed,
        delay=None if model.delay is None else model.delay[columns],
    )
