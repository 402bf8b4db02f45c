"""The virtual rig against closed forms, brute force and statistics."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rig_point import BARE, actuator, machine, rotor_bearing
from scipy.integrate import solve_ivp

from gbid.core.errors import UsageError
from gbid.lpv import load_model
from gbid.rig import FilmStiffening, Machine, Prbs, RotorBearingTruth, SensorChain, Stationary, Unbalance, record
from gbid.rig.response import driven_motion, unbalance_orbit
from gbid.rig.sensors import encoder_angle

TS = 2e-4
FIG7 = {"pressure_bar": 5.0, "speed_rpm": 6000.0}


def steps(n_samples, hold=5, seed=3):
    levels = np.random.default_rng(seed).choice([-4.5e-6, 4.5e-6], (n_samples // hold + 1, 2))
    return np.repeat(levels, hold, axis=0)[:n_samples]


def with_delay(tau) -> RotorBearingTruth:
    return replace(rotor_bearing(), delay=np.asarray(tau, float))


# ---- exactness ----


def brute_force(truth, piezos, reference, n_fine):
    """Actuators, then rotor with u(t - tau) read from their dense solution, by an adaptive integrator."""
    tight = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-18, "dense_output": True}
    end = len(reference) * TS
    pieces = []
    for axis in range(2):
        slow, fast, gain = piezos.slow_pole[axis], piezos.fast_pole[axis], piezos.gain[axis]
        state, parts = np.zeros(2), []
        for k, row in enumerate(reference):
            part = solve_ivp(
                lambda _, s, r=row[axis], p1=slow, p2=fast, g=gain: [p1 * (g * r - s[0]), p2 * (s[0] - s[1])],
                (k * TS, (k + 1) * TS),
                state,
                **tight,
            )
            parts.append(part.sol)
            state = part.y[:, -1]
        pieces.append(parts)

    def u(axis, t):
        return pieces[axis][min(int(t / TS), len(reference) - 1)](t)[1] if t > 0 else 0.0

    def rotor(t, s):
        delayed = np.array([u(axis, t - truth.delay[axis]) for axis in range(2)])
        return np.concatenate([s[2:], truth.stiffness @ s[:2] + truth.damping @ s[2:] + truth.input_gain @ delayed])

    # the integrator restarts wherever the delayed input has a kink
    kinks = sorted({k * TS + tau for k in range(len(reference)) for tau in (0.0, *truth.delay)} | {0.0, end})
    kinks = [t for t in kinks if t <= end]
    fine = np.arange(n_fine) * end / n_fine
    p, state = np.zeros((n_fine, 2)), np.zeros(4)
    for a, b in pairwise(kinks):
        part = solve_ivp(rotor, (a, b), state, **tight)
        inside = (fine >= a) & (fine <= b)
        if inside.any():
            p[inside] = part.sol(fine[inside])[:2].T
        state = part.y[:, -1]
    return np.array([[u(axis, t) for axis in range(2)] for t in fine]), p


def test_motion_matches_an_adaptive_integration_of_the_delay_equation():
    reference = steps(20)
    motion = driven_motion(rotor_bearing(), actuator(), reference, TS, 20)
    u, p = brute_force(rotor_bearing(), actuator(), reference, len(motion.time))
    assert np.abs(motion.p).max() > 1e-6
    np.testing.assert_allclose(motion.u, u, rtol=0, atol=1e-14)
    np.testing.assert_allclose(motion.p, p, rtol=0, atol=1e-14)


def test_constant_references_end_at_the_static_gain():
    reference = np.tile([2e-6, -1e-6], (10_000, 1))
    motion = driven_motion(rotor_bearing(), actuator(), reference, TS)
    u = actuator().gain * reference[0]
    truth = rotor_bearing()
    np.testing.assert_allclose(motion.u[-1], u, rtol=1e-12)
    np.testing.assert_allclose(motion.p[-1], -np.linalg.solve(truth.stiffness, truth.input_gain @ u), rtol=1e-9)


@pytest.mark.parametrize(
    ("tau", "oversampling"), [(3 * TS, 20), (7 / 20 * TS, 20), (29 / 24 * TS, 24), (1 / 37 * TS, 37)]
)
def test_a_delay_shifts_the_motion_by_exactly_itself(tau, oversampling):
    reference = steps(200)
    later = driven_motion(with_delay([tau, tau]), actuator(), reference, TS, oversampling).p
    now = driven_motion(with_delay([0, 0]), actuator(), reference, TS, oversampling).p
    shift = round(tau / TS * oversampling)
    np.testing.assert_allclose(later[shift:], now[:-shift], rtol=0, atol=1e-17)
    assert not later[:shift].any()


def test_equal_actuator_poles_are_no_special_case():
    equal = replace(actuator(), slow_pole=[3000.0, 3000.0], fast_pole=[3000.0, 3000.0])
    near = replace(actuator(), slow_pole=[3000.0, 3000.0], fast_pole=[3000.001, 3000.001])
    a, b = (driven_motion(rotor_bearing(), poles, steps(100), TS).p for poles in (equal, near))
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-11)


def test_unbalance_orbit_is_a_solution_that_repeats():
    truth, unbalance, speed = rotor_bearing(), Unbalance(), 200 * np.pi

    def rotor(t, s):
        angle = speed * t + 0.4 + unbalance.phase_rad
        force = unbalance.eccentricity_m * speed**2 * np.array([np.cos(angle), np.sin(angle)])
        return np.concatenate([s[2:], truth.stiffness @ s[:2] + truth.damping @ s[2:] + force])

    time = np.linspace(0, 0.02, 30)
    orbit = unbalance_orbit(truth, unbalance, speed, speed * time + 0.4)
    before, after = unbalance_orbit(truth, unbalance, speed, 0.4 + speed * np.array([-1e-6, 1e-6]))
    start = np.concatenate([orbit[0], (after - before) / 2e-6])
    solution = solve_ivp(rotor, (0, 0.02), start, t_eval=time, method="DOP853", rtol=1e-9, atol=1e-15)
    assert 2e-6 < np.hypot(*orbit.T).max() < 5e-6
    np.testing.assert_allclose(orbit, solution.y[:2].T, rtol=0, atol=1e-13)


# ---- recordings ----


def test_recording_without_sensor_faults_is_the_true_motion():
    still = machine(unbalance=Unbalance(eccentricity_m=0.0), sensors=BARE)
    rec = record(still, Prbs(duration_s=0.4), conditions=FIG7, seed=1, name="a", settle_s=0.0)
    motion = driven_motion(still.rotor_bearing, still.actuator, rec.signal("r"), TS)
    np.testing.assert_array_equal(rec.signal("u"), motion.u[::20])
    np.testing.assert_array_equal(rec.signal("p"), motion.p[::20])
    np.testing.assert_allclose(np.diff(np.unwrap(rec.signal("phi")[:, 0])), 2 * np.pi * 100 * TS)


def test_recording_has_noise_offsets_and_a_running_start():
    rec = record(machine(), Prbs(duration_s=1.0), conditions=FIG7, seed=1, name="a")
    clean = record(replace(machine(), sensors=BARE), Prbs(duration_s=1.0), conditions=FIG7, seed=1, name="a")
    np.testing.assert_array_equal(rec.signal("r"), clean.signal("r"))
    noise = rec.signal("u") - clean.signal("u")
    np.testing.assert_allclose(noise.mean(axis=0), [0.5e-6, -0.3e-6], atol=1e-9)
    np.testing.assert_allclose(noise.std(axis=0), 10e-9, rtol=0.05)
    assert np.abs(clean.signal("u")[0]).min() > 1e-6
    assert rec.n_samples == 5000
    assert dict(rec.conditions) == FIG7
    assert json.loads(rec.provenance["rig"])["actuator"]["gain"] == [1.863, 1.865]
    assert rec.provenance["seed"] == "1"


def test_run_out_of_y_is_that_of_x_a_quarter_turn_later():
    quiet = SensorChain(noise_p_m=0.0, offset_p_m=(0, 0), encoder_counts=None)
    rec = record(
        machine(sensors=quiet, unbalance=Unbalance(eccentricity_m=0)),
        Stationary(duration_s=0.2),
        conditions={"pressure_bar": 5.0, "speed_rpm": 3000.0},
        seed=0,
        name="s",
    )
    x, y = rec.signal("p").T
    np.testing.assert_allclose(y[25:], x[:-25], atol=1e-14)  # 100 samples a turn
    assert 3e-6 < np.abs(x).max() < 7e-6


def test_shaft_at_rest_has_one_angle():
    rec = record(machine(), Stationary(0.1), conditions={"pressure_bar": 5.0, "speed_rpm": 0.0}, seed=0, name="a")
    assert np.ptp(rec.signal("phi")) == 0.0
    np.testing.assert_allclose(rec.signal("p").std(axis=0), 30e-9, rtol=0.15)


def test_same_seed_and_name_give_the_same_bits_and_others_are_independent():
    def make(seed, name):
        return record(machine(), Prbs(duration_s=1.0), conditions=FIG7, seed=seed, name=name)

    first, again = make(7, "prbs_1"), make(7, "prbs_1")
    for signal, values in first.signals.items():
        np.testing.assert_array_equal(values, again.signals[signal])
    for other in (make(7, "prbs_2"), make(8, "prbs_1")):
        assert other.signal("phi")[0] != first.signal("phi")[0]
        levels = np.corrcoef(first.signal("r")[::100].T, other.signal("r")[::100].T)[:2, 2:]
        assert np.abs(levels).max() < 0.6  # 50 levels
    quiet = record(
        replace(machine(), sensors=replace(SensorChain(), noise_p_m=0.0)),
        Prbs(duration_s=1.0),
        conditions=FIG7,
        seed=7,
        name="prbs_1",
    )
    np.testing.assert_array_equal(quiet.signal("u"), first.signal("u"))


def test_noise_of_different_recordings_is_uncorrelated():
    at_rest = {"pressure_bar": 5.0, "speed_rpm": 0.0}
    made = [record(machine(), Stationary(1.0), conditions=at_rest, seed=0, name=name) for name in "ab"]
    noise = np.hstack([rec.signal(signal) for rec in made for signal in "up"])
    correlation = np.corrcoef(noise.T) - np.eye(8)
    assert np.abs(correlation).max() < 5 / np.sqrt(len(noise))


@pytest.mark.parametrize("pressure_bar", [3.0, 7.0])
def test_default_excitation_stays_clear_of_the_bearing(pressure_bar):
    for speed_rpm in (0.0, 4000.0, 6000.0):
        conditions = {"pressure_bar": pressure_bar, "speed_rpm": speed_rpm}
        rig = Machine(rotor_bearing(**conditions), actuator(), clearance=21e-6)
        rec = record(rig, Prbs(), conditions=conditions, seed=0, name="a")
        assert np.abs(rec.signal("p")).max() > 5e-6


# ---- excitation and encoder ----


def test_prbs_levels_are_random_binary_and_independent():
    prbs = Prbs(amplitude_m=2e-6, hold_s=4e-3)
    r = prbs.reference(20 * 20_000, TS, np.random.default_rng(5))
    assert set(np.unique(r)) == {-2e-6, 2e-6}
    held = r.reshape(20_000, 20, 2)
    assert (held == held[:, :1]).all()
    levels = held[:, 0] / 2e-6
    bound = 4.5 / np.sqrt(len(levels))
    assert np.abs(levels.mean(axis=0)).max() < bound
    for lag in range(1, 20):
        assert np.abs(levels[lag:].T @ levels[:-lag]).max() / len(levels) < bound
    assert abs(np.mean(levels[:, 0] * levels[:, 1])) < bound


@settings(deadline=None)
@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=20), st.sampled_from([None, 2, 1000, 4096]))
def test_encoder_angle_is_wrapped_and_within_one_count(angles, counts):
    angle = np.array(angles)
    shown = encoder_angle(replace(SensorChain(), encoder_counts=counts), angle)
    assert ((shown >= 0) & (shown < 2 * np.pi)).all()
    delayed = np.mod(angle - shown + 1e-9, 2 * np.pi)
    assert (delayed < (2 * np.pi / counts if counts else 0) + 2e-9).all()


# ---- bad input ----


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: driven_motion(rotor_bearing(), actuator(), steps(10), TS, 19), "oversampling = 19"),
        (lambda: with_delay([-1e-4, 0]), "delay = .* cannot be negative"),
        (lambda: with_delay([1e-4]), r"delay has shape \(1,\)"),
        (lambda: replace(rotor_bearing(), stiffness=np.full((2, 2), np.nan)), "stiffness .* not finite"),
        (lambda: replace(actuator(), slow_pole=[0, 1]), "slow_pole .* positive"),
        (lambda: Prbs(hold_s=5.1e-4).reference(10, TS, np.random.default_rng(0)), "hold_s = 0.00051 s"),
        (lambda: SensorChain(runout_amplitude_m=np.ones(3)), "runout_amplitude_m = array"),
        (
            lambda: SensorChain(runout_amplitude_m=np.ones((2, 3))),
            "runout_amplitude_m and runout_phase_rad have rows of",
        ),
        (lambda: SensorChain(offset_u_m=(1.0,)), "offset_u"),
        (lambda: SensorChain(encoder_counts=1), "encoder_counts = 1"),
        (lambda: machine(clearance=0.0), "clearance = 0.0"),
        (lambda: record(machine(), Prbs(), conditions={}, seed=0, name="a"), "speed_rpm = None"),
        (lambda: record(machine(), Prbs(), conditions=FIG7, seed=-1, name="a"), "seed = -1"),
        (lambda: record(machine(), Prbs(), conditions=FIG7, seed=0, name=""), "name = ''"),
        (lambda: record(machine(), Prbs(0.0), conditions=FIG7, seed=0, name="a"), "duration_s = 0.0"),
        (
            lambda: record(
                replace(machine(), rotor_bearing=replace(rotor_bearing(), damping=np.eye(2))),
                Prbs(),
                conditions=FIG7,
                seed=0,
                name="a",
            ),
            "unstable, eigenvalue",
        ),
    ],
)
def test_bad_input_is_one_clear_line(call, words):
    with pytest.raises(UsageError, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_a_machine_from_parameters_by_name():
    """The names of a model, in any order and with others among them."""
    p = {
        f"{letter}_{pair}": 10.0 * i + j
        for i, letter in enumerate("kdb")
        for j, pair in enumerate(("xx", "xy", "yx", "yy"))
    }
    p |= {"tau_x": 1e-4, "tau_y": 2e-4, "bd_xx": 1.0}
    a = {
        f"{name}_{axis}": 1.0 + 10 * i + j
        for i, name in enumerate(("p1", "p2", "kappa"))
        for j, axis in enumerate("xy")
    }
    machine = Machine.from_parameters(dict(reversed(p.items())), {**p, **a}, sensors=SensorChain(noise_p_m=0.0))
    bearing = machine.rotor_bearing
    np.testing.assert_array_equal(bearing.stiffness, [[0, 1], [2, 3]])
    np.testing.assert_array_equal(bearing.damping, [[10, 11], [12, 13]])
    np.testing.assert_array_equal(bearing.input_gain, [[20, 21], [22, 23]])
    np.testing.assert_array_equal(bearing.delay, [1e-4, 2e-4])
    np.testing.assert_array_equal(machine.actuator.slow_pole, [1, 2])
    np.testing.assert_array_equal(machine.actuator.fast_pole, [11, 12])
    np.testing.assert_array_equal(machine.actuator.gain, [21, 22])
    assert (machine.sensors.noise_p_m, machine.unbalance, machine.clearance) == (0.0, Unbalance(), 25e-6)
    assert FilmStiffening().deviation_m < 0.95e-6  # the largest deviation from a static gain in the paper, Sec. 3.1
    assert Machine(bearing, machine.actuator).clearance == load_model("theisen2016").machine.clearance_m == 25e-6
    with pytest.raises(UsageError, match="rotor bearing: no value for tau_y"):
        Machine.from_parameters({key: value for key, value in p.items() if key != "tau_y"}, a)
    with pytest.raises(UsageError, match="actuator: no value for p1_x, p2_x"):
        Machine.from_parameters(p, {key: value for key, value in a.items() if key not in ("p1_x", "p2_x")})


def test_noise_of_the_two_axes_may_differ():
    quiet, loud = 1e-9, 100e-9
    made = record(
        machine(sensors=SensorChain(noise_p_m=(quiet, loud))),
        Stationary(1.0),
        conditions={"speed_rpm": 0.0},
        seed=1,
        name="axes",
    )
    np.testing.assert_allclose(made.signal("p").std(axis=0), [quiet, loud], rtol=0.05)
    with pytest.raises(UsageError, match="noise_p_m"):
        SensorChain(noise_p_m=(1e-9, 1e-9, 1e-9))
