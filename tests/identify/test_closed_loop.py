"""Closed loops as structures: against a plain loop, sample by sample; against close_loop; slopes by differences."""

import numpy as np
import pytest
from fit_cases import MODE, MODE_AT, H, fit_data, levels, smooth
from scipy.linalg import expm

import gbid
from gbid.control.loop.close import sample_controller, sample_plant
from gbid.core.errors import DataError, UsageError
from gbid.identify.kernel.blocks import cut
from gbid.identify.kernel.linear import PortableLinearKernel
from gbid.identify.predictor import build_predictor
from gbid.structure import LinearModel, LinearStructure, Parameter, evaluate

LAG = LinearStructure(
    "lag",
    [Parameter("gain", 0.3), Parameter("pole", 20.0)],
    lambda p: {"A": [[-p.pole]], "B": [[p.pole]], "C": [[p.gain]], "D": [[0.1]]},
    "y",
    "u",
)
LAG_AT = {"gain": 0.3, "pole": 20.0}
VALUES = {**MODE_AT, "l1": 0.7, "l2": -0.4, **{f"controller_{name}": value for name, value in LAG_AT.items()}}


def at(predictor, values):
    return predictor.at(np.array([values[q.name] for q in predictor.free]))


def by_hand(w, y, x, focus, set_point, later=1):
    """Predictions of the mode with its sampled controller, one sample after the other."""
    plant, law = evaluate(MODE, VALUES), sample_controller(evaluate(LAG, LAG_AT), H)
    complete = expm(H * np.block([[plant.A, plant.B, plant.K], [np.zeros((2, 4))]]))[:2]
    x, z, waiting, computed = np.array(x), np.zeros(1), [np.zeros(1)] * later, []
    for now, seen in zip(w, y, strict=True):
        predicted = plant.C @ x
        heard = (seen if focus == "prediction" else predicted) - set_point * now
        waiting.append(law.C @ z + law.D @ heard)
        z = law.A @ z + law.B @ heard
        error = (seen - predicted) * (focus == "prediction")
        x = complete @ np.concatenate([x, waiting.pop(0) + now * (not set_point), error])
        computed.append(predicted)
    return np.array(computed)


@pytest.mark.parametrize("focus", ["prediction", "simulation"])
@pytest.mark.parametrize(("injected", "later"), [("plant input", 1), ("set point", 0), ("plant input", 2)])
def test_sampled_loop_is_that_of_a_plain_loop(focus, injected, later):
    w, y = smooth(80, 1, seed=1), smooth(80, 1, seed=2)
    loop = gbid.ClosedLoop(MODE, LAG, sample_time=H, computation_samples=later, injected=injected)
    predictor = build_predictor(loop, {}, H, "zoh", focus)
    blocks = cut(fit_data([(w, y)], H), predictor, None)
    begin = np.concatenate([[0.4, -1.0], np.zeros(1 + later)])
    error = blocks.by_segment(PortableLinearKernel().predict(at(predictor, VALUES), blocks, begin[None]).errors)[0]
    expected = by_hand(w, y, begin[:2], focus, injected == "set point", later)
    np.testing.assert_allclose(y - error, expected, rtol=1e-10, atol=1e-12)
    if focus == "simulation":
        model = evaluate(loop, VALUES)
        np.testing.assert_allclose(model.simulate(w, initial_state=begin), expected, rtol=1e-10, atol=1e-12)


def test_derivatives_of_a_sampled_loop_by_plant_and_gains():
    predictor = build_predictor(gbid.ClosedLoop(MODE, LAG, sample_time=H), {}, H, "zoh", "prediction")
    v = at(predictor, VALUES)
    for i, q in enumerate(predictor.free):
        step = 1e-6 * max(abs(VALUES[q.name]), 1.0)
        high, low = (at(predictor, {**VALUES, q.name: VALUES[q.name] + sign * step}) for sign in (1, -1))
        for name in ("F", "G", "C", "H"):
            slope = (getattr(high, name) - getattr(low, name)) / (2 * step)
            np.testing.assert_allclose(getattr(v, f"d{name}")[i], slope, rtol=1e-5, atol=1e-7, err_msg=q.name + name)


def test_loops_are_those_of_close_loop():
    plant, law = evaluate(MODE, VALUES, ("u",), ("y",)), evaluate(LAG, LAG_AT, ("y",), ("u",))
    continuous = gbid.close_loop(plant, law)
    model = evaluate(gbid.ClosedLoop(MODE, law), VALUES)
    f = np.geomspace(0.01, 4.0, 9)
    np.testing.assert_allclose(model.frequency_response(f), continuous.frequency_response(f), rtol=1e-10)
    # close_loop computes behind the excitation, a target before: the same but for one sample of the excitation
    sampled = gbid.close_loop(sample_plant(plant, H, H), sample_controller(law, H))
    model = evaluate(gbid.ClosedLoop(MODE, sample_controller(law, H)), VALUES)
    late = np.exp(-2j * np.pi * f * H)[:, None, None]
    np.testing.assert_allclose(late * model.frequency_response(f), sampled.frequency_response(f), rtol=1e-9)
    assert model.dt == H


def test_exact_delays_in_a_loop_become_filters():
    def late(p):
        return {**MODE.matrices(p), "B": [[0], [0]], "B_delayed": MODE.matrices(p)["B"], "delay": [[0.15]]}

    exact = LinearStructure("late", MODE.parameters, late, "u", "y")
    loop = gbid.ClosedLoop(exact, evaluate(LAG, LAG_AT), pade_order=6)
    f = np.geomspace(0.01, 2.0, 9)
    G, K = (evaluate(s, v).frequency_response(f) for s, v in ((exact, VALUES), (LAG, LAG_AT)))
    np.testing.assert_allclose(evaluate(loop, VALUES).frequency_response(f), G / (1 - G * K), rtol=1e-6)


def test_unknown_gain_is_estimated_along_and_its_mode_has_a_standard_deviation():
    truth = {**VALUES, "l1": 0.0, "l2": 0.0}
    loop = gbid.ClosedLoop(MODE, LAG, sample_time=H)
    w = levels(1500)
    y = evaluate(loop, truth).simulate(w)
    rng = np.random.default_rng(0)
    recording = gbid.Recording({"w": w, "y": y + 1e-3 * rng.standard_normal(y.shape)}, H)
    result = gbid.fit(
        loop, recording, focus="simulation", fixed={"controller_pole": 20.0, "l1": 0.0, "l2": 0.0}, start=truth
    )
    assert result.success
    for name in result.free:
        assert abs(result.parameters[name] - truth[name]) < 4 * result.std[name]
    shifted = result.model.modes()[0]
    np.testing.assert_allclose(shifted, evaluate(loop, truth).modes()[0], atol=4 * result.modes_std[0].max())
    assert 0 < result.modes_std[0, 1] < 1e-2


def test_a_sampled_loop_with_missing_outputs_is_refused_in_prediction():
    w, loop = levels(200), gbid.ClosedLoop(MODE, LAG, sample_time=H)
    y = evaluate(loop, VALUES).simulate(w)[:, 0]
    y[50:53] = np.nan
    with pytest.raises(UsageError, match="a loop with a sampled controller takes missing outputs"):
        gbid.fit(loop, gbid.Recording({"w": w, "y": y}, H), focus="prediction", start=VALUES, window=None)


def test_what_does_not_fit_is_refused():
    law = evaluate(LAG, LAG_AT)
    with pytest.raises(UsageError, match="takes 1 signals and makes 1"):
        gbid.ClosedLoop(gbid.Plant(), law)
    with pytest.raises(UsageError, match="but the controller has"):
        gbid.ClosedLoop(MODE, sample_controller(law, H), sample_time=2 * H)
    with pytest.raises(UsageError, match="the recordings are sampled at"):
        build_predictor(gbid.ClosedLoop(MODE, law, sample_time=2 * H), {}, H, "zoh", "prediction")
    direct = LinearStructure("direct", MODE.parameters, lambda p: {**MODE.matrices(p), "D": [[0.1]]}, "u", "y")
    with pytest.raises(UsageError, match="both have direct feedthrough"):
        gbid.ClosedLoop(direct, law)
    assert isinstance(gbid.ClosedLoop(direct, law, sample_time=H).controller_model(), LinearModel)


def test_errors_that_come_back_in_the_input_are_noted():
    """Noise with a memory, fed back by a controller: simulation is biased and says so, others are not."""
    truth = {**MODE_AT, "l1": 3.0, "l2": 8.0}
    plant, rng = evaluate(MODE, truth).discretise(H), np.random.default_rng(3)
    results = {}
    for gain in (0.0, 0.3):
        w, x, last = levels(2500), np.zeros(2), 0.0
        signals = {name: np.zeros((len(w), 1)) for name in "uyw"}
        for k in range(len(w)):
            e = 1.0 * rng.standard_normal()
            y, u = plant.C[0] @ x + e, w[k, 0] + last
            signals["u"][k], signals["y"][k], signals["w"][k] = u, y, w[k, 0]
            x, last = plant.A @ x + plant.B[:, 0] * u + plant.K[:, 0] * e, gain * y
        results[gain] = gbid.Recording(signals, H)
    held = {"l1": 0.0, "l2": 0.0}
    noted = {
        name: any("GB121" in note for note in gbid.fit(structure, results[gain], start=truth, **options).notes)
        for name, gain, structure, options in (
            ("open", 0.0, MODE, {"focus": "simulation"}),
            ("naive", 0.3, MODE, {"focus": "simulation"}),
            ("direct", 0.3, MODE, {}),
            ("indirect", 0.3, gbid.ClosedLoop(MODE, _gain(0.3)), {"focus": "simulation", "fixed": held}),
        )
    }
    assert noted == {"open": False, "naive": True, "direct": False, "indirect": False}


def _gain(value):
    none = np.zeros((0, 0))
    return LinearModel(none, np.zeros((0, 1)), np.zeros((1, 0)), np.array([[value]]), dt=H, name="gain")


def test_states_that_are_soon_forgotten_begin_at_rest():
    """What is at rest decays in 0.1 s; actuators that u shows, the motion, and an integrating controller do not."""
    corner, none = 2000.0 * np.eye(2), np.zeros((2, 2))
    low_pass = LinearModel(-corner, corner, 0.3 * np.eye(2), none, name="low-pass")
    integral = LinearModel(none, np.eye(2), np.eye(2), none, name="integral")
    exact, paper = gbid.RotorBearing(), gbid.RotorBearing(pade_order=1)
    at_rest = {
        "exact, u and p": gbid.ClosedLoop(gbid.Plant(exact), low_pass),  # 4 + 4 late + 4, 6 of delays, 2
        "exact, p": gbid.ClosedLoop(gbid.Plant(exact, outputs=("p",)), low_pass),  # 4 late + 4, 6, 2
        "exact, p, integral": gbid.ClosedLoop(gbid.Plant(exact, outputs=("p",)), integral),
        "Pade, p": gbid.ClosedLoop(gbid.Plant(paper, outputs=("p",)), low_pass),  # 4 + 4 + 2 of delays, 2
        "Pade": gbid.ClosedLoop(gbid.Plant(paper), low_pass),
    }
    assert {name: list(loop.forgotten_states) for name, loop in at_rest.items()} == {
        "exact, u and p": [4, 5, 6, 7, *range(12, 18)],
        "exact, p": [0, 1, 2, 3, *range(8, 16)],
        "exact, p, integral": [0, 1, 2, 3, *range(8, 14)],
        "Pade, p": [0, 1, 2, 3, *range(8, 12)],
        "Pade": [8, 9],
    }


LEVITATION = {"a": 900.0, "d": 5.0, "b": 40.0}


def levitated(seed, n=2000, h=2e-3):
    """A magnetic levitation, held by a PD controller that acts one sample later: sample by sample, without gbid."""
    random = np.random.default_rng(seed)
    w = 20.0 * np.repeat(random.choice([-1.0, 1.0], n // 10), 10)
    step = expm(h * np.array([[0, 1, 0], [LEVITATION["a"], -LEVITATION["d"], LEVITATION["b"]], [0, 0, 0]]))
    corner, kp, kd = 400.0, 60.0, 2.0
    slow = 1 / (1 + h * corner / 2)  # trapezoidal rule, by hand
    x, z, force, y, r = np.zeros(2), 0.0, 0.0, np.zeros(n), np.zeros(n)
    for k in range(n):
        y[k] = x[0] + 0.01 * random.normal()
        u, force = w[k] + force, kd * corner * slow * z - (kp + kd * corner * (1 - h * corner * slow / 2)) * y[k]
        r[k] = u
        z = (2 * slow - 1) * z + h * slow * corner * y[k]
        x = step[:2, :2] @ x + step[:2, 2] * u + 0.01 * random.normal(size=2) * [0.1, 1.0]
    controller = LinearModel(
        np.array([[-corner]]), np.array([[corner]]), np.array([[kd * corner]]), np.array([[-kp - kd * corner]])
    )
    return gbid.Recording({"w": w, "r": r, "y": y}, h, name=f"levitated {seed}"), controller


def levitation(away=1.0):
    start = {name: value * away for name, value in LEVITATION.items()}
    return LinearStructure(
        "levitation",
        [*(Parameter(name, value) for name, value in start.items()), Parameter("g1", 0.0), Parameter("g2", 0.0)],
        lambda p: {
            "A": [[0, 1], [p.a, -p.d]],
            "B": [[0], [p.b]],
            "C": [[1, 0]],
            "K": [[p.g1], [p.g2]],
        },
        "r",
        "y",
    )


@pytest.mark.parametrize("away", [1.0, 1.4])
def test_loop_of_an_unstable_plant_starts_without_a_disturbance_gain(away):
    """Prediction of an unstable plant needs a gain: that of an observer of the plant."""
    plant = levitation(away)
    for seed in range(3):
        recording, controller = levitated(seed)
        loop = gbid.ClosedLoop(plant, controller, sample_time=recording.sample_time, inputs="w", outputs="y")
        result = gbid.fit(loop, recording, focus="prediction")
        assert result.success
        assert any("GB112" in note for note in result.notes)
        for name, true in LEVITATION.items():
            assert abs(result.parameters[name] - true) < 3.5 * result.std[name]


def test_unstable_plant_is_not_simulated_in_cross_validation():
    """It printed fits of -1e30 %; the loop around the plant is stable, and can be validated."""
    (first, controller), (second, _) = levitated(0), levitated(1)
    plant = gbid.fit(levitation(), first, inputs="r")
    assert plant.success
    with pytest.raises(DataError, match="unstable: not simulated on recording 'levitated 1'"):
        gbid.cross_validate(plant, second)
    loop = gbid.ClosedLoop(levitation(), controller, sample_time=first.sample_time, inputs="w", outputs="y")
    assert gbid.cross_validate(gbid.fit(loop, first), second).fit_percent[0] > 90
