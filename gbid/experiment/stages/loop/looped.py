"""Closed loop of a fit's structure and the controller that its section names."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from gbid.control.loop.sampling import sample_controller
from gbid.errors import UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.stages.loop.plan import at_point, found_controller, rig_time
from gbid.experiment.stages.loop.schema import LoopSection
from gbid.structure import (
    AnyStructure,
    ClosedLoop,
    LinearModel,
    LinearStructure,
    NonlinearStructure,
    PiezoPair,
    RotorBearing,
    ScheduledStructure,
)
from gbid.structure.linear import Structure


def looped(
    experiment: Experiment, structure: AnyStructure, section: LoopSection, fit: str, *, planned: bool = False
) -> ClosedLoop:
    """Return the loop of a structure and the controller of a section.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    structure : Structure
        The plant.
    section : LoopSection
        How the loop is closed.
    fit : str
        Name of the fit; its recordings tell the operating point of a scheduled controller.
    planned : bool
        See `found_controller`.

    Raises
    ------
    UsageError
        When structure, controller and options do not fit each other.
    InputError
        When a design has not been tuned with the present settings.
    """
    if isinstance(structure, NonlinearStructure | ScheduledStructure):
        raise UsageError(f"{structure.name}: a loop needs a linear structure with constant parameters")
    if isinstance(structure, RotorBearing | PiezoPair):
        raise UsageError(
            f"{structure.name} is a part of what the controller acts on, from r to p; write structure: plant, or leave "
            "loop out and fit it from what was measured on both sides"
        )
    law, sample_time = _law(experiment, section, fit, planned)
    samples = section.computation_samples if section.sampled else 0
    return ClosedLoop(
        structure,
        law,
        sample_time=sample_time,
        computation_samples=samples,
        measured=section.measured,
        injected=section.injected,
        pade_order=section.pade_order,
    )


def _law(
    experiment: Experiment, section: LoopSection, fit: str, planned: bool
) -> tuple[LinearModel | Structure, float | None]:
    """Return the controller for `ClosedLoop`, and the sample time at which it is to be sampled there."""
    found = found_controller(experiment, section, planned=planned)
    rate = section.sample_time_s or rig_time(experiment)
    if found.structure is not None:
        gains = found.structure
        if section.delay_s is not None:
            raise UsageError(
                "delay_s is for a known continuous controller; an unknown one needs a Padé filter of its own"
            )
        return _with_known(gains, dict(section.gains)), rate if section.sampled else None
    if found.model is not None:
        model = found.model
    else:
        design = found.design
        assert design is not None
        point = at_point(design, _conditions(experiment, fit))
        model = design.at(*point)
        rate = section.sample_time_s or design.sample_time
        if section.sampled:
            model = sample_controller(model, rate, design.method)
    if section.sampled:
        if section.delay_s is not None:
            raise UsageError("delay_s is for a continuous controller; write computation_samples, or sampled: false")
        return model, None if model.dt is not None else rate
    if model.dt is not None:
        raise UsageError(f"controller {model.name!r} is sampled; remove sampled: false")
    if section.sample_time_s is not None:
        raise UsageError("sample_time_s is for a sampled controller; remove it, or sampled: false")
    return _late(
        model, (section.computation_samples + 0.5) * rate if section.delay_s is None else section.delay_s
    ), None


def _with_known(structure: Structure, gains: dict[str, float]) -> Structure:
    """Return a structure whose known gains are fixed."""
    if not gains:
        return structure
    parameters = [
        replace(q, start=gains[q.name], lower=-np.inf, upper=np.inf, fixed=True) if q.name in gains else q
        for q in structure.parameters
    ]
    return LinearStructure(structure.name, parameters, structure.matrices, structure.inputs, structure.outputs)


def _late(model: LinearModel, delay: float) -> LinearModel:
    """Return a continuous controller whose output is late by an exact delay [s]."""
    if not delay:
        return model
    if model.D.any() or model.delay is not None:
        raise UsageError(
            f"controller {model.name!r} has direct feedthrough or a delay of its own; give it a low-pass, or write "
            "delay_s: 0.0"
        )
    none: dict[str, Any] = {"B": np.zeros_like(model.B), "B_delayed": model.B}
    return replace(model, **none, delay=np.full(model.B.shape[1], delay))


def _conditions(experiment: Experiment, fit: str) -> dict[str, float]:
    """Return the operating point that all recordings of a fit share; empty when they have several."""
    points = [dict(planned.conditions) for planned in experiment.fit_recordings(fit)]
    return points[0] if points and all(point == points[0] for point in points) else {}
