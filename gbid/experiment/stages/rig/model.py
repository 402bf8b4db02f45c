"""Model of the rig, and its true parameters at an operating point."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from gbid.experiment.experiment import Experiment
from gbid.experiment.plan import PlannedRecording
from gbid.lpv import LPVModel, load_model


@lru_cache(maxsize=4)
def rig_model(experiment: Experiment) -> LPVModel:
    """Return the model of the rig: by name, or from a YAML file relative to the experiment or the models folder.

    Raises
    ------
    UsageError
        When the model is missing or its file is faulty.
    """
    assert experiment.spec.rig is not None
    name = experiment.spec.rig.model
    if Path(name).suffix in (".yaml", ".yml"):
        return load_model(experiment.folder_of(name) / name)
    return load_model(name)


def true_parameters(model: LPVModel, planned: PlannedRecording) -> dict[str, float]:
    """Return the true key parameters and actuator parameters at the operating point of a recording."""
    return true_parameters_at(model, planned.conditions["pressure_bar"], planned.conditions["speed_rpm"])


def true_parameters_at(model: LPVModel, pressure_bar: float, speed_rpm: float) -> dict[str, float]:
    """Return the true key parameters and actuator parameters at an operating point."""
    key_parameters = model.key_parameters(pressure_bar, speed_rpm)
    return {**{name: float(np.asarray(value)) for name, value in key_parameters.items()}, **model.actuators}
