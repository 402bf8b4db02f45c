"""Data with which a fit converges and is wrong are named: units, twins, spikes, inputs that are nearly the same."""

import numpy as np
import pytest
from scipy.linalg import expm

import gbid
from gbid.identify.data_notes import data_notes
from gbid.identify.options import FitArguments
from gbid.identify.pose import pose
from gbid.recording.quality import stays_at_limits

H = 2e-4


def disc(seed, n=4000, micrometre=1e-6, second=None):
    """A disc on two springs, driven by held steps: exact steps of 0.2 ms, without gbid. In metres."""
    random = np.random.default_rng(seed)
    u = np.repeat(random.choice([-5.0, 5.0], (n // 20, 2)), 20, axis=0) * micrometre
    if second is not None:
        u[:, 1] = u[:, 0] + second * u[:, 1]
    w, d = 2 * np.pi * 120, 50.0
    step = expm(H * np.array([[0, 1, 0], [-w * w, -d, w * w], [0, 0, 0]]))
    x, p = np.zeros((2, 2)), np.zeros((n, 2))
    for i in range(n):
        p[i] = x[0]
        x = step[:2, :2] @ x + np.outer(step[:2, 2], u[i])
    return u, p + 0.05 * micrometre * random.normal(size=p.shape)


MODEL = gbid.load_model("theisen2016")
PLANT_AT = {**MODEL.key_parameters(5.0, 0.0), **MODEL.actuators}


def recording(u, p, name="run"):
    return gbid.Recording({"u": u, "p": p}, H, name=name)


def codes(result):
    return {code for note in result.notes for code in ("GB133", "GB134", "GB135", "GB136", "GB143") if code in note}


def bearing(*recordings):
    return gbid.fit(gbid.RotorBearing(disturbance_gain="none"), recordings, focus="simulation", max_iterations=3)


@pytest.mark.parametrize("seed", range(3))
def test_good_data_have_no_note(seed):
    assert not codes(bearing(recording(*disc(seed), "one"), recording(*disc(seed + 10), "two")))


@pytest.mark.parametrize("factor", [1e6, 1e3])
@pytest.mark.parametrize("wrong", ["u", "p", "up"])
def test_micrometres_and_millimetres_are_no_metres(wrong, factor):
    signals = {name: values * (factor if name in wrong else 1.0) for name, values in zip("up", disc(0), strict=True)}
    assert codes(bearing(recording(**signals))) == {"GB133"}


@pytest.mark.parametrize("factor", [1e6, 1e3])
@pytest.mark.parametrize("wrong", ["r", "u", "p", "ru", "rp", "up", "rup", ""])
def test_each_motion_of_a_plant_counts(wrong, factor):
    """Piezos without dynamics: u follows r."""
    u, p = disc(0)
    noisy = u + 1e-8 * np.random.default_rng(1).normal(size=u.shape)
    signals = {name: v * (factor if name in wrong else 1.0) for name, v in {"r": u, "u": noisy, "p": p}.items()}
    task = pose(gbid.Plant(), gbid.Recording(signals, H), FitArguments(start=PLANT_AT))
    assert ("GB133" in " ".join(data_notes(task))) == bool(wrong)


@pytest.mark.parametrize("outputs", [("p",), ("i", "p")])
@pytest.mark.parametrize(("factor", "told"), [(1e6, True), (1e3, True), (1.0, False)])
def test_positions_in_magnetic_bearings_are_in_metres(outputs, factor, told):
    rotor = gbid.structure.RigidRotor(k_s=-5e5, k_i=3.0)
    structure = rotor if outputs == ("p",) else gbid.MagneticBearing(rotor, outputs=outputs)
    u, p = disc(0)
    current = 1e6 * u[:, :1]
    rec = gbid.Recording({"i": current, "i_ref": current, "p": factor * p[:, :1]}, H)
    assert ("GB133" in " ".join(data_notes(pose(structure, rec, FitArguments())))) == told


def test_the_same_recording_twice_is_named():
    u, p = disc(0)
    computed = codes(bearing(recording(u, p, "one"), recording(u.copy(), p.copy(), "two")))
    assert computed == {"GB134"}
    again = disc(0)[1] + 1e-9
    assert not codes(bearing(recording(u, p, "one"), recording(u, again, "two")))


@pytest.mark.parametrize(("width", "height", "told"), [(1, 1000, True), (3, 200, True), (30, 200, False)])
def test_a_spike_is_named_and_a_blow_is_not(width, height, told):
    """A blow that rings for 30 samples is a response."""
    u, p = disc(0)
    ring = np.exp(-np.arange(width) / (width / 3)) if width > 3 else np.ones(width)
    p[1000 : 1000 + width, 1] += height * p[:, 1].std() * ring
    spiked = recording(u, p)
    assert ("GB135" in codes(bearing(spiked))) == told
    kept = gbid.fit(
        gbid.RotorBearing(disturbance_gain="none"),
        spiked,
        focus="simulation",
        max_iterations=3,
        left_out={"run": [(995, 1005)]},
    )
    assert "GB135" not in codes(kept)


@pytest.mark.parametrize(("second", "told"), [(1e-4, True), (0.1, False)])
def test_two_inputs_that_are_nearly_the_same_are_named(second, told):
    assert ("GB136" in codes(bearing(recording(*disc(0, second=second))))) == told


@pytest.mark.parametrize(("late", "told"), [(0, False), (1, False), (15, True)])
def test_an_output_that_answers_before_its_cause_is_named(late, told):
    u, p = disc(0)
    result = bearing(recording(u[: len(u) - late], p[late:]))
    assert ("GB143" in codes(result)) == told


def test_a_ship_may_move_by_metres():
    """Only the structures of the paper know how far a disc moves."""
    structure = gbid.LinearStructure(
        "ship",
        [gbid.Parameter("k", 5e5), gbid.Parameter("d", 40.0)],
        lambda p: {"A": [[0, 1], [-p.k, -p.d]], "B": [[0], [p.k]], "C": [[1, 0]]},
        "u.x",
        "p.x",
    )
    u, p = disc(0)
    result = gbid.fit(structure, recording(1e6 * u, 1e6 * p), focus="simulation")
    assert result.success
    assert not codes(result)


def test_a_clipped_output_is_named():
    u, p = disc(0)
    p[:, 1] = np.clip(p[:, 1], None, 0.4 * p[:, 1].max())
    (note,) = [note for note in bearing(recording(u, p)).notes if "GB209" in note]
    assert "'p_y' is clipped" in note


def test_a_quantised_step_response_that_settles_is_not_clipped():
    t = H * np.arange(4000)
    settled = 1e-5 * (1 - np.exp(-np.mod(t, 0.2) / 0.01))
    for quantum in (1e-12, 1e-8, 1e-7):
        column = np.round(settled / quantum) * quantum
        assert not stays_at_limits(column)
    assert list(stays_at_limits(np.clip(settled, None, 0.8e-5))) == [0.8e-5]
