"""From the name of a structure in the YAML to the structure, and what the rig knows of its true values."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from gbid.errors import UsageError
from gbid.experiment.load import Experiment
from gbid.experiment.plan import PlannedRecording
from gbid.experiment.problems import nearest
from gbid.experiment.schema_fits import StructureOptions
from gbid.experiment.schema_lpv import LpvSection
from gbid.lpv import LPVModel, load_model
from gbid.rig import RotorBearingTruth, scatter_random, scattered
from gbid.share import share_folder
from gbid.structure import (
    KEY_PARAMETERS,
    LinearModel,
    PiezoPair,
    Plant,
    RotorBearing,
    Structure,
    evaluate,
    load_structure,
)


def _rotor_bearing(options: dict[str, Any]) -> Structure:
    return RotorBearing(**options)


def _piezo_pair(options: dict[str, Any]) -> Structure:
    return PiezoPair(**options)


def _plant(options: dict[str, Any]) -> Structure:
    return Plant(RotorBearing(**options))


_OF_BEARING = ("delay", "pade_order", "disturbance_gain")

BUILT_IN: dict[str, tuple[Callable[[dict[str, Any]], Structure], tuple[str, ...]]] = {
    "rotor_bearing": (_rotor_bearing, _OF_BEARING),
    "piezo_pair": (_piezo_pair, ("disturbance_gain",)),
    "plant": (_plant, _OF_BEARING),
}
"""Structures that come with gbid: how each is built, and which options it has."""


def make_structure(experiment: Experiment, fit: str) -> Structure:
    """Build the structure of a fit.

    Raises
    ------
    UsageError
        For an unknown name, an option that the structure does not have, or a file that does not give one.
    """
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
    return load_structure(spec.structure, _folder_of(experiment, spec.structure.rpartition(":")[0]))


def structure_settings(experiment: Experiment, fit: str) -> dict[str, Any]:
    """Return what decides the structure, for its content key: name and options, or the text of its file."""
    spec = experiment.spec.fits[fit]
    file = spec.structure.rpartition(":")[0]
    settings: dict[str, Any] = {"name": spec.structure, "options": _given_options(spec.options)}
    if file:
        text = (_folder_of(experiment, file) / file).read_bytes()
        settings["file_sha256"] = hashlib.sha256(text).hexdigest()
    return settings


@lru_cache(maxsize=4)
def rig_model(experiment: Experiment) -> LPVModel:
    """Load the model behind the rig: a name, or a YAML file relative to the experiment or the models folder.

    Raises
    ------
    UsageError
        When there is none, or its file is broken.
    """
    assert experiment.spec.rig is not None
    name = experiment.spec.rig.model
    if Path(name).suffix in (".yaml", ".yml"):
        return load_model(_folder_of(experiment, name) / name)
    return load_model(name)


def lpv_actuators(experiment: Experiment, section: LpvSection) -> dict[str, float] | None:
    """Give the actuators that surfaces are to carry: those of a model; None when they are still to be chosen.

    Raises
    ------
    UsageError
        When they are to be the nominal ones and no section chooses these; for a model that is not there, or knows none.
    """
    wanted = section.actuators
    if wanted is None:
        return {}
    if wanted == "nominal":
        if experiment.spec.nominal is None:
            raise UsageError("there is no section 'nominal'; add one, or name a model or its file")
        return None
    beside = experiment.folder / wanted
    try:
        found = load_model(beside if beside.suffix in (".yaml", ".yml") else wanted).actuators
    except UsageError as error:
        raise UsageError(f"expected nominal, or a model or its file; {error}") from None
    if not found:
        raise UsageError(f"model {wanted!r} knows no actuators; name another, or write nominal")
    return dict(found)


def true_values(experiment: Experiment, recordings: Sequence[str], structure: Structure) -> dict[str, float]:
    """Give the true values of a structure's parameters, if the recordings come from the rig at one operating point.

    Parameters
    ----------
    experiment : Experiment
    recordings : sequence of str
        Names of the recordings of a fit.
    structure : Structure

    Returns
    -------
    dict of str to float
        Of the parameters that the rig knows; empty when there is no truth to compare with.
    """
    planned = [experiment.recordings[name] for name in recordings]
    points = {tuple(sorted(q.conditions.items())) for q in planned}
    if len(points) != 1 or any(q.imported for q in planned) or not _is_built_in(structure):
        return {}
    known = _as_drawn(experiment, planned)
    return {q.name: known[q.name] for q in structure.parameters if q.name in known}


def _as_drawn(experiment: Experiment, planned: Sequence[PlannedRecording]) -> dict[str, float]:
    """Give what is true of all these recordings: scatter moves each rotor, nonlinear stacks have no Table 2."""
    rig = experiment.spec.rig
    assert rig is not None
    known = true_parameters(rig_model(experiment), planned[0])
    if rig.actuators.kind == "stacks":
        known = {name: value for name, value in known.items() if name in KEY_PARAMETERS}
    if rig.scatter is None:
        return known
    if len({q.name for q in planned}) > 1:
        return {name: value for name, value in known.items() if name not in KEY_PARAMETERS}
    random = scatter_random(rig.seed, planned[0].name, planned[0].conditions)
    drawn, _ = scattered(RotorBearingTruth.from_parameters(known), rig.scatter.as_scatter(), random)
    return {**known, **drawn.key_parameters()}


def true_parameters(model: LPVModel, planned: PlannedRecording) -> dict[str, float]:
    """Key parameters and actuator parameters of the rig at the operating point of a recording."""
    key_parameters = model.key_parameters(planned.conditions["pressure_bar"], planned.conditions["speed_rpm"])
    return {**{name: float(np.asarray(value)) for name, value in key_parameters.items()}, **model.actuators}


def true_model(structure: Structure, truth: dict[str, float], like: LinearModel) -> LinearModel | None:
    """Return the structure at its true values, None when it has none; disturbance gains do not matter to it."""
    values = {q.name: 0.0 for q in structure.parameters if q.name.startswith("bd")} | truth
    if not truth or any(q.name not in values for q in structure.parameters):
        return None
    return evaluate(structure, values, like.input_names, like.output_names)


def _is_built_in(structure: Structure) -> bool:
    return isinstance(structure, RotorBearing | PiezoPair | Plant)


def _given_options(options: StructureOptions) -> dict[str, Any]:
    return {key: value for key, value in options if value is not None}


def _folder_of(experiment: Experiment, file: str) -> Path:
    """Folder from where a file name counts: the experiment's own, else the models that come with gbid."""
    for folder in (experiment.folder, share_folder("models")):
        if (folder / file).is_file():
            return folder
    return experiment.folder
