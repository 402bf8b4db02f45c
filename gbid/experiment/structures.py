"""Structures of fits from names and options in the YAML, in open or closed loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np

from gbid import control
from gbid.core.errors import GbidError, UsageError, nearest
from gbid.core.extras import offered
from gbid.experiment.controllers import at_point, controller_identity, found_controller, sample_time
from gbid.experiment.experiment import Experiment
from gbid.experiment.fields import about, file_digest
from gbid.experiment.rig_schema import LoopSection
from gbid.experiment.user_code import file_of, user_structure
from gbid.identify.disturbances import Disturbances, disturbances_of
from gbid.structure import (
    ClosedLoop,
    LinearModel,
    MagneticBearing,
    PiezoPair,
    Plant,
    RigidRotor,
    RotorBearing,
    ScheduledStructure,
    Structure,
)
from gbid.structure.kinds import AnyStructure, kind_of
from gbid.structure.scheduling import scheduled
from gbid.structure.user import called, checked


def looped(
    experiment: Experiment, structure: AnyStructure, section: LoopSection, fit: str, *, planned: bool = False
) -> ClosedLoop:
    """Return the closed loop of a structure with the controller of a section.

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
    linear = kind_of(structure).linear
    if linear is None:
        raise UsageError(f"{structure.name}: a loop needs a linear structure with constant parameters")
    if isinstance(structure, RotorBearing | PiezoPair):
        raise UsageError(
            f"{structure.name} is only a part of the plant from r to p; write structure: plant, or remove loop: and "
            "fit the structure from its measured inputs and outputs"
        )
    law, sampled_at = _law(experiment, section, fit, planned)
    samples = section.computation_samples if section.sampled else 0
    return ClosedLoop(
        linear,
        law,
        sample_time=sampled_at,
        computation_samples=samples,
        measured=section.measured,
        injected=section.injected,
        pade_order=section.pade_order,
    )


def _law(
    experiment: Experiment, section: LoopSection, fit: str, planned: bool
) -> tuple[LinearModel | Structure, float | None]:
    """Return the controller for `ClosedLoop`, and the sample time of its discretisation (None: continuous)."""
    controller = found_controller(experiment, section, planned=planned)
    if not isinstance(controller, control.ControllerDesign):
        if section.delay_s is not None:
            raise UsageError(
                "delay_s is for a known continuous controller; an unknown controller needs a Padé filter in its "
                "structure"
            )
        return controller, sample_time(experiment, section) if section.sampled else None
    model = controller.at(*at_point(controller, _conditions(experiment, fit)))
    running_at = section.sample_time_s or controller.rate
    if section.sampled:
        if section.delay_s is not None:
            raise UsageError("delay_s is for a continuous controller; write computation_samples, or sampled: false")
        return control.sample_controller(model, running_at, controller.method) if model.dt is None else model, None
    if model.dt is not None:
        raise UsageError(f"controller {model.name!r} is sampled; remove sampled: false")
    if section.sample_time_s is not None:
        raise UsageError("sample_time_s is for a sampled controller; remove it, or sampled: false")
    delay_s = (section.computation_samples + 0.5) * running_at if section.delay_s is None else section.delay_s
    return _with_delayed_output(model, delay_s), None


def _with_delayed_output(model: LinearModel, delay: float) -> LinearModel:
    """Return a continuous controller with an exact output delay [s]."""
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
    """Return the common operating point of all recordings of a fit; empty if they have several."""
    points = [dict(planned.conditions) for planned in experiment.fit_recordings(fit)]
    return points[0] if points and all(point == points[0] for point in points) else {}


def _plant(poles: Literal["real", "any"] = "real", **options: Any) -> Structure:
    return Plant(RotorBearing(**options), PiezoPair(poles=poles))


def _magnetic_bearing(**options: Any) -> Structure:
    """Return a rigid rotor on magnetic bearings from the options of rotor and bearings."""
    chain = {key: options.pop(key) for key in _OF_AMPLIFIERS if key in options}
    return MagneticBearing(RigidRotor(**options), **chain)


def _scheduled(build: Callable[..., Structure], **options: Any) -> ScheduledStructure:
    """Return a scheduled structure from the options of base structure and schedule."""
    schedule = {key: options.pop(key) for key in _OF_SCHEDULE if key in options}
    return scheduled(build(**options), **schedule)


_OF_BEARING = ("delay", "pade_order", "disturbance_gain", "unbalance")
_OF_SCHEDULE = ("order", "piece_s")
_OF_ROTOR = ("axes", "mass_kg", "inertia_kg_m2", "polar_inertia_kg_m2", "arms_m", "sensor_arms_m", "speed_rpm")
_OF_AMPLIFIERS = ("amplifier_hz", "amplifier_delay_s", "longest_delay_s", "sensor_hz")

BUILT_IN: dict[str, tuple[Callable[..., Structure | ScheduledStructure], tuple[str, ...]]] = {
    "rotor_bearing": (RotorBearing, (*_OF_BEARING, "film")),
    "piezo_pair": (PiezoPair, ("disturbance_gain", "poles")),
    "plant": (_plant, (*_OF_BEARING, "poles")),
    "rigid_rotor": (RigidRotor, (*_OF_ROTOR, "k_s", "k_i")),
    "magnetic_bearing": (_magnetic_bearing, (*_OF_ROTOR, "k_s", "k_i", *_OF_AMPLIFIERS)),
    "scheduled_rotor_bearing": (partial(_scheduled, RotorBearing), (*_OF_BEARING, *_OF_SCHEDULE)),
    "scheduled_plant": (partial(_scheduled, _plant), (*_OF_BEARING, *_OF_SCHEDULE)),
}
"""Structures that come with gbid: function that builds each, and its options."""


def make_structure(experiment: Experiment, fit: str, *, planned: bool = False) -> AnyStructure:
    """Return the structure of a fit, in closed loop if its recordings were made in one.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    fit : str
        Name of the fit.
    planned : bool
        Whether a controller that is not tuned yet may stand with the start values of its gains, for checks.

    Raises
    ------
    UsageError
        When the name or an option is unknown, or the file does not define a structure.
    InputError
        When the controller of the loop has not been tuned with the present settings.
    """
    section, plant = experiment.spec.fits[fit], plant_structure(experiment, fit)
    return plant if section.loop is None else looped(experiment, plant, section.loop, fit, planned=planned)


def plant_structure(experiment: Experiment, fit: str) -> AnyStructure:
    """Return the structure of a fit without a controller; raises as `make_structure`."""
    spec = experiment.spec.fits[fit]
    options = spec.options.model_dump(exclude_none=True)
    if spec.structure in BUILT_IN:
        build, known = BUILT_IN[spec.structure]
        unknown = [key for key in options if key not in known]
        if unknown:
            raise UsageError(f"{spec.structure} has no option {unknown[0]}; {nearest(unknown[0], known)}", "options")
        with about("options"):
            return build(**options)
    if offer := _offered(spec.structure):
        build, package = offer
        with about("structure"):
            structure = called(build, f"{spec.structure} of {package}", **options) if callable(build) else build
            return checked(structure, spec.structure, package)
    if not file_of(spec.structure):
        hint = nearest(spec.structure, BUILT_IN)
        raise UsageError(
            f"no structure {spec.structure!r}; {hint} (or name one of your own as file.py:name, or install the package "
            "that offers it)",
            "structure",
        )
    if options:
        raise UsageError(f"options are for {', '.join(BUILT_IN)}; {spec.structure} has none: remove them", "options")
    with about("structure"):
        return user_structure(spec.structure, experiment.folder_of(file_of(spec.structure)))


def _offered(name: str) -> tuple[Any, str] | None:
    """Return a structure that an installed package offers, and the package; None for a Python file."""
    return None if file_of(name) else offered("gbid.structures", name)


def structure_settings(experiment: Experiment, fit: str) -> dict[str, Any]:
    """Return the settings of a structure for its content key: name, options, and digest of its file."""
    spec = experiment.spec.fits[fit]
    file = file_of(spec.structure)
    settings: dict[str, Any] = {"name": spec.structure, "options": spec.options.model_dump(exclude_none=True)}
    if spec.structure not in BUILT_IN and (offer := _offered(spec.structure)):
        settings["package"] = offer[1]
    if file:
        settings["file_sha256"] = file_digest(experiment.folder_of(file) / file)
    if spec.loop is not None:
        settings["loop"] = {**spec.loop.model_dump(exclude={"beside"}), **controller_identity(experiment, spec.loop)}
    return settings


def structure_or_none(experiment: Experiment, fit: str) -> AnyStructure | None:
    """Return the planned structure of a fit; None if it has errors, which another check reports."""
    try:
        return make_structure(experiment, fit, planned=True)
    except GbidError:
        return None


def fit_disturbances(experiment: Experiment, fit: str, structure: AnyStructure) -> Disturbances:
    """Return the output disturbances that a fit estimates.

    Raises
    ------
    UsageError
        When trend or hum do not fit each other or the outputs. A frequency is compared with the sample time
        later, with the recordings.
    """
    section, labels = experiment.spec.fits[fit], tuple(output_labels(experiment, fit, structure))
    with about("trend"):
        return disturbances_of(section, labels, 0.0)


def fit_channels(experiment: Experiment, fit: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the inputs and outputs of a fit: from its section, else from its structure.

    ``inputs: []`` is a free decay, without inputs.

    Raises
    ------
    UsageError
        When the structure is needed and cannot be made.
    """
    section = experiment.spec.fits[fit]
    structure = make_structure(experiment, fit, planned=True)
    inputs = structure.inputs if section.inputs is None else section.inputs
    return inputs, section.outputs or structure.outputs


def output_labels(experiment: Experiment, fit: str, structure: AnyStructure) -> list[str]:
    """Return the labels of the output channels of a fit, such as ``p_x``; empty for unknown channels."""
    planned = experiment.fit_recordings(fit)
    signals = planned[0].signals if planned else {}
    labels: list[str] = []
    for wanted in experiment.spec.fits[fit].outputs or structure.outputs:
        signal, _, channel = wanted.partition(".")
        if not (names := signals.get(signal)):
            return []
        labels += [f"{signal}_{name}" if len(names) > 1 else signal for name in ([channel] if channel else names)]
    return labels
