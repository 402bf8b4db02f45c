"""Rotors in magnetic bearings of one, two and four axes, identified in their loops: data by numpy and scipy alone."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.linalg import block_diag, expm

import gbid
from gbid.core.errors import UsageError
from gbid.discretise.dual import Dual
from gbid.experiment.load import load_experiment
from gbid.experiment.structures import make_structure
from gbid.identify.predictor import build_predictor
from gbid.structure import evaluate

T = 1e-4
"""Sample time [s]."""
AXES = {1: ("z",), 2: ("x", "y"), 4: ("ax", "ay", "bx", "by")}
AMPLIFIER, SENSOR = 2 * np.pi * 1500, 2 * np.pi * 4000
LATE = {1: 0.37 * T, 2: 1.23 * T, 4: 0.37 * T}
K_S = {1: [1.0e6], 2: [0.9e6, 1.1e6], 4: [0.6e6, 0.65e6, 0.7e6, 0.75e6]}
K_I = {1: [200.0], 2: [190.0, 210.0], 4: [150.0, 160.0, 170.0, 180.0]}
ROTOR = {"inertia_kg_m2": 0.09, "polar_inertia_kg_m2": 0.02, "arms_m": (0.15, -0.1), "speed_rpm": 6000.0}
SHOP = {"kp": 1.5e4, "kd": 20.0}


class Machine(NamedTuple):
    """Rotor, amplifiers and sensors from the references of the currents, without their delay."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray


def machine(n: int) -> Machine:
    """Newton's equations: a mass in one or two axes; a rotor of 4 kg in four, with q = x, y and the slopes."""
    none, eye = np.zeros((n, n)), np.eye(n)
    M, G, reach = 4.0 * eye, none, eye
    if n == 4:
        spin = 0.02 * 6000 * np.pi / 30
        M, G = np.diag([4.0, 4.0, 0.09, 0.09]), block_diag(np.zeros((2, 2)), [[0.0, spin], [-spin, 0.0]])
        reach = np.array([[1, 0, 0.15, 0], [0, 1, 0, 0.15], [1, 0, -0.1, 0], [0, 1, 0, -0.1]])
    force = np.linalg.solve(M, reach.T)
    rotor = [force @ np.diag(K_S[n]) @ reach, -np.linalg.solve(M, G), force @ np.diag(K_I[n]), none]
    A = np.block(
        [
            [none, eye, none, none],
            rotor,
            [none, none, -AMPLIFIER * eye, none],
            [SENSOR * reach, none, none, -SENSOR * eye],
        ]
    )
    return Machine(A, np.vstack([none, none, AMPLIFIER * eye, none]), np.hstack([none, none, none, eye]))


def shop(n: int) -> gbid.LinearModel:
    """PD controller with a difference quotient, of the position one sample before."""
    eye, kp, kd = np.eye(n), SHOP["kp"], SHOP["kd"] / T
    return gbid.LinearModel(0 * eye, eye, kd * eye, -(kp + kd) * eye, dt=T, name="shop")


def recorded(n: int, seed: int, samples: int = 3000, noise: float = 2e-7) -> gbid.Recording:
    """Recording of the loop, sample by sample: the reference of a current acts after the delay of its amplifier."""
    random, (A, B, C) = np.random.default_rng(seed), machine(n)
    size, complete = len(A), int(LATE[n] / T)

    def passed(t: float) -> tuple[np.ndarray, np.ndarray]:
        both = expm(t * np.block([[A, B], [np.zeros((n, size + n))]]))
        return both[:size, :size], both[:size, size:]

    early = LATE[n] - complete * T
    (F1, G1), (F2, G2) = passed(early), passed(T - early)
    w = 0.05 * np.repeat(random.choice([-1.0, 1.0], (samples // 10, n)), 10, axis=0)
    x, before, past, p = np.zeros(size), np.zeros(n), [np.zeros(n)] * (complete + 2), np.empty((samples, n))
    for k in range(samples):
        p[k] = C @ x + noise * random.standard_normal(n)
        current = w[k] - SHOP["kp"] * p[k] - SHOP["kd"] / T * (p[k] - before)
        before, past = p[k], [current, *past[:-1]]
        x = F2 @ (F1 @ x + G1 @ past[complete + 1]) + G2 @ past[complete]
    return gbid.Recording({"w": w, "p": p}, T, name=f"{n} axes, {seed}", units={"w": "A", "p": "m"})


def bearing(n: int, **options: object) -> gbid.MagneticBearing:
    """The structure, with a guess of its parameters."""
    rotor = gbid.structure.RigidRotor(axes=AXES[n], mass_kg=4.0, k_s=7e5, k_i=160.0, **(ROTOR if n == 4 else {}))
    chain = {"amplifier_hz": 1800.0, "amplifier_delay_s": 2e-5, "longest_delay_s": 2 * T, "sensor_hz": 4000.0}
    return gbid.MagneticBearing(rotor, **{**chain, **options})


def loop(n: int, pade_order: int | None = None) -> gbid.ClosedLoop:
    """Its loop with the controller of the shop."""
    return gbid.ClosedLoop(bearing(n), shop(n), computation_samples=0, pade_order=pade_order)


def true(n: int) -> dict[str, float]:
    """True parameters."""
    axes = {f"{k}_{a}": v for k, vs in (("k_s", K_S[n]), ("k_i", K_I[n])) for a, v in zip(AXES[n], vs, strict=True)}
    return {**axes, "omega_amplifier": AMPLIFIER, "tau_amplifier": LATE[n], "omega_sensor": SENSOR}


@pytest.mark.parametrize("n", AXES)
def test_the_structure_is_the_rotor_with_its_amplifiers_and_sensors(n):
    model, (A, B, C) = evaluate(bearing(n), true(n)), machine(n)
    for hz in (0.0, 30.0, 400.0, 3000.0):
        s = 2j * np.pi * hz
        expected = C @ np.linalg.solve(s * np.eye(len(A)) - A, B) * np.exp(-s * LATE[n])
        np.testing.assert_allclose(model.frequency_response([hz])[0], expected, rtol=1e-9, atol=1e-18)
    measured = evaluate(bearing(n, outputs=("i", "p")), true(n))
    response = measured.frequency_response([400.0])[0]
    amplifier = np.exp(-800j * np.pi * LATE[n]) / (1 + 800j * np.pi / AMPLIFIER)
    np.testing.assert_allclose(response[:n], amplifier * np.eye(n), atol=1e-12)
    np.testing.assert_allclose(response[n:], model.frequency_response([400.0])[0])


@pytest.mark.parametrize("n", AXES)
def test_delays_in_a_sampled_loop_are_exact(n):
    quiet = recorded(n, 1, samples=400, noise=0.0)
    w, p = quiet.signal("w"), quiet.signal("p")
    off = [np.abs(evaluate(loop(n, order), true(n)).simulate(w) - p).max() / np.abs(p).max() for order in (None, 1)]
    assert off[0] < 1e-10
    assert off[1] > 1e-5


def test_derivatives_of_a_loop_with_exact_delays():
    at = {**true(2), "tau_amplifier": 0.7 * T}
    predictor = build_predictor(loop(2), {}, T, "zoh", "simulation")
    assert predictor.n_states == 8 + 2 * 2 + 2  # plant, two samples of both references, controller
    point = np.array([at[q.name] for q in predictor.free])
    v, several = predictor.at(point), predictor.at_each(np.array([point, point * 1.001]))
    np.testing.assert_allclose(several[1].F, predictor.at(point * 1.001).F, rtol=1e-9, atol=1e-15)
    for i, q in enumerate(predictor.free):
        step = 1e-5 * at[q.name]
        high, low = (predictor.at(point + sign * step * np.eye(len(point))[i]) for sign in (1, -1))
        for name in "FG":
            slope = (getattr(high, name) - getattr(low, name)) / (2 * step)
            given = getattr(v, f"d{name}")[i]
            np.testing.assert_allclose(given, slope, rtol=1e-5, atol=1e-7 * np.abs(slope).max() + 1e-30)
    assert isinstance(predictor.matrices(point)[0], Dual)


def deviations(n: int, seeds: range) -> np.ndarray:
    """Errors of the estimates of k_s and k_i, in standard deviations, (seeds, parameters)."""
    fits = [gbid.fit(loop(n), recorded(n, seed), focus="simulation") for seed in seeds]
    assert all(fit.success for fit in fits)
    assert all(fit.std[name] < 0.03 * fit.parameters[name] for fit in fits for name in fit.std if name.startswith("k_"))
    results = [name for name in fits[0].parameters if name.startswith("k_")]
    assert len(results) == 2 * n
    return np.array([[(fit.parameters[name] - true(n)[name]) / fit.std[name] for name in results] for fit in fits])


@pytest.mark.parametrize(("n", "seeds"), [(1, range(3)), (4, range(1))])
def test_stiffness_and_force_per_current_are_found_with_their_deviations(n, seeds):
    z = deviations(n, seeds)
    assert np.abs(z).max() < 4
    assert np.sqrt(np.mean(z**2)) < 1.7


def test_start_values_from_the_data_of_an_unstable_plant_are_near_the_truth():
    """The equation error of the first stage leads away from a start that is near: its polynomial has large poles."""
    result = gbid.fit(loop(4), recorded(4, 1), focus="simulation", start="data", max_iterations=1)
    off = [abs(result.start[name] / value - 1) for name, value in true(4).items() if name.startswith("k_")]
    assert max(off) < 0.05
    assert any("explains 98" in note for note in result.notes)


@pytest.mark.slow
@pytest.mark.parametrize("n", AXES)
def test_intervals_cover_the_truth(n):
    z = deviations(n, range(100, 140))
    assert np.mean(np.abs(z) < 1.96) > 0.9
    assert 0.5 < np.sqrt(np.mean(z**2)) < 1.2  # deviations from coloured residuals are rather too large
    assert np.abs(z.mean(0)).max() < 0.6  # no bias: four standard deviations of the mean of forty


def test_a_bearing_is_named_in_the_yaml(tmp_path):
    (tmp_path / "run.csv").write_text("w1,w2,p1,p2\n")
    gains = f"{SHOP['kd'] / T} * eye, -{SHOP['kp'] + SHOP['kd'] / T} * eye"
    lines = ["import numpy as np", "import gbid", "eye = np.eye(2)"]
    lines += [f"shop = gbid.LinearModel(0 * eye, eye, {gains}, dt={T})", ""]
    (tmp_path / "shop.py").write_text("\n".join(lines))
    (tmp_path / "experiment.yaml").write_text(
        """\
format: 1
name: bearing
import:
  recordings:
    - name: run
      file: run.csv
      sample_time_s: 0.0001
      signals:
        w: {columns: [w1, w2], unit: A, stored_unit: A, channels: [x, y]}
        p: {columns: [p1, p2], unit: m, channels: [x, y]}
fits:
  bearing:
    structure: magnetic_bearing
    options: {axes: [x, y], mass_kg: 4.0, k_s: 7.0e+5, k_i: 160.0, amplifier_hz: 1800.0, amplifier_delay_s: 2.0e-5,
              longest_delay_s: 2.0e-4, sensor_hz: 4000.0}
    loop: {controller: shop.py:shop, computation_samples: 0, pade_order: null}
    focus: simulation
"""
    )
    named = make_structure(load_experiment(tmp_path / "experiment.yaml"), "bearing")
    assert named.parameters == loop(2).parameters
    np.testing.assert_array_equal(evaluate(named, true(2)).A, evaluate(loop(2), true(2)).A)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: gbid.structure.RigidRotor(axes=("a", "b", "c")), "3 axes; choose from 1"),
        (lambda: gbid.structure.RigidRotor(axes=AXES[4]), "four axes need inertia_kg_m2 and arms_m"),
        (lambda: gbid.structure.RigidRotor(arms_m=(0.1, -0.1)), "are for four axes; there are 1"),
        (lambda: gbid.structure.RigidRotor(mass_kg=0.0), "mass_kg = 0.0; give a positive number"),
        (lambda: bearing(1, amplifier_hz=-1.0), "amplifier_hz = -1.0; give a positive number"),
        (lambda: bearing(1, amplifier_delay_s=1.0), "amplifier_delay_s = 1.0"),
        (lambda: bearing(1, outputs="i"), "choose ('p',) or ('i', 'p')"),
        (lambda: gbid.MagneticBearing(gbid.RotorBearing()), "has delays, feedthrough or disturbance gains"),
    ],
)
def test_wrong_options_are_one_line(make, words):
    with pytest.raises(UsageError) as caught:
        make()
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_exact_delays_in_a_loop_need_a_sampled_controller_and_bounds():
    continuous = gbid.LinearModel([[-1e3]], [[1e3]], [[-2e4]], [[0.0]])
    with pytest.raises(UsageError, match="exact delays of the plant need a sampled controller"):
        gbid.ClosedLoop(bearing(1), continuous, pade_order=None)
    free = gbid.LinearStructure(
        "late",
        [gbid.Parameter("tau", 1e-4, lower=0.0)],
        lambda p: {"A": [[-1.0]], "B": [[0.0]], "C": [[1.0]], "B_delayed": [[1.0]], "delay": [p.tau]},
    )
    with pytest.raises(UsageError, match="exact delays in a loop need upper bounds"):
        gbid.ClosedLoop(free, shop(1), pade_order=None)
