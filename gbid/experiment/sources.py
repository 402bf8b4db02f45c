"""From the rig and import sections of an experiment to what makes or reads one recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gbid.experiment.load import Experiment
from gbid.experiment.plan import PlannedRecording
from gbid.experiment.schema import ImportedSection
from gbid.experiment.structures import true_parameters
from gbid.lpv import LPVModel
from gbid.rig import Machine, Prbs, SensorChain, Stationary, Unbalance


def machine_at(experiment: Experiment, planned: PlannedRecording, model: LPVModel) -> Machine:
    """Build the rig at the operating point of a recording.

    Raises
    ------
    UsageError
        Outside the model's domain, or when the rig refuses a value.
    """
    rig = experiment.spec.rig
    assert rig is not None
    true = true_parameters(model, planned)
    sensors = rig.sensors
    return Machine.from_parameters(
        true,
        true,
        Unbalance(rig.unbalance.eccentricity_m, rig.unbalance.phase_rad),
        SensorChain(
            noise_p=sensors.noise_p_m,
            noise_u=sensors.noise_u_m,
            runout_amplitude=np.array(sensors.runout_amplitude_m, dtype=object).astype(float),
            runout_phase=np.array(sensors.runout_phase_rad, dtype=object).astype(float),
            offset_p=sensors.offset_p_m,
            offset_u=sensors.offset_u_m,
            encoder_counts=sensors.encoder_counts,
        ),
    )


def rig_experiment(experiment: Experiment, planned: PlannedRecording) -> Prbs | Stationary:
    """Tell what the references of a recording do."""
    rig = experiment.spec.rig
    assert rig is not None
    if planned.excited:
        return Prbs(rig.duration_s, rig.prbs.amplitude_m, rig.prbs.hold_s)
    return Stationary(rig.stationary.duration_s or rig.duration_s)


def data_file(experiment: Experiment, entry: ImportedSection) -> Path:
    """Path of the file of an imported recording."""
    assert experiment.spec.imported is not None
    return experiment.folder / experiment.spec.imported.data_folder / entry.file


def mapping_of(entry: ImportedSection) -> dict[str, Any]:
    """Return the entry as `gbid.import_recording` takes it."""
    mapping = entry.model_dump(exclude={"file", "kind", "remove_mean"}, exclude_none=True)
    for signal in mapping["signals"].values():
        del signal["rests_at_limits"]
    return mapping
