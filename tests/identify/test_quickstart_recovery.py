"""The published machine on the virtual rig, identified end to end at the point of Fig. 7: 5 bar, 6000 rpm."""

import numpy as np
import pytest

from gbid import identify_runout, load_model
from gbid.identify import fit
from gbid.prefilter import prefilter
from gbid.rig import Machine, Prbs, Stationary, record
from gbid.structure import KEY_PARAMETERS, PiezoPair, Plant, RotorBearing
from gbid.validate import cross_validate

POINT = {"pressure_bar": 5.0, "speed_rpm": 6000.0}
MODEL = load_model("theisen2016")
TRUTH = MODEL.key_parameters(**POINT)
ACTUATORS = MODEL.actuators


def machine():
    return Machine.from_parameters(TRUTH, ACTUATORS)


@pytest.fixture(scope="module")
def recordings():
    """One recording with still piezos, two with independent PRBS."""
    experiments = {"still": Stationary(), "one": Prbs(2.5), "two": Prbs(2.5)}
    rig = machine()
    return [record(rig, e, conditions=POINT, seed=1, name=name) for name, e in experiments.items()]


@pytest.fixture(scope="module")
def filtered(recordings):
    still, *prbs = recordings
    runout = identify_runout(still)
    return [prefilter(rec, runout)[0] for rec in prbs]


@pytest.fixture(scope="module")
def bearings(filtered):
    return [fit(RotorBearing(), rec) for rec in filtered]


@pytest.mark.parametrize("which", [0, 1])
def test_key_parameters_delays_and_modes(bearings, which):
    result = bearings[which]
    assert result.success
    for name in KEY_PARAMETERS:
        error = abs(result.parameters[name] - TRUTH[name])
        assert error <= max(0.1 * abs(TRUTH[name]), 3 * result.std[name]), name
        assert np.isfinite(result.std[name])
    for name in ("tau_x", "tau_y"):
        assert result.parameters[name] == pytest.approx(TRUTH[name], abs=0.05e-3)
    computed, expected = result.model.modes()[:2], MODEL.at(**POINT).modes()[:2]
    for (frequency, damping), (f, z) in zip(computed, expected, strict=True):
        assert frequency == pytest.approx(f, abs=0.3)
        assert damping == pytest.approx(z, abs=0.003)
    np.testing.assert_allclose(result.model.static_gain(), MODEL.at(**POINT).static_gain(), atol=0.005)


def test_each_model_explains_the_other_recording(bearings, filtered):
    for result, other in zip(bearings, reversed(filtered), strict=True):
        validation = cross_validate(result, other)
        assert validation.recording != validation.fitted_to[0]
        assert validation.fit_percent.min() > 90


def test_actuators(filtered):
    result = fit(PiezoPair(), filtered[0])
    assert result.success
    for name, truth in ACTUATORS.items():
        assert abs(result.parameters[name] - truth) < 5 * result.std[name], name
        assert result.parameters[name] == pytest.approx(truth, rel=0.01), name
    assert cross_validate(result, filtered[1]).fit_percent.min() > 90


def test_the_plant_in_one_has_no_bias(recordings):
    """Held references, a third-order delay and no median: the truth within five standard deviations."""
    still, rec, _ = recordings
    unmedianed, _ = prefilter(rec, identify_runout(still), median=1)
    result = fit(Plant(RotorBearing(pade_order=3)), unmedianed.slice(0, 5000))
    assert result.success
    for name, truth in {**TRUTH, **ACTUATORS}.items():
        assert abs(result.parameters[name] - truth) < 5 * result.std[name], name
    assert result.fit_percent.min() > 98
