"""Controllers for rotors: tilt and translation, gyroscopic coupling, filters at the speed, state feedback."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gbid
from gbid.control import MaxDamping, PeakResponse, PeakSensitivity, controller_at, controller_model, state_feedback
from gbid.control.controllers.structures import controller_structure, scheduled, with_schedule
from gbid.core.errors import UsageError
from gbid.export import ChainInput, ChainOptions
from gbid.export.chain import chain_of
from gbid.export.chain_python import ChainMode, PythonChain
from gbid.lpv import Domain

HZ = np.array([3.0, 40.0, 120.0, 600.0])
S = 2j * np.pi * HZ
LOW = 1 / (1 + S / (2 * np.pi * 1000))
FOUR = ("x1", "x2", "y1", "y2")
SENSORS, ACTUATORS = (-0.12, 0.2), (-0.1, 0.15)
T = 1e-4


def response(structure: Any, gains: dict[str, float]) -> np.ndarray:
    return controller_model(structure, gains).frequency_response(HZ)


def some_gains(structure: Any) -> dict[str, float]:
    rng = np.random.default_rng(1)
    return {p.name: float(rng.uniform(p.lower, p.upper)) for p in structure.parameters}


def test_tilt_and_translation_act_on_force_and_moment_at_the_centre_of_mass():
    structure = controller_structure("P", axes=FOUR, sensors_m=SENSORS, actuators_m=ACTUATORS)
    gains = some_gains(structure)
    assert [*gains] == ["kappa_translation_x", "kappa_tilt_x", "kappa_translation_y", "kappa_tilt_y"]
    K = response(structure, gains)[1] / LOW[1]
    p = np.array([1.0, -0.3, 0.2, 0.7])
    for plane, axis in ((slice(0, 2), "x"), (slice(2, 4), "y")):
        centre, angle = np.linalg.solve([[1, SENSORS[0]], [1, SENSORS[1]]], p[plane])
        r1, r2 = (K @ p)[plane]
        assert r1 + r2 == pytest.approx(2 * gains[f"kappa_translation_{axis}"] * centre)
        lever, half = ACTUATORS[1] - ACTUATORS[0], (SENSORS[1] - SENSORS[0]) / 2
        moment = ACTUATORS[0] * r1 + ACTUATORS[1] * r2
        assert moment == pytest.approx(gains[f"kappa_tilt_{axis}"] * lever * half * angle)


def test_a_symmetric_rotor_with_equal_gains_of_tilt_and_translation_has_decentralised_control():
    planes = {"axes": FOUR, "sensors_m": (-0.1, 0.1), "actuators_m": (-0.2, 0.2)}
    tilting = controller_structure("PD", **planes, gain_sets=("",) * 4)
    plain = controller_structure("PD", axes=FOUR, gain_sets=("",) * 4)
    assert [p.name for p in tilting.parameters] == [p.name for p in plain.parameters] == ["kappa", "kd"]
    gains = some_gains(plain)
    np.testing.assert_allclose(response(tilting, gains), response(plain, gains), atol=1e-12)


def test_gyroscopic_coupling_gives_forward_and_backward_whirl_different_gains():
    structure = controller_structure("PD", coupling="gyroscopic", gain_sets=("", ""))
    gains = {"kappa": 0.4, "kappa_cross": 0.3, "kd": 0.2, "kd_cross": -0.1}
    K = response(structure, gains)
    direct, across = (gains[f"kappa{end}"] + 1e-3 * gains[f"kd{end}"] * S for end in ("", "_cross"))
    # p_x = 1, p_y = -j turns from x to y
    for turning, sign in ((np.array([1, -1j]), -1j), (np.array([1, 1j]), 1j)):
        expected = (direct + sign * across) * LOW
        np.testing.assert_allclose(K @ turning, expected[:, None] * turning, rtol=1e-12)


def test_gains_across_start_at_zero_and_share_the_poles_of_their_input():
    for kind in ("PI", "PID", "biquad", "notch", "lead-lag", "filter", "PPF"):
        structure = controller_structure(kind, coupling="gyroscopic")
        gains = {p.name: p.start for p in structure.parameters}
        assert all(p.lower <= p.start <= p.upper for p in structure.parameters)
        plain = controller_structure(kind)
        K = response(structure, gains)
        np.testing.assert_allclose(K, response(plain, {p.name: p.start for p in plain.parameters}), atol=1e-12)
        assert controller_model(structure, gains).n_states == controller_model(plain, gains_of(plain)).n_states


def gains_of(structure: Any) -> dict[str, float]:
    return {p.name: p.start for p in structure.parameters}


def test_a_derivative_with_a_filter_of_its_own_needs_no_lowpass():
    structure = controller_structure("PID", axes=("",), order=0, derivative_khz=(0.1, 3.0))
    gains = {"kappa": 0.7, "ki": -30.0, "kd": 0.4, "corner": 0.8}
    rate = S / (1 + S / (2e3 * np.pi * 0.8))
    expected = gains["kappa"] + gains["ki"] / S + 1e-3 * gains["kd"] * rate
    np.testing.assert_allclose(response(structure, gains)[:, 0, 0], expected, rtol=1e-12)


def test_a_notch_at_the_speed_is_in_series_with_its_axis():
    structure = with_schedule(controller_structure("PD", axes=("",), notch_orders=(1.0, 2.0), lowest_hz=5.0))
    gains = {"kappa": 0.7, "kd": 0.3, "speed_width_1": 0.2, "speed_depth_1": 0.1, "speed_width_2": 0.3}
    gains = {f"{name}_1": value for name, value in (gains | {"speed_depth_2": 0.0}).items()}
    K = controller_at(structure, gains, 5.0, 2400.0).frequency_response(HZ)[:, 0, 0]
    expected = (0.7 + 3e-4 * S) * LOW
    for order, width, depth in ((1, 0.2, 0.1), (2, 0.3, 0.0)):
        w = 2 * np.pi * np.hypot(40.0 * order, 5.0)
        expected = expected * (S**2 + 2 * depth * width * w * S + w**2) / (S**2 + 2 * width * w * S + w**2)
    np.testing.assert_allclose(K, expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"axes": ("x", "y", "z"), "sensors_m": SENSORS, "actuators_m": ACTUATORS}, "axes in pairs"),
        ({"axes": FOUR, "sensors_m": SENSORS}, "two different places"),
        ({"gain_sets": ("x",)}, "a name for each axis"),
        ({"axes": ("x", "y", "z"), "coupling": "gyroscopic"}, "as many in each direction"),
        ({"order": 0}, "order = 0; at least 1"),
        ({"derivative_khz": (2.0, 1.0)}, "lower first"),
    ],
)
def test_options_that_do_not_fit_are_refused(options: dict[str, Any], words: str):
    with pytest.raises(UsageError, match=words):
        controller_structure("PD", **options)
    with pytest.raises(UsageError, match="each of its gains changes its poles"):
        controller_structure("observer", coupling="gyroscopic")


# ---- From tune to the chain, for one to eight axes.


def rotor(axes: tuple[str, ...], rpm: float = 0.0) -> gbid.LinearModel:
    """Masses on negative springs, unit rate 100 rad/s, the two halves of the axes coupled by the speed."""
    n, half = len(axes), len(axes) // 2
    turn = np.zeros((n, n))
    turn[:half, n - half :], turn[n - half :, :half] = -np.eye(half), np.eye(half)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [2e3 * np.eye(n), 0.02 * rpm / 60 * turn]])
    B, C = np.vstack([np.zeros((n, n)), 1e4 * np.eye(n)]), np.hstack([np.eye(n), np.zeros((n, n))])
    return gbid.LinearModel(A, B, C, np.zeros((n, n)), output_names=axes, name=f"{rpm:g} rpm")


PLANES = {"sensors_m": (-0.1, 0.1), "actuators_m": (-0.1, 0.1)}
ROTOR_OPTIONS = {
    1: {"derivative_khz": (0.5, 3.0), "order": 0},
    2: {"coupling": "gyroscopic", "gain_sets": ("", "")},
    3: {"gain_sets": ("a", "a", "b")},
    4: {**PLANES, "coupling": "gyroscopic", "gain_sets": ("translation", "tilt") * 2},
    5: {"gain_sets": ("",) * 5},
    6: {"coupling": "gyroscopic", "gain_sets": ("",) * 6},
    7: {"gain_sets": ("a", "b") * 3 + ("c",)},
    8: {**PLANES, "gain_sets": ("translation", "tilt") * 4},
}


@pytest.mark.parametrize("n", ROTOR_OPTIONS)
def test_a_rotor_with_any_number_of_axes_goes_from_tune_to_the_chain(n: int, tmp_path: Path):
    axes = (
        tuple(f"{direction}{i}" for direction in "xyzw" for i in range(1, 3))[:n]
        if n % 2 == 0
        else tuple("abcdefg"[:n])
    )
    options = {"axes": axes, "feedback": "negative", "lowpass_hz": 2000.0, "upper": 3.0, "kd_limit_ms": 20.0}
    structure = controller_structure("PD", **options, **ROTOR_OPTIONS[n])
    start = {name: value for name, value in gains_of(structure).items() if "cross" in name or name.startswith("corner")}
    start = {p.name: 1.0 if p.name.startswith("kappa") else 10.0 for p in structure.parameters} | start
    few = {"starts": 0, "evaluations": 40, "start": start}
    plant = rotor(axes, 3000.0)
    result = gbid.tune(plant, structure, goals=[MaxDamping(), PeakSensitivity(2.5)], sample_time=T, **few)
    assert result.keeps_limits
    assert gbid.assess(plant, result).points[0].sampled_damping == pytest.approx(result.value, rel=1e-3)
    gbid.save_controller(tmp_path / "rotor.yaml", result, name="rotor")
    design = gbid.load_controller(tmp_path / "rotor.yaml")
    assert design.structure == structure
    chain = chain_of(design, options=chain_options(n))
    law, x = design.sampled_at(), np.zeros(design.sampled_at().n_states)
    running = PythonChain(chain)
    for _ in range(3):  # until its ramp has ended
        running.step(ChainInput((0.0,) * n, mode=ChainMode.CONTROL))
    for p in 1e-3 * np.random.default_rng(n).standard_normal((20, n)):
        expected = law.C @ x + law.D @ p
        x = law.A @ x + law.B @ p
        output = running.step(ChainInput(tuple(p), mode=ChainMode.CONTROL))
        np.testing.assert_allclose(output.stack, expected, rtol=1e-9, atol=1e-12)


def chain_options(n: int) -> ChainOptions:
    limits = {"limits": (1e3,) * n, "offsets": (0.0,) * n, "beyond": (1e3,) * n}
    return ChainOptions(ramp_s=T, fade_s=T, units=("m", "A"), **limits)


def test_models_of_several_speeds_get_a_filter_that_follows_them(tmp_path: Path):
    axes, speeds = ("x", "y"), (1200.0, 3000.0, 6000.0)
    plants = [rotor(axes, rpm) for rpm in speeds]
    options = {"feedback": "negative", "lowpass_hz": 2000.0, "upper": 3.0, "kd_limit_ms": 20.0, "gain_sets": ("", "")}
    structure = controller_structure("PD", axes=axes, notch_orders=(1.0,), **options)
    quiet = PeakResponse(sources=axes, targets=plants[0].input_names, limit=1.0, orders=(1.0,))
    start = {"kappa_1": 1.0, "kd_1": 10.0, "speed_width_1_1": 0.2, "speed_depth_1_1": 0.9}
    few = {"starts": 0, "evaluations": 150, "start": start}
    result = gbid.tune(plants, structure, goals=[MaxDamping(), quiet], speeds_rpm=speeds, **few)
    assert result.keeps_limits
    assert result.points == tuple((0.0, rpm) for rpm in speeds)
    for plant, point in zip(plants, result.points, strict=True):
        law = controller_at(result.controller, result.gains, *point)
        loop = gbid.sensitivities(plant, law)
        assert np.linalg.norm(loop.response("control", np.array([point[1] / 60]))[0], 2) < 1.001
        assert gbid.control.smallest_damping(loop.model("output")) >= result.value * (1 - 1e-6)
    assessed = gbid.assess(plants, result, sample_time=T)
    assert min(point.damping for point in assessed.points) == pytest.approx(result.value, rel=1e-6)
    design = gbid.save_controller(tmp_path / "notch.yaml", result, name="notch", sample_time=T)
    chain = chain_of(gbid.load_controller(tmp_path / "notch.yaml"), options=chain_options(2))
    assert chain.controller.is_scheduled
    # gains over the speed as well: no worse than constant ones, which are among them
    over = scheduled(controller_structure("PD", axes=axes, **options), ("1", "Omega"), Domain((0, 0), (1200, 6000)))
    follows = gbid.tune(
        plants,
        over,
        goals=[MaxDamping(), PeakSensitivity(2.5)],
        speeds_rpm=speeds,
        **few | {"start": {"kappa_1": 1.0, "kd_1": 10.0}},
    )
    assert follows.keeps_limits
    assert design.at(0.0, 3000.0).n_states == 6
    for wrong, words in ((None, "give speeds_rpm="), ((0.0,), "a speed for each")):
        with pytest.raises(UsageError, match=words):
            gbid.tune(plants, over, goals=[MaxDamping()], speeds_rpm=wrong)
    with pytest.raises(UsageError, match="belongs to linear models"):
        gbid.tune(gbid.load_model("theisen2016"), "P", speeds_rpm=(0.0,))


# ---- State feedback.


def test_state_feedback_starts_with_the_linear_quadratic_optimum_and_is_tuned():
    ct = pytest.importorskip("control")
    plant = rotor(("x", "y"), 3000.0)
    structure = state_feedback(plant, position=0.5)
    law = controller_model(structure, gains_of(structure))
    expected, *_ = ct.lqr(plant.A, plant.B, plant.C.T @ plant.C, 0.25 * np.eye(2))
    np.testing.assert_allclose(law.C, -expected, rtol=1e-8, atol=1e-10)
    loop = gbid.sensitivities(plant, law).model("output").poles()
    inner = law.A - plant.B @ law.C + law.B @ plant.C  # A of the plant
    np.testing.assert_allclose(inner, plant.A, atol=1e-8)
    parts = np.concatenate([np.linalg.eigvals(plant.A + plant.B @ law.C), np.linalg.eigvals(plant.A - law.B @ plant.C)])
    np.testing.assert_allclose(np.sort_complex(loop), np.sort_complex(parts), rtol=1e-6)
    assert {p.name for p in structure.parameters} == {
        f"{k}_x{i}" for k in ("feedback", "observer") for i in range(1, 5)
    }
    few = {"starts": 0, "evaluations": 40, "start": gains_of(structure)}
    result = gbid.tune(plant, structure, goals=[MaxDamping()], **few)
    before = gbid.control.smallest_damping(gbid.sensitivities(plant, law).model("output"))
    assert before > 0.5
    assert result.value > before + 0.05
    with pytest.raises(UsageError, match="no optimal feedback"):
        state_feedback(gbid.LinearModel([[1.0]], [[0.0]], [[1.0]], [[0.0]]), position=1.0)
