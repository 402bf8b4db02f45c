"""Every built-in structure: its transfer function, loops that are stable at the start, files, and other axes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import gbid
from gbid.control import MaxDamping, PeakSensitivity, close_loop, controller_at, controller_model
from gbid.control.controllers.built_in import built_in_structures
from gbid.control.controllers.structures import controller_structure, with_schedule
from gbid.control.tuning.plants import checked_models
from gbid.core.errors import UsageError

MODEL = gbid.load_model("theisen2016")
S = 2j * np.pi * np.array([3.0, 40.0, 120.0, 600.0])
ARM = gbid.LinearModel([[0.0, 1.0], [-100.0, -0.4]], [[0.0], [100.0]], [[1.0, 0.0]], [[0.0]])
ARM_PD = controller_structure("PD", axes=("",), lower=-2.0, upper=0.9, kd_limit_ms=60.0, lowpass_hz=20.0)
LOW = 1 / (1 + S / (2 * np.pi * 1000))


def section(b: list[float], khz: float, zeta: float) -> np.ndarray:
    w = 2e3 * np.pi * khz
    return (b[2] * S**2 + b[1] * w * S + b[0] * w**2) / (S**2 + 2 * zeta * w * S + w**2)


def observer(l1: float, l2: float, f1: float, f2: float, khz: float) -> np.ndarray:
    w, zeta = 2e3 * np.pi * khz, 0.1
    A = w * np.array([[-l1, 1.0], [f1 - 1 - l2, f2 - 2 * zeta]])
    return np.array([[f1, f2] @ np.linalg.solve(s * np.eye(2) - A, w * np.array([l1, l2])) for s in S])


def of_order_five(g: dict[str, float]) -> np.ndarray:
    w = 2e3 * np.pi * g["corner"]
    one = section([g["b0_1"], g["b1_1"], g["b2_1"]], g["frequency_1"], g["damping_1"])
    two = section([1.0, g["b1_2"], g["b2_2"]], g["frequency_2"], g["damping_2"])
    return one * two * (g["c"] * S + w) / (S + w)


FORMULAS = {
    "P": lambda g: g["kappa"] * LOW,
    "PD": lambda g: (g["kappa"] + 1e-3 * g["kd"] * S) * LOW,
    "PI": lambda g: (g["kappa"] + g["ki"] / S) * LOW,
    "PID": lambda g: (g["kappa"] + g["ki"] / S + 1e-3 * g["kd"] * S) * LOW,
    "PPF": lambda g: section([g["kappa"], 0, 0], g["frequency"], g["damping"]),
    "biquad": lambda g: section([g["b0"], g["b1"], g["b2"]], g["frequency"], g["damping"]),
    "filter": of_order_five,
    "lead-lag": lambda g: (
        (g["high"] * S + g["low"] * 2e3 * np.pi * g["corner"]) / (S + 2e3 * np.pi * g["corner"]) * LOW
    ),
    "notch": lambda g: g["kappa"] * section([1, 2 * g["depth"] * g["width"], 1], g["frequency"], g["width"]) * LOW,
    "observer": lambda g: observer(g["l1"], g["l2"], g["f1"], g["f2"], g["frequency"]),
    "resonant": lambda g: (
        g["kappa"] * LOW + section([g["sine"], g["cosine"], 0], np.hypot(20.0, 3000 / 60) / 1e3, g["width"])
    ),
    "full P": lambda g: g["kappa"] * LOW,
    "full PD": lambda g: (g["kappa"] + 1e-3 * g["kd"] * S) * LOW,
    "full biquad": lambda g: section([g["b0"], g["b1"], g["b2"]], g["frequency"], g["damping"]),
}


def structure(kind: str) -> object:
    options = {"filter_order": 5} if kind == "filter" else {}
    return with_schedule(controller_structure(kind, **options), MODEL.domain)


def some_gains(kind: str, seed: int = 3) -> dict[str, float]:
    rng = np.random.default_rng(seed)
    return {p.name: float(rng.uniform(p.lower, p.upper)) for p in structure(kind).parameters}


def own(gains: dict[str, float], to: str, of: str) -> dict[str, float]:
    """Gains by plain name of one entry of the transfer matrix."""
    plain = {name.removesuffix("_1") if name.endswith(f"_{of}_1") else name: value for name, value in gains.items()}
    results = {name.removesuffix(f"_{of}"): value for name, value in plain.items() if name.endswith(f"_{of}")}
    return results | {name.removesuffix(f"_{to}{of}"): v for name, v in plain.items() if name.endswith(f"_{to}{of}")}


def test_every_structure_is_in_the_table() -> None:
    assert set(FORMULAS) == set(built_in_structures())


@pytest.mark.parametrize("kind", FORMULAS)
def test_transfer_function(kind: str) -> None:
    gains = some_gains(kind)
    K = controller_at(structure(kind), gains, 5.0, 3000.0).frequency_response(S.imag / (2 * np.pi))
    for i, to in enumerate("xy"):
        for j, of in enumerate("xy"):
            expected = FORMULAS[kind](own(gains, to, of)) if i == j or kind.startswith("full") else 0 * S
            np.testing.assert_allclose(K[:, i, j], expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", FORMULAS)
def test_loops_are_stable_at_the_start(kind: str) -> None:
    form = structure(kind)
    assert all(p.lower <= p.start <= p.upper for p in form.parameters)
    for point in MODEL.operating_points:
        K = controller_at(form, {p.name: p.start for p in form.parameters}, *point)
        assert close_loop(MODEL.plant_at(*point), K).is_stable(), point


def test_bounds_of_full_pd_are_symmetric_and_checked() -> None:
    form = controller_structure("full PD", kd_limit_ms=2.0)
    kappas = {(p.lower, p.upper) for p in form.parameters if p.name.startswith("kappa")}
    assert kappas == {(-3.0, 3.0)}
    assert form.kd_limit_ms != controller_structure("full PD").kd_limit_ms == controller_structure("PD").kd_limit_ms
    for wrong in ({"lowpass_hz": -1.0}, {"axes": ("x", "x")}):
        with pytest.raises(UsageError):
            controller_structure("full PD", **wrong)


def test_chosen_channels_keep_their_delay() -> None:
    two = gbid.LinearModel(
        [[-2.0]], [[0.0, 0.0]], [[1.0]], [[0.0, 0.0]], B_delayed=[[1.0, 5.0]], delay=[0.1, 0.3],
        input_names=("a", "b"), output_names=("p",),
    )  # fmt: skip
    (plant,) = checked_models([two], controller_structure("P", axes=("",)), ["b"], None)
    assert (plant.input_names, plant.output_names) == (("b",), ("p",))
    np.testing.assert_array_equal(plant.B_delayed, [[5.0]])
    np.testing.assert_array_equal(plant.delay, [0.3])


def test_one_axis_has_plain_names() -> None:
    form = controller_structure("PD", axes=("",))
    assert [p.name for p in form.parameters] == ["kappa", "kd"]
    assert (form.inputs, form.outputs) == (("p",), ("r",))
    model = controller_model(form, {"kappa": 1.0, "kd": 0.5})
    assert model.D.shape == (1, 1)
    assert model.input_names == ("p",)
    three = controller_structure("full P", axes=("x", "y", "z"))
    assert len(three.parameters) == 9


def test_a_plant_with_one_input_and_other_names_is_tuned() -> None:
    arm, form = replace(ARM, input_names=("torque",), output_names=("angle",)), ARM_PD
    for sample_time in (None, 5e-3):
        result = gbid.tune(arm, form, goals=[MaxDamping(), PeakSensitivity(1.5)], inputs=["torque"], outputs=["angle"],
                           sample_time=sample_time)  # fmt: skip
        assert result.success
        assert 0.2 < result.value < 0.9
        K = controller_model(form, result.gains)
        if sample_time is None:
            assert gbid.control.smallest_damping(close_loop(arm, K_named(K, arm))) == pytest.approx(
                result.value, abs=1e-6
            )
        else:
            run = gbid.control.sampled_loop(arm, K_named(K, arm), sample_time)
            assert run.damping == pytest.approx(result.value, rel=1e-6)


def K_named(K: gbid.LinearModel, plant: gbid.LinearModel) -> gbid.LinearModel:
    return replace(K, input_names=plant.output_names, output_names=plant.input_names)


def test_a_list_of_models_is_designed_for_all_of_them() -> None:
    points = [(3.0, 0.0), (7.0, 6000.0)]
    many = gbid.tune([MODEL.plant_at(*p) for p in points], "P", goals=[MaxDamping(), PeakSensitivity(2.0)])
    lpv = gbid.tune(MODEL, "P", goals=[MaxDamping(), PeakSensitivity(2.0)], operating_points=points)
    assert many.value == pytest.approx(lpv.value, abs=1e-7)
    assert many.gains == pytest.approx(dict(lpv.gains), abs=1e-5)
    drawn = gbid.tune([MODEL, MODEL], "P", goals=[MaxDamping(), PeakSensitivity(2.0)], operating_points=points)
    assert drawn.value == pytest.approx(lpv.value, abs=1e-7)


def test_direct_feedthrough_of_a_plant_is_part_of_the_loop() -> None:
    plant, form = replace(ARM, D=np.array([[0.2]])), ARM_PD
    result = gbid.tune(plant, form, goals=[MaxDamping(), PeakSensitivity(2.0)])
    loop = gbid.sensitivities(plant, K_named(controller_model(form, result.gains), plant))
    assert gbid.control.smallest_damping(loop.model("output")) == pytest.approx(result.value, abs=1e-6)
    assert loop.peak("output").value == pytest.approx(result.peak_sensitivity, rel=1e-6)
