"""The stepping simulation against closed form, adaptive integration, and itself at half the step."""

import json
from dataclasses import replace

import numpy as np
import pytest
from rig_point import BARE, actuator, machine
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_continuous_lyapunov

from gbid.core.errors import DataError, UsageError
from gbid.rig import (
    FilmStiffening,
    FlexibleMode,
    Hammer,
    Impact,
    Machine,
    NonSynchronous,
    PiezoStacks,
    Prbs,
    ProcessNoise,
    RotorBearingTruth,
    RunUp,
    SampledController,
    StackStaircase,
    Staircase,
    Stationary,
    Unbalance,
    record,
    saturations,
    touch_downs,
)
from gbid.rig.response import driven_motion

TS = 2e-4
FIG7 = {"pressure_bar": 5.0, "speed_rpm": 6000.0}
STILL = {"pressure_bar": 6.0, "speed_rpm": 0.0}
SENSOR_NOISE = 30e-9


def whole(pressure=5.0, speed=6000.0, **parts) -> Machine:
    """A machine with everything that is not linear."""
    parts = {
        "flexible_mode": FlexibleMode(),
        "stiffening": FilmStiffening(),
        "non_synchronous": NonSynchronous(peak_rpm=speed or 4000.0),
        "process_noise": ProcessNoise(),
        **parts,
    }
    return replace(machine(pressure, speed), actuator=PiezoStacks.unequal(0.05, 1), **parts)


def p_controller(gain=(1.125, 0.99), corner_hz=1000.0, **more) -> SampledController:
    """The paper's, with the low-pass held over a sample."""
    a = np.exp(-2 * np.pi * corner_hz * TS)
    return SampledController(a * np.eye(2), (1 - a) * np.eye(2), np.diag(gain), np.zeros((2, 2)), TS, **more)


# ---- the same as in closed form ----


@pytest.mark.parametrize("experiment", [Prbs(0.5), Stationary(0.2), Staircase(hold_s=0.05)])
def test_linear_parts_step_to_the_closed_form(experiment):
    made = {
        how: record(machine(), experiment, conditions=FIG7, seed=3, name="a", simulation=how)
        for how in ("exact", "stepping")
    }
    assert made["exact"].provenance["simulation"] == "closed form, exact delays"
    assert made["stepping"].provenance["simulation"].startswith("stepping")
    for signal, values in made["exact"].signals.items():
        np.testing.assert_allclose(made["stepping"].signal(signal), values, rtol=0, atol=0.1e-9)


@pytest.mark.parametrize("tau", [(0.0, 0.0), (3e-6, 1.2345e-3), (TS, 2 * TS)])
def test_every_delay_is_kept(tau):
    rig = replace(machine(sensors=BARE), rotor_bearing=replace(machine().rotor_bearing, delay=np.array(tau)))
    made = [
        record(rig, Prbs(0.2), conditions=FIG7, seed=3, name="a", simulation=how).signal("p")
        for how in ("exact", "stepping")
    ]
    np.testing.assert_allclose(made[1], made[0], rtol=0, atol=0.1e-9)


def test_rotor_with_all_effects_matches_an_adaptive_integration():
    """Unbalance under acceleration, then impacts: a run-up is not hit."""
    rig = replace(whole(sensors=BARE, non_synchronous=None, process_noise=None), actuator=actuator())
    truth, flexible, film = rig.rotor_bearing, rig.flexible_mode, rig.stiffening
    omega = 2 * np.pi * flexible.frequency_hz
    length = np.sqrt((film.at_m - film.deviation_m) ** 3 / film.deviation_m)

    def rates(t, s, force):
        q, dq, e, de = s.reshape(4, 2)
        a = force(t)
        bent = q * (1 + q @ q / length**2)
        return np.concatenate(
            [
                dq,
                truth.stiffness @ bent + truth.damping @ dq + a,
                de,
                flexible.share * a - omega**2 * e - 2 * flexible.damping * omega * de,
            ]
        )

    slope = 6000 * np.pi / 30 / 0.4
    first = {}

    def turning(t):
        angle, speed = first["phi"] + slope * t**2 / 2 + rig.unbalance.phase_rad, slope * t
        e = rig.unbalance.eccentricity_m
        # minus the second derivative of e (cos, sin), by hand
        return e * np.array(
            [speed**2 * np.cos(angle) + slope * np.sin(angle), speed**2 * np.sin(angle) - slope * np.cos(angle)]
        )

    impacts = (Impact(0.01, 9.0, 1.7e-3, 0.4), Impact.along("y", 0.05, 5.0, 3.1e-3))

    def hammered(t):
        f = np.zeros(2)
        for b in impacts:
            if 0 < t - b.time < b.duration:
                along = np.array([np.cos(b.direction), np.sin(b.direction)])
                f += b.peak * np.sin(np.pi * (t - b.time) / b.duration) * along
        return f / rig.moving_mass

    for experiment, force, end in ((RunUp(0, 6000, 0.4), turning, 0.4), (Hammer(impacts, 0.1), hammered, 0.1)):
        made = record(rig, experiment, conditions=STILL, seed=1, name="a", settle_s=0)
        first["phi"] = made.signal("phi")[0, 0]
        solution = solve_ivp(
            rates,
            (0, end),
            np.zeros(8),
            args=(force,),
            t_eval=made.time,
            method="DOP853",
            rtol=1e-9,
            atol=1e-14,
            max_step=1e-3,
        )
        p = (solution.y[0:2] + solution.y[4:6]).T
        assert np.abs(p).max() > 2e-6
        np.testing.assert_allclose(made.signal("p"), p, rtol=0, atol=1e-11)


# ---- half the step ----


@pytest.mark.parametrize(
    ("experiment", "controller"),
    [
        (Prbs(0.4), None),
        (Stationary(0.2), None),
        (Staircase(hold_s=0.04), None),
        (StackStaircase(hold_s=0.04), None),
        (StackStaircase(controlled=True, hold_s=0.04), None),
        (Hammer((Impact(0.1, 10.0), Impact.along("y", 0.4, 10.0)), 0.8), p_controller()),
        (RunUp(0, 6000, 0.5), None),
    ],
)
def test_halving_the_step_moves_no_recording_by_the_sensor_noise(experiment, controller):
    made = [
        record(
            whole(),
            experiment,
            conditions=FIG7,
            seed=1,
            name="a",
            controller=controller,
            stacks=True,
            oversampling=over,
        )
        for over in (20, 40)
    ]
    for signal in ("r", "u", "p", "y_p"):
        shifted = np.abs(made[1].signal(signal) - made[0].signal(signal)).max()
        assert shifted < 0.01 * SENSOR_NOISE, (signal, shifted)


def test_recordings_are_the_same_bit_for_bit_and_chunks_do_not_show(monkeypatch):
    def make(name="a", seed=5):
        return record(whole(), Prbs(0.1), conditions=FIG7, seed=seed, name=name)

    first, again = make(), make()
    monkeypatch.setattr("gbid.rig.stepping._CHUNK", 37)
    chopped = make()
    for signal, values in first.signals.items():
        np.testing.assert_array_equal(again.signal(signal), values)
        np.testing.assert_allclose(chopped.signal(signal), values, rtol=0, atol=1e-16)
    assert (make("b").signal("p") != first.signal("p")).all()


def test_without_a_compiler_a_linear_machine_in_open_loop_is_recorded(monkeypatch):
    from gbid.core.compiled import CompilerMissingError

    def missing(source):
        raise CompilerMissingError("no C compiler found (cc, gcc, clang)")

    monkeypatch.setattr("gbid.rig.stepping.load_library", missing)
    with pytest.raises(UsageError, match=r"no C compiler found \(cc, gcc, clang\); install one"):
        record(whole(), Prbs(0.02), conditions=FIG7, seed=1, name="a", settle_s=0)
    made = record(machine(), Prbs(0.02), conditions=FIG7, seed=1, name="a", settle_s=0)
    assert made.provenance["simulation"].startswith("closed form")


# ---- what acts on the rotor ----


def test_process_noise_has_the_variance_of_its_density():
    damped = machine(6.0, 0.0).rotor_bearing
    damped = replace(damped, damping=10 * damped.damping)
    density = 0.05
    rig = replace(machine(6.0, 0.0, sensors=BARE), rotor_bearing=damped, process_noise=ProcessNoise(density))
    p = record(rig, Stationary(20.0), conditions=STILL, seed=1, name="a").signal("p")
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [damped.stiffness, damped.damping]])
    Q = np.diag([0, 0, density**2 / 2, density**2 / 2])  # one-sided density to intensity
    expected = solve_continuous_lyapunov(A, -Q)[:2, :2]
    np.testing.assert_allclose(p.std(axis=0), np.sqrt(np.diag(expected)), rtol=0.06)


def test_non_synchronous_motion_is_felt_near_its_speed_only():
    whirl = NonSynchronous(size_m=0.2e-6, bandwidth_hz=5.0)
    sizes = {}
    for speed in (0.0, 4000.0, 6000.0):
        rig = replace(machine(5.0, 4000.0, sensors=BARE), non_synchronous=whirl, unbalance=Unbalance(0.0))
        made = record(rig, Stationary(10.0), conditions={"speed_rpm": speed}, seed=1, name="a")
        sizes[speed] = np.sqrt((made.signal("p") ** 2).sum(axis=1).mean())
    truth = machine(5.0, 4000.0).rotor_bearing
    frequency = np.linspace(-300, 300, 60_001)
    s = (2j * np.pi * frequency)[:, None, None]
    response = np.linalg.solve(s**2 * np.eye(2) - s * truth.damping - truth.stiffness, -truth.stiffness)
    away = frequency - whirl.ratio * 4000 / 60
    density = whirl.bandwidth_hz / np.pi / (away**2 + whirl.bandwidth_hz**2)
    power = 0.5 * (np.abs(response @ [1, -1j]) ** 2).sum(axis=1)
    expected = whirl.size_m * np.sqrt(np.trapezoid(power * density, frequency))
    assert sizes[4000.0] == pytest.approx(expected, rel=0.15)
    assert sizes[0.0] < 1e-3 * sizes[4000.0]
    assert sizes[6000.0] < 2e-3 * sizes[4000.0]


def test_stiffening_leaves_the_disc_short_of_where_it_says():
    film = FilmStiffening(0.9e-6, 8e-6)
    alike = RotorBearingTruth(-4e5 * np.eye(2), -200 * np.eye(2), 1e5 * np.eye(2), np.zeros(2))
    rig = replace(machine(sensors=BARE), rotor_bearing=alike, stiffening=film, unbalance=Unbalance(0.0))
    top = film.at_m * 4 / actuator().gain[0]  # the linear film would rest at u/4
    made = record(rig, Staircase("x", step_m=top, steps=1, hold_s=0.5), conditions=STILL, seed=0, name="a")
    at_top = made.signal("p")[3 * 2500 - 1, 0]  # end of the third of five levels
    assert at_top == pytest.approx(film.at_m - film.deviation_m, rel=1e-6)


def test_static_error_of_the_default_film_stays_below_the_papers():
    rig = replace(machine(6.0, 0.0, sensors=BARE), actuator=PiezoStacks(), stiffening=FilmStiffening())
    for axis in (0, 1):
        made = record(rig, Staircase("xy"[axis], hold_s=0.2), conditions=STILL, seed=0, name="a")
        ends = slice(-200, None)
        u, p = (made.signal(s)[:, axis].reshape(25, -1)[:, ends].mean(axis=1) for s in "up")
        line = np.polyval(np.polyfit(u, p, 1), u)
        assert 0.02e-6 < np.abs(p - line).max() < 0.95e-6


# ---- hammer, touch-down, run-up ----


def test_impact_gives_the_momentum_that_was_measured():
    rig = machine(6.0, 0.0, sensors=BARE)
    impact = Impact.along("y", 0.02, 10.0, 2e-3)
    made = record(rig, Hammer((impact,), 0.5), conditions=STILL, seed=0, name="a", settle_s=0)
    force = made.signal("f")
    assert made.units["f"] == "N"
    assert made.channels["f"] == ("x", "y")
    assert not force[:, 0].any()
    momentum = force[:, 1].sum() * TS
    assert momentum == pytest.approx(2 / np.pi * 10.0 * 2e-3, rel=0.01)
    truth = rig.rotor_bearing
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [truth.stiffness, truth.damping]])
    when = impact.time + impact.duration * (np.arange(400) + 0.5) / 400
    pushes = impact.force(when)[:, 1] * (impact.duration / 400) / rig.moving_mass
    for k in (130, 180, 400):
        parts = [push * expm(A * (k * TS - t))[:2, 3] for t, push in zip(when, pushes, strict=True)]
        np.testing.assert_allclose(made.signal("p")[k], np.sum(parts, axis=0), rtol=0, atol=1e-10)


def test_touch_down_is_refused_or_flagged():
    args = {"conditions": FIG7, "seed": 0, "name": "a"}
    wild = Prbs(0.5, amplitude_m=6e-6, hold_s=4e-3)
    for rig in (machine(), whole(stiffening=None)):
        with pytest.raises(DataError, match=r"recording 'a': the disc moves .* reaches the clearance"):
            record(rig, wild, **args)
        made = record(rig, wild, touch_down="flag", **args)
        spans = touch_downs(made)
        assert spans
        assert all(0 <= a < b <= 0.5 for a, b in spans)
        assert json.loads(made.provenance["touch_down"]) == [list(s) for s in spans]
        bare = record(replace(rig, sensors=BARE), wild, touch_down="flag", **args)
        radius = np.hypot(*bare.signal("p").T)
        assert 25e-6 < radius.max() < 26.5e-6  # held, with a little depth
        touched = [any(a <= t + TS / 2 < b for a, b in touch_downs(bare)) for t in bare.time]
        assert not (radius[~np.array(touched)] > 25e-6).any()
    calm = record(machine(), Prbs(0.5), touch_down="flag", **args)
    assert touch_downs(calm) == []
    assert calm.provenance["simulation"] == "closed form, exact delays"


def test_run_up_integrates_its_angle_and_passes_the_resonance():
    rig = machine(3.0, 4000.0, sensors=replace(BARE, encoder_counts=4096))
    made = record(rig, RunUp(0, 8000, 4.0), conditions=STILL, seed=0, name="a", touch_down="flag")
    turns = np.unwrap(made.signal("phi")[:, 0])
    expected = turns[0] + 0.5 * (8000 * np.pi / 30 / 4.0) * made.time**2
    np.testing.assert_allclose(turns, expected, atol=2.1 * 2 * np.pi / 4096)
    radius = np.hypot(*made.signal("p").T).reshape(40, -1).max(axis=1)
    peak_hz = 8000 / 60 * (radius.argmax() + 0.5) / 40
    assert 80 < peak_hz < 130
    assert radius[0] < 0.1 * radius.max()


# ---- in a loop ----


@pytest.mark.parametrize("n_states", [0, 3])
def test_loop_is_the_controllers_recursion_on_what_was_measured(n_states):
    random = np.random.default_rng(1)
    A, B = 0.3 * random.standard_normal((n_states, n_states)), random.standard_normal((n_states, 2))
    C, D = 0.1 * random.standard_normal((2, n_states)), 0.3 * np.eye(2)
    table = 1e-6 * random.standard_normal((12, 2))
    controller = SampledController(A, B, C, D, TS, runout=table, offset=(2e-6, -3e-6))
    prbs = Prbs(0.4, amplitude_m=1e-6)
    rig = machine(5.0, 6000.0)
    made = record(rig, prbs, conditions=FIG7, seed=2, name="a", controller=controller, settle_s=0)
    alone = record(rig, prbs, conditions=FIG7, seed=2, name="a", settle_s=0)
    np.testing.assert_array_equal(made.signal("w"), alone.signal("r"))
    assert "w" not in alone.signals  # in open loop r is all there is
    p, phi = made.signal("p"), made.signal("phi")[:, 0]
    place = phi / (2 * np.pi) * 12
    low = np.floor(place).astype(int)
    part = (place - low)[:, None]
    error = p - (1 - part) * table[low % 12] - part * table[(low + 1) % 12] - [2e-6, -3e-6]
    x, w = np.zeros(n_states), np.zeros(2)
    for k in range(len(p)):
        np.testing.assert_allclose(made.signal("r")[k], alone.signal("r")[k] + w, rtol=0, atol=1e-18)
        w = C @ x + D @ error[k]
        x = A @ x + B @ error[k]
    assert np.abs(made.signal("r") - alone.signal("r")).max() > 0.5e-6


def test_plant_in_the_loop_is_the_same_plant():
    """What was applied, through the closed form, gives what was measured."""
    rig = machine(6.0, 0.0, sensors=BARE)
    made = record(rig, Prbs(0.5), conditions=STILL, seed=2, name="a", controller=p_controller(), settle_s=0)
    motion = driven_motion(rig.rotor_bearing, rig.actuator, made.signal("r"), TS)
    np.testing.assert_allclose(made.signal("p"), motion.p[::20], rtol=0, atol=0.1e-9)
    np.testing.assert_allclose(made.signal("u"), motion.u[::20], rtol=0, atol=1e-16)


def test_loop_is_held_to_the_travel():
    wild = SampledController(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((2, 0)), 30 * np.eye(2), TS)
    rig = replace(machine(6.0, 0.0), actuator=PiezoStacks())
    made = record(rig, Prbs(0.2), conditions=STILL, seed=0, name="a", controller=wild, touch_down="flag")
    assert np.abs(made.signal("r")).max() == 22.5e-6
    assert saturations(made)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda **k: record(whole(), Prbs(0.1), simulation="exact", **k), "no closed form with piezo stacks, flexible"),
        (lambda **k: record(machine(), Prbs(0.1), touch_down="ignore", **k), "touch_down = 'ignore'"),
        (lambda **k: record(whole(), Prbs(0.1), oversampling=10, **k), "oversampling = 10"),
        (lambda **k: record(machine(), Prbs(0.1), controller=replace(p_controller(), sample_time=1e-3), **k), "0.001"),
        (lambda **k: SampledController(np.eye(2), np.eye(3), np.eye(2), np.eye(2), TS), r"B has shape \(3, 3\)"),
        (lambda **k: replace(p_controller(), sample_time=0.0), "sample_time = 0.0"),
        (lambda **k: FilmStiffening(9e-6, 8e-6), "deviation_m = 9e-06"),
        (lambda **k: Hammer(()), "no impacts"),
        (lambda **k: Hammer((Impact(2.0),), 1.0), "an impact at 2.0 s"),
        (lambda **k: Impact.along("z"), "axis = 'z'"),
        (lambda **k: Staircase(axis="z"), "axis = 'z'"),
        (lambda **k: record(machine(), Staircase(hold_s=1.1e-3 / 2), **k), "whole number of samples"),
        (lambda **k: replace(machine(), moving_mass=0.0), "moving_mass = 0.0; give a number above 0"),
    ],
)
def test_bad_input_is_one_clear_line(call, words):
    with pytest.raises(UsageError, match=words) as caught:
        call(conditions=FIG7, seed=0, name="a")
    assert "\n" not in str(caught.value)
