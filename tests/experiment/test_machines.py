"""Machines that come as files in models and experiments: their own recordings give their true parameters."""

import numpy as np
import pytest

import gbid
from gbid.core.files import share_folder
from gbid.experiment.load import load_experiment
from gbid.experiment.stages.importing import read_import
from gbid.experiment.structures import make_structure

TRUE = {
    "friction_slide": {"K_t": 12.0, "F_c": 5.0, "F_s": 7.5, "v_s": 0.03, "F_v": 14.0},
    "two_tanks": {"k": 1.6e-3, "a_1": 0.018, "a_2": 0.014},
    "active_magnetic_bearing": {"s_0": 0.4e-3, "c": 2.4e-6, "d": 1.5},
}


@pytest.mark.parametrize("machine", TRUE)
def test_the_recordings_of_a_machine_give_its_parameters(machine):
    experiment = load_experiment(share_folder("experiments") / machine / "experiment.yaml")
    (name,) = experiment.spec.fits
    result = gbid.fit(make_structure(experiment, name), read_import(experiment, experiment.recordings["run2"]))
    assert result.success
    assert result.trusted == "white"
    assert np.abs(result.integration_shift).max() < 0.1
    for name, true in TRUE[machine].items():
        assert abs(result.parameters[name] - true) < 4 * result.std[name]
    other = read_import(experiment, experiment.recordings["run1"])
    assert gbid.check_residuals(result, other).white.all()  # from an initial state that is found among many minima
