"""Run-out under a controller: filtered before it online, or after the recording with the answers of the loop."""

import numpy as np
import pytest
from rig_point import machine

from gbid.control import p_controller
from gbid.control.loop.close import sample_controller
from gbid.core.errors import DataError
from gbid.prefilter.filtering import OnlinePrefilter, prefilter
from gbid.prefilter.runout_identification import identify_runout
from gbid.rig import Prbs, ProgramController, SampledController, SensorChain, Stationary, record

TS = 2e-4
AT = {"pressure_bar": 5.0, "speed_rpm": 6000.0}
LAW = sample_controller(p_controller(1.125, 0.99), TS)
RIG = machine(sensors=SensorChain(noise_p_m=1e-10, noise_u_m=1e-10, encoder_counts=None))


def made(experiment, controller=None, name="run"):
    return record(RIG, experiment, conditions=AT, seed=3, name=name, controller=controller, settle_s=0.2)


class Filtered:
    """The controller behind the online filter, which keeps what it saw."""

    def __init__(self, runout_map):
        self.filter, self.state, self.seen = OnlinePrefilter(runout_map), np.zeros(LAW.n_states), []

    def references(self, position, angle, *_):
        p = self.filter.step(position, angle)
        self.seen.append(p)
        r = LAW.C @ self.state + LAW.D @ p
        self.state = LAW.A @ self.state + LAW.B @ p
        return r


def test_online_and_offline_filter_show_the_same_motion():
    """The controller acts on the motion alone in one loop, and on run-out and unbalance as well in the other."""
    open_map = identify_runout(made(Stationary(0.2)), harmonics=6)
    program = Filtered(open_map)
    online, report = prefilter(
        made(Prbs(0.2, 2e-6), ProgramController(program, TS)), open_map, spikes=False, remove_mean=False
    )
    np.testing.assert_array_equal(online.signal("p"), program.seen[-online.n_samples :])  # the same filter
    assert (report.runout_share > 0.01).all()

    answering = SampledController(LAW.A, LAW.B, LAW.C, LAW.D, TS)
    still, raw = made(Stationary(0.2), answering, "still"), made(Prbs(0.2, 2e-6), answering)
    with pytest.raises(DataError, match="for a recording in closed loop, see in_loop"):
        identify_runout(still)
    maps = {s: identify_runout(still, harmonics=6, signal=s, in_loop=True) for s in "rup"}
    offline, _ = prefilter(raw, maps.pop("p"), answers=maps, spikes=False, remove_mean=False)
    assert np.abs(raw.signal("r") - raw.signal("w")).max() > 1e-6  # the loop answers to run-out
    for signal in "rup":
        shifted = online.signal(signal) - online.signal(signal).mean(axis=0)
        same = offline.signal(signal) - offline.signal(signal).mean(axis=0)
        assert np.abs(same - shifted).max() < 1e-4 * np.abs(shifted).max()
        assert (
            np.abs(raw.signal(signal) - raw.signal(signal).mean(axis=0) - shifted).max() > 0.1 * np.abs(shifted).max()
        )


def test_answers_that_do_not_fit_are_refused():
    answering = SampledController(LAW.A, LAW.B, LAW.C, LAW.D, TS)
    moving = made(Prbs(0.1), answering)
    with pytest.raises(DataError, match="w_x moves"):
        identify_runout(moving, in_loop=True)
    still = identify_runout(made(Stationary(0.2), answering, "still"), harmonics=3, signal="r", in_loop=True)
    with pytest.raises(DataError, match="answers names 'v'"):
        prefilter(moving, answers={"v": still})
