"""Structures of fits, built from their names and options in the YAML."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

from gbid.errors import GbidError, UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.problems import nearest
from gbid.experiment.stages.fit.schema import StructureOptions
from gbid.experiment.stages.loop.looped import looped
from gbid.experiment.stages.loop.plan import controller_identity
from gbid.identify.disturbances.asked import asked_disturbances
from gbid.identify.disturbances.disturbances import Disturbances
from gbid.structure import (
    AnyStructure,
    PiezoPair,
    Plant,
    RotorBearing,
    ScheduledStructure,
    Structure,
    load_structure,
    scheduled,
)


def _rotor_bearing(options: dict[str, Any]) -> Structure:
    return RotorBearing(**options)


def _piezo_pair(options: dict[str, Any]) -> Structure:
    return PiezoPair(**options)


def _plant(options: dict[str, Any]) -> Structure:
    return Plant(RotorBearing(**options))


def _scheduled(build: Callable[[dict[str, Any]], Structure]) -> Callable[[dict[str, Any]], ScheduledStructure]:
    """Return the function that builds a scheduled structure from the options of the base and of its own."""

    def both(options: dict[str, Any]) -> ScheduledStructure:
        own = {key: value for key, value in options.items() if key in _OF_SCHEDULE}
        return scheduled(build({key: value for key, value in options.items() if key not in own}), **own)

    return both


_OF_BEARING = ("delay", "pade_order", "disturbance_gain", "unbalance")
_OF_SCHEDULE = ("order", "piece_s")

BUILT_IN: dict[str, tuple[Callable[[dict[str, Any]], Structure | ScheduledStructure], tuple[str, ...]]] = {
    "rotor_bearing": (_rotor_bearing, (*_OF_BEARING, "film")),
    "piezo_pair": (_piezo_pair, ("disturbance_gain",)),
    "plant": (_plant, _OF_BEARING),
    "scheduled_rotor_bearing": (_scheduled(_rotor_bearing), (*_OF_BEARING, *_OF_SCHEDULE)),
    "scheduled_plant": (_scheduled(_plant), (*_OF_BEARING, *_OF_SCHEDULE)),
}
"""Structures that come with gbid: function that builds each, and its options."""


def make_structure(experiment: Experiment, fit: str, *, planned: bool = False) -> AnyStructure:
    """Return the structure of a fit, that of the loop if its recordings were made in one.

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
    options = _given_options(spec.options)
    if spec.structure in BUILT_IN:
        build, known = BUILT_IN[spec.structure]
        unknown = [key for key in options if key not in known]
        if unknown:
            raise UsageError(f"{spec.structure} has no option {unknown[0]}; {nearest(unknown[0], known)}")
        if options.get("delay") == "exact" and "pade_order" in options:
            raise UsageError("option pade_order is for delay: pade; remove one of the two")
        return build(options)
    if ":" not in spec.structure:
        hint = nearest(spec.structure, BUILT_IN)
        raise UsageError(f"no structure {spec.structure!r}; {hint} (or name one of your own as file.py:name)")
    if options:
        raise UsageError(f"options are for {', '.join(BUILT_IN)}; {spec.structure} has none: remove them")
    return load_structure(spec.structure, experiment.folder_of(spec.structure.rpartition(":")[0]))


def structure_settings(experiment: Experiment, fit: str) -> dict[str, Any]:
    """Return the settings of a structure for its content key: name, options, and the digest of its file."""
    spec = experiment.spec.fits[fit]
    file = spec.structure.rpartition(":")[0]
    settings: dict[str, Any] = {"name": spec.structure, "options": _given_options(spec.options)}
    if file:
        text = (experiment.folder_of(file) / file).read_bytes()
        settings["file_sha256"] = hashlib.sha256(text).hexdigest()
    if spec.loop is not None:
        settings["loop"] = {**spec.loop.model_dump(exclude={"beside"}), **controller_identity(experiment, spec.loop)}
    return settings


def _given_options(options: StructureOptions) -> dict[str, Any]:
    return {key: value for key, value in options if value is not None}


def structure_or_none(experiment: Experiment, fit: str) -> AnyStructure | None:
    """Return the structure of a fit as it is planned; None when another check reports it."""
    try:
        return make_structure(experiment, fit, planned=True)
    except GbidError:
        return None


def fit_disturbances(experiment: Experiment, fit: str, structure: AnyStructure) -> Disturbances:
    """Return the disturbances of the outputs that a fit estimates along.

    Raises
    ------
    UsageError
        When trend, hum or offsets do not fit each other or the outputs. A frequency is compared with the sample time
        later, with the recordings.
    """
    section, labels = experiment.spec.fits[fit], tuple(output_labels(experiment, fit, structure))
    return asked_disturbances(section.trend, section.hum, section.offsets, labels, 0.0, section.focus)


def fit_channels(experiment: Experiment, fit: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the inputs and outputs of a fit: those of its section, else those of its structure.

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
    """Return the labels of the output channels of a fit, such as ``p_x``; empty without these channels."""
    labels: list[str] = []
    planned = experiment.fit_recordings(fit)
    for wanted in experiment.spec.fits[fit].outputs or structure.outputs:
        signal, _, channel = wanted.partition(".")
        there = planned[0].signals.get(signal, ()) if planned else ()
        if not there:
            return []
        picked = [channel] if channel else there
        labels += [f"{signal}_{name}" if len(there) > 1 else signal for name in picked]
    return labels
