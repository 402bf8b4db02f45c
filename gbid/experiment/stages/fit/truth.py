"""True values of the parameters of a fit, for recordings of the rig."""

from __future__ import annotations

from collections.abc import Sequence

from gbid.experiment.experiment import Experiment
from gbid.experiment.plan import PlannedRecording
from gbid.experiment.stages.rig.model import rig_model, true_parameters
from gbid.rig import FilmStiffening, RotorBearingTruth, scatter_random, scattered
from gbid.structure import (
    KEY_PARAMETERS,
    AnyStructure,
    ClosedLoop,
    LinearModel,
    NonlinearStructure,
    PiezoPair,
    Plant,
    RotorBearing,
    ScheduledStructure,
    evaluate,
)
from gbid.structure.rotor_bearing import STIFFENING


def true_values(experiment: Experiment, recordings: Sequence[str], structure: AnyStructure) -> dict[str, float]:
    """Return the true values of the parameters of a structure.

    They are known for recordings of the rig at one operating point and built-in structures.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    recordings : sequence of str
        Names of the recordings of a fit.
    structure : Structure
        Structure of the fit.

    Returns
    -------
    dict of str to float
        True values by parameter, in the units of the structure; empty when none are known.
    """
    planned = [experiment.recordings[name] for name in recordings]
    points = {tuple(sorted(q.conditions.items())) for q in planned}
    if points != {tuple(sorted(planned[0].conditions.items()))} or "speed_rpm" not in planned[0].conditions:
        return {}  # several operating points, or none, as along a course
    if any(q.imported for q in planned) or not _is_built_in(_plant_of(structure)):
        return {}
    known = {**_as_drawn(experiment, planned), STIFFENING: _stiffening(experiment)}
    return {q.name: known[q.name] for q in structure.parameters if q.name in known}


def _as_drawn(experiment: Experiment, planned: Sequence[PlannedRecording]) -> dict[str, float]:
    """Return the true values that all recordings share; scatter changes them, and stacks have no linear parameters."""
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


def _stiffening(experiment: Experiment) -> float:
    film = experiment.spec.rig.stiffening if experiment.spec.rig else None
    return FilmStiffening(film.deviation_m, film.at_m).inverse_square_length if film else 0.0


def true_model(structure: AnyStructure, truth: dict[str, float], like: LinearModel) -> LinearModel | None:
    """Return the structure at its true values; None when some are unknown. Disturbance gains are set to zero."""
    values = {q.name: 0.0 for q in structure.parameters if q.name.startswith("bd")} | truth
    if (
        isinstance(structure, NonlinearStructure | ScheduledStructure)
        or not truth
        or any(q.name not in values for q in structure.parameters)
    ):
        return None
    return evaluate(structure, values, like.input_names, like.output_names)


def _plant_of(structure: AnyStructure) -> AnyStructure:
    return structure.structure if isinstance(structure, ClosedLoop) else structure


def _is_built_in(structure: AnyStructure) -> bool:
    return isinstance(structure, RotorBearing | PiezoPair | Plant)
