"""Unbalance is cancelled while the rotor runs, in the loop of the virtual rig, and only where that is proved."""

from __future__ import annotations

import copy
import shutil
from dataclasses import replace

import numpy as np
import pytest
from balanced_loop import DESIGN, FADE_S, GAINS, MODEL, PLANT, chain, machine, once_per_turn, run
from chain_cases import eventful_samples, runout_map

import gbid
from gbid.control import close_loop
from gbid.control.loop.close import sample_plant
from gbid.control.loop.sampled import exact_plant_of
from gbid.core.errors import UsageError
from gbid.export.chain import ChainOptions, chain_of
from gbid.export.chain_c import CompiledChain
from gbid.export.chain_python import FLOAT_TOLERANCE, ChainInput, PythonChain
from gbid.identify.uncertainty.uncertain_model import ModelSlopes, UncertainModel
from gbid.rig import Course, Hammer, Impact, ScheduledRun, SensorChain, Stationary
from gbid.structure import KEY_PARAMETERS

compiled = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
SPEEDS = (3900.0, 7500.0)
VALUES = {**MODEL.actuators, **MODEL.key_parameters(6.0, 6000.0)}


def balance(model=PLANT, **options) -> gbid.BalanceWhileRunning:
    return gbid.BalanceWhileRunning(model, DESIGN, **{"speeds_rpm": SPEEDS, "moving_mass_kg": 2.18, **options})


BALANCE = balance()


def turned(degrees: float) -> gbid.BalanceWhileRunning:
    """Return a cancellation whose table has a phase error."""
    wrong, table = copy.copy(BALANCE), BALANCE.table
    real, imaginary = np.split(table.rows, 2, axis=1)
    rows = (real + 1j * imaginary) * np.exp(1j * np.radians(degrees))
    object.__setattr__(wrong, "table", replace(table, rows=np.hstack([rows.real, rows.imag])))
    return wrong


def uncertain(relative: float) -> UncertainModel:
    """Return the plant with independent relative standard deviations of its stiffness, damping and input gains."""
    names = [name for name in KEY_PARAMETERS if name.startswith(("k", "d", "b"))]
    sizes = np.array([abs(VALUES[name]) for name in names])
    letters = ("A", "B", "C", "D", "B_delayed", "delay")
    moved = [
        exact_plant_of(MODEL, {**VALUES, name: VALUES[name] + size}) for name, size in zip(names, sizes, strict=True)
    ]
    slopes = {a: np.array([getattr(m, a) - getattr(PLANT, a) for m in moved]) for a in letters}
    scaled = {a: value / sizes.reshape(-1, *[1] * (value.ndim - 1)) for a, value in slopes.items()}
    return UncertainModel(PLANT, ModelSlopes(**scaled), np.diag((relative * sizes) ** 2))


def below_a_tenth(rotor, speed: float, program=None, seconds: float = 0.6) -> float:
    """Return the time after the fade at which the once-per-turn motion is below a tenth of that without cancelling."""
    before = once_per_turn(run(rotor, CompiledChain(chain(None)), speed, 0.5)[0])[1][-3:].mean(axis=0)
    time, wave = once_per_turn(run(rotor, program or CompiledChain(chain(BALANCE)), speed, seconds)[0])
    above = np.flatnonzero((wave > 0.1 * before).any(axis=1))
    return float(time[above[-1] + 1]) - FADE_S if above[-1] + 1 < len(time) else np.inf


@compiled
@pytest.mark.parametrize("speed", [4000.0, 7400.0])
def test_the_once_per_turn_motion_falls_to_a_tenth_within_half_a_second(speed: float) -> None:
    assert below_a_tenth(machine(), speed) < 0.5


@compiled
@pytest.mark.slow
def test_twenty_perturbed_rotors_fall_to_a_tenth_within_half_a_second() -> None:
    random = np.random.default_rng(5)
    for k in range(20):
        spread = {"k": 0.03, "d": 0.1, "b": 0.05, "t": 0.03}
        parameters = {
            name: value * (1 + spread[name[0]] * random.uniform(-1, 1))
            for name, value in MODEL.key_parameters(6.0, 6000.0).items()
        }
        assert below_a_tenth(machine(parameters=parameters), float(random.uniform(4000, 7400)), seconds=0.8) < 0.5, k


@compiled
def test_a_ramp_of_speed_and_an_impact_leave_the_motion_small() -> None:
    constant = {"surfaces": lambda p, s: {k: v + 0 * p for k, v in MODEL.key_parameters(6.0, 6000.0).items()}}
    ramp = ScheduledRun(Course((0.0, 2.0), 6.0, (5900.0, 6100.0)), Stationary(2.0))
    recording, _ = run(machine(), CompiledChain(chain(BALANCE)), None, 2.0, ramp, **constant)
    reference = once_per_turn(run(machine(), CompiledChain(chain(None)), 6000.0, 0.5)[0])[1][-1]
    time, wave = once_per_turn(recording)
    assert (wave[time > 0.6] < 0.1 * reference).all()
    hit = Hammer((Impact.along("x", 0.6),), 1.2)
    time, wave = once_per_turn(run(machine(), CompiledChain(chain(BALANCE)), 6000.0, 1.2, hit)[0])
    assert (wave[(time > 0.52) & (time < 0.6)] < 0.1 * reference).all()
    assert (wave[time > 1.1] < 0.1 * reference).all()


@compiled
def test_with_a_wrong_phase_references_stay_bounded_and_the_watchdog_ends_it() -> None:
    outputs = run(machine(), CompiledChain(chain(turned(100.0))), 6000.0, 2.5)[1]
    waves = np.array([each.balance for each in outputs]).reshape(len(outputs), 2, 2)
    bound = BALANCE.share * chain(BALANCE).options.limit_m
    assert np.hypot(*waves.transpose(2, 0, 1)).max() <= bound
    assert outputs[-1].balance_ended
    assert not outputs[len(outputs) // 5].balance_ended
    assert np.abs(outputs[-1].balance).max() == 0.0
    alone = run(machine(), CompiledChain(chain(None)), 6000.0, 2.5)[1]
    np.testing.assert_allclose([y.reference for y in outputs[-50:]], [y.reference for y in alone[-50:]], atol=1e-10)


@compiled
def test_with_sixty_degrees_of_phase_error_it_converges() -> None:
    assert below_a_tenth(machine(), 6000.0, CompiledChain(chain(turned(60.0))), 0.9) < 0.8


def test_the_exact_loop_tells_a_time_constant_that_is_too_short() -> None:
    with pytest.raises(UsageError, match=r"time_constant_s = 0\.01 s is too short .* 4000 rpm"):
        balance(time_constant_s=0.01, speeds_rpm=(4000.0, 7400.0))


def test_the_phase_error_bounds_that_of_drawn_plants() -> None:
    model = balance(uncertain(0.01))
    assert 1 < model.phase_error_deg.max() < 20
    random, law = np.random.default_rng(1), DESIGN.sampled_at()
    names = [name for name in KEY_PARAMETERS if name.startswith(("k", "d", "b"))]
    worst = np.zeros(3)
    for _ in range(40):
        way = random.normal(size=len(names))
        way *= 0.01 * np.sqrt(21.03) / np.linalg.norm(way)  # on the border of the region of 95 %, 12 parameters
        values = {**VALUES, **{name: VALUES[name] * (1 + w) for name, w in zip(names, way, strict=True)}}
        closed = close_loop(sample_plant(exact_plant_of(MODEL, values), 2e-4, 2e-4), law)
        for i, speed in enumerate((4000.0, 5900.0, 7400.0)):
            ratio = model.weights(0.0, speed) @ closed.frequency_response(speed / 60)[0]
            around = np.linspace(0, 2 * np.pi, 500)
            field = [np.linalg.eigvalsh(ratio * np.exp(1j * t) + (ratio * np.exp(1j * t)).conj().T) for t in around]
            worst[i] = max(worst[i], _angle(np.array(field), around))
    assert (worst < np.interp((4000.0, 5900.0, 7400.0), model.points[:, 1], model.phase_error_deg) * 1.05).all()
    assert worst.max() > 0.2 * model.phase_error_deg.max()


def _angle(field: np.ndarray, around: np.ndarray) -> float:
    """Return the largest angle of a field of values with the real axis [degrees], from its supporting lines."""
    right = field[:, 0] > 0  # turned by t, the field lies in the right half-plane
    ways = np.degrees((around[right] + np.pi) % (2 * np.pi) - np.pi)
    return float(90 - min(ways.max(), -ways.min()))


def test_a_model_that_is_too_uncertain_is_refused_with_the_speeds() -> None:
    with pytest.raises(UsageError, match=r"phase error may exceed 60 degrees at .*rpm.* \(up to 90\)") as error:
        balance(uncertain(0.2))
    assert "7500 rpm" in str(error.value)


@compiled
def test_the_unbalance_is_found_in_gram_millimetres() -> None:
    noisy = SensorChain(runout_amplitude_m=np.zeros((2, 0)), runout_phase_rad=np.zeros((2, 0)), offset_p_m=(0, 0))
    outputs = run(machine(sensors=noisy), CompiledChain(chain(BALANCE)), 6600.0, 1.0)[1][-2500:]
    c, left = (
        np.mean([getattr(y, key) for y in outputs], axis=0).view(complex) for key in ("balance", "once_per_turn")
    )
    found = BALANCE.unbalance(c, left, pressure_bar=6.0, speed_rpm=6600.0)
    assert found.g_mm == pytest.approx(0.5e-6 * 2.18e6, rel=0.01)
    assert found.angle_deg == pytest.approx(np.degrees(0.7), abs=0.5)


def test_deviations_of_the_unbalance_cover_drawn_plants() -> None:
    model, random = balance(uncertain(0.01)), np.random.default_rng(2)
    names = [name for name in KEY_PARAMETERS if name.startswith(("k", "d", "b"))]
    speed, eccentricity, inside = 5000.0, 0.5e-6, np.zeros(2)
    omega = speed * np.pi / 30
    force = eccentricity * omega**2 * np.exp(0.7j) * np.array([1, -1j])
    for _ in range(100):
        values = {**VALUES, **{name: VALUES[name] * (1 + 0.01 * random.normal()) for name in names}}
        G = sample_plant(exact_plant_of(MODEL, values), 2e-4, 2e-4).frequency_response(speed / 60)[0]
        K, D = (np.reshape([values[f"{a}_{pair}"] for pair in ("xx", "xy", "yx", "yy")], (2, 2)) for a in "kd")
        moved = np.linalg.solve(-(omega**2) * np.eye(2) - 1j * omega * D - K, force)
        c = -np.linalg.solve(G, moved)
        found = model.unbalance(c, np.zeros(2), pressure_bar=6.0, speed_rpm=speed)
        inside += [
            abs(found.g_mm - eccentricity * 2.18e6) < 2 * found.g_mm_std,
            abs(found.angle_deg - np.degrees(0.7)) < 2 * found.angle_deg_std,
        ]
    assert (inside >= 90).all()


@compiled
@pytest.mark.parametrize(("speeds", "share"), [((1000.0, 7400.0), 0.5), ((2000.0, 5000.0), 0.02)])
def test_compiled_and_python_chain_agree_on_hostile_samples(speeds: tuple[float, float], share: float) -> None:
    given = {"ramp_s": 0.02, "fade_s": 0.01, "zero_m": (1e-7, 2e-7), "disc_limit_m": 30e-6}
    turning = [(3e-6 * np.cos(0.1 * k), 2e-6 * np.sin(0.1 * k), 0.1 * k) for k in range(2800)]
    samples = [*eventful_samples(), *(ChainInput((x, y), phi, 6.0, 4800.0) for x, y, phi in turning)]
    model = balance(speeds_rpm=speeds, share=share)
    whole = chain(model, **given)
    expected = PythonChain(whole).run(samples)
    assert CompiledChain(whole).run(samples) == expected
    assert any(y.balance_ended for y in expected) == (share == 0.02)
    single = CompiledChain(chain(model, **given, number="float")).run(samples)
    miss = np.array([y.reference for y in single]) - [y.reference for y in expected]
    assert np.abs(miss).max() < FLOAT_TOLERANCE * whole.options.limit_m


def test_a_map_that_contains_the_unbalance_is_refused() -> None:
    with pytest.raises(UsageError, match=r"recorded at 6000 rpm.*at slow roll, at most 975 rpm"):
        chain_of(DESIGN, runout_maps=[runout_map()], balance=BALANCE)
    assert chain_of(DESIGN, runout_maps=[runout_map(speed=600.0)], balance=BALANCE).needs_angle


def test_a_balance_of_other_gains_is_refused_and_one_without_uncertainty_noted() -> None:
    other = replace(DESIGN, gains={**GAINS, "kappa_x": 1.0})
    with pytest.raises(UsageError, match="other gains"):
        chain_of(other, balance=BALANCE, options=ChainOptions())
    assert "GB418" in chain_of(DESIGN, balance=BALANCE).notes[0]
    assert chain_of(DESIGN, balance=balance(uncertain(0.001))).notes == ()
    with pytest.raises(UsageError, match="speeds_rpm = None"):
        gbid.BalanceWhileRunning(PLANT, DESIGN)
