"""Static characterisation against closed forms, brute force, coverage, and the virtual rig."""

from dataclasses import replace

import numpy as np
import pytest
from rig_point import machine
from scipy.signal import lfilter
from scipy.stats import binom, linregress

from gbid.core.errors import DataError, UsageError
from gbid.prefilter import (
    characterise_piezo,
    characterise_staircase,
)
from gbid.prefilter.staircase import find_plateaus, steady_means
from gbid.recording import Recording
from gbid.rig import PiezoStacks, StackStaircase, Staircase, record

TS = 2e-4
GAIN = np.array([[0.25, 0.01], [-0.02, 0.29]])
OFFSET = np.array([2e-6, -3e-6])


def stairs(axis, n=10, amplitude=9e-6, hold=600):
    up = np.linspace(-amplitude, amplitude, n)
    levels = np.array([0, *up, *up[-2::-1], 0])
    r = np.zeros((len(levels) * hold, 2))
    r[:, axis] = np.repeat(levels, hold)
    return r


def synthetic(axis, seed=0, noise=100e-9, pole=0.9, cubic=0.0, hold=600):
    """Linear film with settled dynamics and correlated noise; the true gain is GAIN."""
    rng = np.random.default_rng(seed)
    r = stairs(axis, hold=hold)
    u = lfilter([0.3], [1, -0.7], 1.86 * r, axis=0) + np.array([0.5e-6, -0.3e-6])
    p = lfilter([0.1], [1, -0.9], u @ GAIN.T + cubic * (u / 17e-6) ** 3, axis=0) + OFFSET
    p[:100] = p[100]
    coloured = lfilter([np.sqrt(1 - pole**2)], [1, -pole], rng.standard_normal((len(p) + 500, 2)), axis=0)[500:]
    return Recording(
        {"r": r, "u": u + 1e-9 * rng.standard_normal(u.shape), "p": p + noise * coloured},
        TS,
        {"pressure_bar": 6.0, "speed_rpm": 0.0},
        f"stairs_{'xy'[axis]}{seed}",
        units={"r": "m", "u": "m", "p": "m"},
    )


# ---- plateaus and branches ----


def test_plateaus_are_found_and_passages_left_out():
    r = np.concatenate([np.full(200, 0.0), np.linspace(0, 1, 50), np.full(300, 1.0), np.full(150, 2.0)])[:, None]
    plateaus = find_plateaus(Recording({"r": r}, TS), "r")
    assert list(zip(plateaus.start, plateaus.stop, strict=True))[1:] == [(249, 550), (550, 700)]
    assert plateaus.level[:, 0].tolist() == [0.0, 1.0, 2.0]


def test_drift_is_in_the_standard_error():
    ramp = np.linspace(0, 1.0, 1000)[:, None] + 1e-3 * np.random.default_rng(1).standard_normal((1000, 1))
    means = steady_means(ramp, [(0, 1000)])
    assert means.drift[0, 0] == pytest.approx(1.0, rel=0.01)
    assert means.std_error[0, 0] > 0.5


@pytest.mark.parametrize(("size", "counts"), [(3.9, False), (4.1, True)])
def test_a_drift_counts_from_four_standard_deviations_of_its_slope(size, counts):
    time = np.arange(10) - 4.5  # of ten batches
    lines = np.column_stack([np.ones(10), time])
    rest = np.random.default_rng(1).standard_normal(10)
    rest -= lines @ np.linalg.lstsq(lines, rest)[0]
    slope = size * np.sqrt(rest @ rest / 8 / (time @ time))
    batches = slope * time + rest
    means = steady_means(np.repeat(batches, 7)[:, None], [(0, 70)])
    assert means.std_error[0, 0] == pytest.approx(np.sqrt(batches.var(ddof=1) / 10 + (counts * 5 * slope) ** 2))


# ---- the static map ----


def test_gain_and_offset_come_back_from_x_and_y_staircases():
    staircase = characterise_staircase([synthetic(0), synthetic(1, 1)])
    assert (np.abs(staircase.gain - GAIN) < 4 * staircase.gain_std).all()
    assert staircase.gain_std.max() < 1e-3
    np.testing.assert_allclose(staircase.offset, [OFFSET, OFFSET], atol=20e-9)
    assert (staircase.dof, staircase.input_names, staircase.output_names) == (38, ("u_x", "u_y"), ("p_x", "p_y"))
    # what noise gives: no evidence of hysteresis nor of a curve
    assert (staircase.hysteresis < 4 * staircase.hysteresis_std).all()
    assert staircase.largest.max() < 100e-9


def test_one_axis_alone_agrees_with_a_straight_line():
    staircase = characterise_staircase(synthetic(0))
    for output in (0, 1):
        line = linregress(staircase.input_mean[:, 0], staircase.output_mean[:, output])
        assert staircase.gain[output, 0] == pytest.approx(line.slope, rel=1e-9)
        assert staircase.gain_std[output, 0] >= 0.999 * line.stderr
    assert np.isnan(staircase.gain[:, 1]).all()
    assert np.isnan(staircase.rms[:, 1]).all()
    assert staircase.notes == ("no recording moves u_y, so its gains are not known [GB207]",)


@pytest.mark.parametrize("seeds", [40, pytest.param(400, marks=pytest.mark.slow)])
def test_intervals_cover_the_truth(seeds):
    """Each of the four as often as chance allows one in a thousand of 95 %; all four, which hang together, likewise."""
    hits = []
    for seed in range(seeds):
        interval = characterise_staircase([synthetic(axis, 2 * seed + axis, hold=300) for axis in (0, 1)]).interval()
        hits.append((interval[..., 0] < GAIN) & (interval[..., 1] > GAIN))
    cover = np.mean(hits, axis=0)
    assert cover.min() >= binom.ppf(1e-3, seeds, 0.95) / seeds
    assert 0.93 <= cover.mean() <= 0.99


def test_deviations_from_linear_are_those_of_a_known_curve():
    cubic = 2e-6
    staircase = characterise_staircase([synthetic(0, cubic=cubic, noise=1e-12), synthetic(1, cubic=cubic, noise=1e-12)])
    first_recording = staircase.recording == 0
    u = staircase.input_mean[first_recording, 0]
    line = linregress(u, cubic * (u / 17e-6) ** 3)
    rest = cubic * (u / 17e-6) ** 3 - line.intercept - line.slope * u
    assert staircase.rms[0, 0] == pytest.approx(np.sqrt(np.mean(rest**2)), rel=1e-3)
    assert staircase.largest[0, 0] == pytest.approx(np.abs(rest).max(), rel=1e-3)
    assert staircase.rms[1, 0] < 1e-9
    assert staircase.hysteresis.max() < 20e-9
    panel = staircase.panel(0, 0)
    np.testing.assert_allclose(
        panel["output"] - staircase.gain[0, 0] * panel["input"], staircase.residual[first_recording, 0]
    )


def test_hysteresis_of_the_bearing_is_found():
    rec = synthetic(0, noise=10e-9)
    rising = np.sign(np.diff(rec.signal("r")[:, 0], prepend=0.0))
    direction = np.where(rising == 0, np.nan, rising)
    filled = np.maximum.accumulate(np.where(np.isnan(direction), 0, np.arange(len(direction))))
    lag = 0.3e-6 * np.nan_to_num(direction[filled])
    staircase = characterise_staircase(rec.with_signals(p=rec.signal("p") - np.column_stack([lag, 0 * lag])))
    assert staircase.hysteresis[0, 0] == pytest.approx(0.6e-6, rel=0.1)
    assert staircase.hysteresis[1, 0] < 0.03e-6


def test_run_out_does_not_show_in_the_means():
    rec = synthetic(0, noise=1e-12)
    angle = 2 * np.pi * 97.3 * rec.time + 0.3
    p = rec.signal("p") + 4e-6 * np.column_stack([np.cos(angle), np.sin(angle)])
    turning = rec.with_signals(p=p, phi=np.mod(angle, 2 * np.pi)[:, None])
    staircase = characterise_staircase(turning)
    np.testing.assert_allclose(staircase.gain[:, 0], GAIN[:, 0], atol=2e-5)
    assert staircase.rms[0, 0] < 1e-9


@pytest.mark.parametrize("speed", [0.0, 6000.0])
def test_rig_staircases_give_the_models_static_gain(speed):
    made = machine(6.0, speed)
    bearing = made.rotor_bearing
    truth = -np.linalg.solve(bearing.stiffness, bearing.input_gain)
    conditions = {"pressure_bar": 6.0, "speed_rpm": speed}
    group = [
        record(made, Staircase(axis, hold_s=0.3), conditions=conditions, seed=2, name=f"stairs {axis}") for axis in "xy"
    ]
    staircase = characterise_staircase(group)
    interval = staircase.interval(0.99)
    assert ((interval[..., 0] < truth) & (truth < interval[..., 1])).all()
    assert staircase.gain_std.max() < 1e-3


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda rec: characterise_staircase([]), UsageError, "at least one"),
        (lambda rec: characterise_staircase(rec, keep=0.0), UsageError, "keep = 0"),
        (lambda rec: characterise_staircase(rec, keep=0.01), DataError, "steady samples"),
        (lambda rec: characterise_staircase(rec, command="v"), DataError, "no signal 'v'"),
        (
            lambda rec: characterise_staircase(rec.with_signals(r=0 * rec.signal("r"))),
            DataError,
            "is constant; a staircase",
        ),
        (
            lambda rec: characterise_staircase(
                rec.with_signals(
                    r=rec.signal("r") + 1e-7 * np.random.default_rng(1).standard_normal((len(rec.time), 2))
                )
            ),
            DataError,
            "not a noisy measurement",
        ),
        (
            lambda rec: characterise_staircase([rec, replace(rec, conditions={"pressure_bar": 5.0})]),
            DataError,
            "different conditions",
        ),
        (
            lambda rec: characterise_staircase(
                rec.with_signals(u=np.repeat(rec.signal("u")[:, :1], 2, 1), r=np.repeat(rec.signal("r")[:, :1], 2, 1))
            ),
            DataError,
            "do not determine",
        ),
        (lambda rec: characterise_staircase(rec).interval(1.0), UsageError, "level"),
    ],
)
def test_bad_staircases_are_named(call, error, words):
    with pytest.raises(error, match=words):
        call(synthetic(0))


# ---- piezos ----


def loop(hysteresis=8.4e-6, n=10, hold=500, creep=0.0, top=45e-6, noise=0.0):
    """Voltage staircase with a parabolic loop of known width and logarithm-free creep: an exponential per step."""
    levels = np.concatenate([np.linspace(0, 10, n + 1), np.linspace(10, 0, n + 1)[1:]])
    x = levels / 10
    rising = np.arange(len(levels)) <= n
    static = top * x + np.where(rising, -1, 1) * hysteresis / 2 * 4 * x * (1 - x)
    v, y = np.repeat(levels, hold), np.repeat(static, hold)
    step = np.repeat(np.diff(static, prepend=static[0]), hold)
    since = np.tile(np.arange(hold), len(levels)) * TS
    slow = 1 - np.exp(-(since) / 0.05)
    y = y - step * np.exp(-since / 1e-3) + creep * step * (slow - 1)
    y = y + noise * np.random.default_rng(2).standard_normal(len(y))
    channels, units = {"v": ("4",), "y_p": ("4",)}, {"v": "V", "y_p": "m"}
    return Recording({"v": v[:, None], "y_p": y[:, None]}, TS, name="stack 4", channels=channels, units=units)


def test_hysteresis_of_a_known_loop():
    curve = characterise_piezo(loop(noise=5e-9), command="v", position="y_p")
    assert curve.hysteresis == pytest.approx(8.4e-6, rel=0.01)
    assert curve.hysteresis_at == pytest.approx(5.0)
    assert curve.hysteresis_share == pytest.approx(8.4 / 45, rel=0.01)
    assert curve.command.tolist()[:3] == [0.0, 1.0, 2.0]
    assert curve.direction.tolist() == [0] + 10 * [1] + 10 * [-1]
    assert not curve.saturated.any()
    assert curve.channel == "y_p_4"


def test_creep_is_the_share_of_the_step():
    creep = 0.04
    curve = characterise_piezo(loop(hysteresis=0.0, creep=creep), command="v", position="y_p", settle_s=0.01)
    # from early (10 ms and a tenth of the rest later) to the end (likewise), by the exponential's own means
    width = max(40, round(0.1 * (500 - 50)))
    t = np.arange(500) * TS
    response = 1 - np.exp(-t / 1e-3) + creep * (1 - np.exp(-t / 0.05) - 1)
    early, delayed = response[50 : 50 + width].mean(), response[-width:].mean()
    # the step before has crept to its own end, which the next one starts from
    before = 1 - (response[-width:].mean() - creep * 0)
    expected = (delayed - early) / (early + before)
    np.testing.assert_allclose(curve.creep[1:10], expected, rtol=1e-3)


def test_uniform_steps_and_their_responses():
    curve = characterise_piezo(loop(hysteresis=0.0), command="v", position="y_p")
    assert curve.uniformity < 1e-6
    np.testing.assert_allclose(curve.step_gain, 4.5e-6, rtol=1e-6)
    assert curve.responses.shape == (500, 20)
    np.testing.assert_allclose(curve.responses[0], 0, atol=1e-11)
    np.testing.assert_allclose(curve.responses[-1], 4.5e-6 * np.sign(curve.step), rtol=1e-5)
    assert curve.response_time[1] == TS


def test_a_level_that_is_held_twice_has_no_gain_of_its_step():
    rec = loop(hysteresis=0.0)
    v = np.array(rec.signal("v"))
    v[2700:2710] += 1.0  # a short peak on the sixth level
    curve = characterise_piezo(rec.with_signals(v=v), command="v", position="y_p")
    assert np.flatnonzero(np.isnan(curve.step_gain)).tolist() == np.flatnonzero(curve.step == 0).tolist() == [5]
    np.testing.assert_allclose(np.delete(curve.step_gain, 5), 4.5e-6, rtol=1e-6)
    assert curve.uniformity < 1e-6


def test_used_up_travel_is_named_and_not_counted_as_uneven():
    rec = loop(hysteresis=0.0)
    limited = rec.with_signals(y_p=np.minimum(rec.signal("y_p"), 42e-6))
    curve = characterise_piezo(limited, command="v", position="y_p")
    assert np.flatnonzero(curve.saturated).tolist() == [9, 10]
    assert "saturated: step 10, 11 of 20" in curve.notes[0]
    assert curve.uniformity < 1e-6
    known = characterise_piezo(limited, command="v", position="y_p", limits=(0.0, 42e-6))
    assert np.flatnonzero(known.saturated).tolist() == [0, 9, 10, 19]  # the rest at zero is an end as well


def test_one_way_staircase_knows_nothing_of_hysteresis():
    rec = loop().slice(0, 11 * 500)
    curve = characterise_piezo(rec, command="v", position="y_p")
    assert np.isnan(curve.hysteresis)
    assert "one direction only" in curve.notes[-1]


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda rec: characterise_piezo(rec), DataError, "no signal 'r'"),
        (lambda rec: characterise_piezo(rec, command="v", position="y_p", channel="2"), UsageError, "no channel '2'"),
        (lambda rec: characterise_piezo(rec, command="v", position="y_p", settle_s=0.09), UsageError, "too little"),
        (
            lambda rec: characterise_piezo(rec, command="v", position="y_p", limits=(1, 0)),
            UsageError,
            "lower end first",
        ),
        (
            lambda rec: characterise_piezo(rec.with_signals(y_p=0 * rec.signal("y_p")), command="v", position="y_p"),
            DataError,
            "does not respond to",
        ),
    ],
)
def test_bad_piezo_staircases_are_named(call, error, words):
    with pytest.raises(error, match=words):
        call(loop())


def test_rig_stack_open_loop_and_controlled():
    """Fig. A.28: 8.4 um open loop, next to nothing under PD control; Fig. A.29: uniform steps under control."""
    made = replace(machine(6.0, 0.0), actuator=PiezoStacks())
    conditions = {"pressure_bar": 6.0, "speed_rpm": 0.0}
    results = {}
    for controlled in (False, True):
        rec = record(
            made, StackStaircase(4, controlled, hold_s=0.3), conditions=conditions, seed=1, name="stack", settle_s=0.2
        )
        command = "r_p" if controlled else "v"
        results[controlled] = characterise_piezo(rec, command=command, position="y_p", channel="4")
    assert results[False].hysteresis == pytest.approx(8.4e-6, rel=0.05)
    assert results[True].hysteresis < 0.1 * results[False].hysteresis
    assert results[True].uniformity < 0.5 * results[False].uniformity
    assert 0.001 < np.median(results[False].creep) < 0.1


# ---- rows ----


def test_rows_are_one_for_each_plateau_with_units():
    rows = characterise_staircase(synthetic(0)).rows()
    assert len(rows) == 21
    assert {"recording", "u_x [m]", "u_x_std [m]", "p_y [m]", "p_y_residual [m]"} <= set(rows[0])
    rows = characterise_piezo(loop(), command="v", position="y_p").rows()
    assert {"command [V]", "y_p_4 [m]", "creep", "saturated"} <= set(rows[0])
