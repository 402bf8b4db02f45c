"""Goals on responses between named signals, against the same loop put together by python-control and in closed form."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import gbid
from gbid.control import (
    AxisSensitivity,
    DisturbanceSpectrum,
    FastestPole,
    MaxDamping,
    MinDamping,
    MinGainMargin,
    MinPhaseMargin,
    PeakResponse,
    RmsResponse,
    controller_model,
)
from gbid.control.controllers.structures import controller_structure
from gbid.control.tuning.goals import Goal, limits_of
from gbid.control.tuning.plants import ModelPlants, TuneOptions, plants_of
from gbid.control.tuning.problem import GainProblem
from gbid.core.errors import UsageError

ct = pytest.importorskip("control")
Gains = tuple[tuple[str, float], ...]
MASS, NEGATIVE_STIFFNESS, FORCE_GAIN, AMPLIFIER = 4.0, 2e5, 100.0, 6000.0
GAINS = np.array([3.2e4, 4e4])
HZ = np.linspace(1.0, 800.0, 4000)


def bearing(coupling: float = 0.0, name: str = "bearing") -> gbid.LinearModel:
    """Two axes of a magnetic bearing with amplifiers; states x, y, x', y', i_x, i_y; coupling by the speed."""
    A, B, C = np.zeros((6, 6)), np.zeros((6, 4)), np.eye(6)[[0, 1, 4, 5]]
    A[:2, 2:4] = np.eye(2)
    A[2:4, :2], A[2:4, 4:] = NEGATIVE_STIFFNESS / MASS * np.eye(2), FORCE_GAIN / MASS * np.eye(2)
    A[2, 3], A[3, 2] = coupling, -coupling
    A[4:, 4:], B[4:, :2], B[2:4, 2:] = -AMPLIFIER * np.eye(2), AMPLIFIER * np.eye(2), np.eye(2) / MASS
    return gbid.LinearModel(
        A,
        B,
        C,
        np.zeros((4, 4)),
        input_names=("c_x", "c_y", "f_x", "f_y"),
        output_names=("x", "y", "i_x", "i_y"),
        name=name,
    )


PD = controller_structure("PD", axes=("x", "y"))
CHANNELS = {"inputs": ("c_x", "c_y"), "outputs": ("x", "y")}
BOUNDS = {p.name: (-2e5, 0.0) if p.name.startswith("kappa") else (-4e5, 0.0) for p in PD.parameters}
VALUES = {p.name: -GAINS[0] if p.name.startswith("kappa") else -GAINS[1] for p in PD.parameters}

NOMINAL = tuple(VALUES.items())


def problem_of(
    goal: Goal, models: list[gbid.LinearModel], speeds_rpm: tuple[float, ...] | None = None
) -> tuple[GainProblem, np.ndarray]:
    plants = plants_of(models, PD, TuneOptions(**CHANNELS, speeds_rpm=speeds_rpm))
    assert isinstance(plants, ModelPlants)
    low, high = np.array([BOUNDS[p.name] for p in PD.parameters]).T
    family = plants.family(plants.points)
    problem = GainProblem((family,), limits_of([MaxDamping(), goal], plants.plant), low, high, 500.0)
    return problem, np.array([VALUES[p.name] for p in PD.parameters])


def excess(goal: Goal, *models: gbid.LinearModel, speeds_rpm: tuple[float, ...] | None = None) -> np.ndarray:
    problem, x = problem_of(goal, list(models), speeds_rpm)
    family = problem.families[0]
    state = problem.state(family, family.matrices(x), x)
    return np.max([measure.excess(state) for measure in problem.limits.measures], axis=0)


@cache
def judged(coupling: float, gains: Gains = NOMINAL) -> ct.StateSpace:
    """Loop of python-control: from disturbances of c, forces, and disturbances of x, y to outputs and commands."""
    G, law = bearing(coupling), controller_model(PD, dict(gains))
    plant = ct.ss(G.A, G.B, G.C, G.D, inputs=list(G.input_names), outputs=list(G.output_names), name="G")
    K = ct.ss(law.A, law.B, law.C, law.D, inputs=["s_x", "s_y"], outputs=["u_x", "u_y"], name="K")
    sums = [ct.summing_junction([f"u_{k}", f"w_{k}"], f"c_{k}") for k in "xy"]
    sums += [ct.summing_junction([k, f"d_{k}"], f"s_{k}") for k in "xy"]
    inputs = ["w_x", "w_y", "f_x", "f_y", "d_x", "d_y"]
    outputs = ["x", "y", "i_x", "i_y", "u_x", "u_y", "s_x", "s_y"]
    return ct.interconnect([plant, K, *sums], inputs=inputs, outputs=outputs)


def gain(
    coupling: float,
    sources: list[str],
    targets: list[str],
    hz: np.ndarray = HZ,
    gains: Gains = NOMINAL,
) -> np.ndarray:
    loop = judged(coupling, gains)
    rows, columns = [loop.output_labels.index(n) for n in targets], [loop.input_labels.index(n) for n in sources]
    response = loop(2j * np.pi * hz, squeeze=False)[rows][:, columns]
    return np.linalg.norm(response.transpose(2, 0, 1), 2, axis=(1, 2))


@pytest.mark.parametrize(
    ("sources", "targets", "own", "other"),
    [
        (("f_x", "f_y"), ("x", "y"), ["f_x", "f_y"], ["x", "y"]),  # compliance
        (("f_x",), ("i_x", "i_y"), ["f_x"], ["i_x", "i_y"]),  # currents, which the controller does not measure
        (("f_y",), ("c_y",), ["f_y"], ["u_y"]),  # the controller's command
        (("c_x", "f_y"), ("y", "c_x"), ["w_x", "f_y"], ["y", "u_x"]),  # disturbance of a command
        (("x",), ("x",), ["d_x"], ["s_x"]),  # S_o of an axis
        (("y",), ("i_y", "x"), ["d_y"], ["i_y", "x"]),
    ],
)
def test_a_response_between_named_signals_is_that_of_python_control(sources, targets, own, other):
    values = np.exp(excess(PeakResponse(sources=sources, targets=targets, limit=1.0), bearing(), bearing(90.0, "fast")))
    for coupling, value in zip((0.0, 90.0), values, strict=True):
        expected = gain(coupling, own, other).max()
        assert value == pytest.approx(expected, rel=5e-4)


def test_a_band_and_multiples_of_the_speed_take_their_frequencies_only():
    both = bearing(), bearing(90.0, "fast")
    path = {"sources": ("f_x", "f_y"), "targets": ("x", "y")}
    band = np.exp(excess(PeakResponse(**path, limit=1.0, low_hz=150.0, high_hz=300.0), *both))
    orders = np.exp(excess(PeakResponse(**path, limit=1.0, orders=(1.0, 2.0)), *both, speeds_rpm=(6000.0, 9000.0)))
    for coupling, speed, in_band, at_orders in zip((0.0, 90.0), (100.0, 150.0), band, orders, strict=True):
        inside = gain(coupling, ["f_x", "f_y"], ["x", "y"], np.linspace(150.0, 300.0, 2001)).max()
        assert in_band == pytest.approx(inside, rel=1e-6)
        exact = gain(coupling, ["f_x", "f_y"], ["x", "y"], speed * np.array([1.0, 2.0])).max()
        assert at_orders == pytest.approx(exact, rel=1e-9)


def test_an_unbalance_response_is_a_limit_with_two_breakpoints():
    # amplitude U w^2 |G| of one axis in closed form: m x'' = k_s x + k_i i + U w^2, i = a K x / (s + a)
    unbalance, largest, band = 2e-5, 1e-6, (20.0, 400.0)
    limit = [(hz, largest / (unbalance * (2 * np.pi * hz) ** 2)) for hz in band]
    goal = PeakResponse(sources=("f_x",), targets=("x",), limit=limit, low_hz=band[0], high_hz=band[1])
    s = 2j * np.pi * np.linspace(*band, 20001)
    law = controller_model(PD, VALUES)
    K = np.array([(law.C @ np.linalg.solve(v * np.eye(len(law.A)) - law.A, law.B) + law.D)[0, 0] for v in s])
    G = 1 / (MASS * s**2 - NEGATIVE_STIFFNESS - FORCE_GAIN * AMPLIFIER / (s + AMPLIFIER) * K)
    expected = (unbalance * np.abs(s) ** 2 * np.abs(G)).max() / largest
    assert np.exp(excess(goal, bearing()))[0] == pytest.approx(expected, rel=1e-6)


def test_the_rms_under_a_force_spectrum_is_that_of_a_lyapunov_equation():
    # force: white noise of density 3 N^2/Hz; the rms of x from the covariance of the loop's states
    loop = judged(90.0)
    B = loop.B[:, [loop.input_labels.index("f_x")]]
    row = loop.C[[loop.output_labels.index("x")]]
    expected = np.sqrt((row @ ct.lyap(loop.A, 3.0 / 2 * B @ B.T) @ row.T).item())
    white = DisturbanceSpectrum([0.0, 2e4], np.full((2, 1, 1), 3.0))
    goal = RmsResponse(sources=("f_x",), targets=("x",), limit=1.0, spectrum=white)
    assert np.exp(excess(goal, bearing(90.0)))[0] == pytest.approx(expected, rel=1e-3)


def test_the_sensitivity_of_an_axis_is_that_with_the_others_closed():
    values = np.exp(excess(AxisSensitivity(1.0), bearing(90.0)))[0]
    expected = max(gain(90.0, [f"d_{k}"], [f"s_{k}"]).max() for k in "xy")
    assert values == pytest.approx(expected, rel=5e-4)


@pytest.mark.parametrize(("whirl", "side"), [("forward", 1.0), ("backward", -1.0)])
def test_modes_of_one_direction_of_whirl_are_those_of_the_complex_equation(whirl, side):
    # z = x + j y of two equal axes: m (z'' + j c z') = k_s z + k_i i, of which roots above the real axis go forward
    c, w = 90.0, 2e3 * np.pi
    plain = np.polymul([1, 1j * c, -NEGATIVE_STIFFNESS / MASS], np.polymul([1, AMPLIFIER], [1, w]))
    law = FORCE_GAIN / MASS * AMPLIFIER * w * np.array([-1e-3 * GAINS[1], -GAINS[0]])
    roots = np.roots(np.polysub(plain, law))
    turning = roots[side * roots.imag > 1e-3 * np.abs(roots)]
    reached = 0.9 - excess(MinDamping(0.9, whirl=whirl), bearing(c))[0]
    assert reached == pytest.approx((-turning.real / np.abs(turning)).min(), rel=1e-6)
    fastest = (1 + excess(FastestPole(100.0, whirl=whirl, high_hz=200.0), bearing(c))[0]) * 100.0
    inside = np.abs(turning)[np.abs(turning) < 400 * np.pi]
    assert fastest == pytest.approx(inside.max() / (2 * np.pi), rel=1e-6)
    with pytest.raises(UsageError, match="x and y are needed"):
        MinDamping(0.1, whirl=whirl).measure(gbid.LinearModel([[-1.0]], [[1.0]], [[1.0]], [[0.0]]))


@pytest.mark.parametrize(
    "goal",
    [
        PeakResponse(sources=("f_x", "f_y"), targets=("i_x", "y"), limit=1e-5),
        PeakResponse(sources=("f_x",), targets=("x", "c_x"), limit=1e-5, orders=(1.0,)),
        AxisSensitivity(1.0),
        MinGainMargin(4.0),
        MinPhaseMargin(50.0),
        FastestPole(500.0),
        MinDamping(0.9, whirl="forward"),
    ],
)
def test_gradients_are_those_of_differences(goal):
    problem, x = problem_of(goal, [bearing(), bearing(90.0, "fast")], (4000.0, 5000.0))
    x = x * [1.0, 1.1, 0.9, 1.05]
    limits = {
        (f.kind, f.loop, round(f.place.real), round(f.place.imag)): f for f in problem.functions(x, window=30.0).limits
    }
    top = max((f for f in limits.values() if f.kind != "pole"), key=lambda f: f.value)

    def value(y: np.ndarray) -> float:
        family = problem.families[0]
        state = problem.state(family, family.matrices(y), y)
        return max(float(m.excess(state).max()) for m in problem.limits.measures)

    assert value(x) == pytest.approx(top.value, abs=1e-9)
    for i, size in enumerate(np.abs(x)):
        step = 1e-5 * size * np.eye(len(x))[i]
        slope = (value(x + step) - value(x - step)) / (2e-5 * size)
        assert size * top.slope[i] == pytest.approx(size * slope, rel=1e-3, abs=1e-5)


def test_a_design_keeps_a_compliance_that_binds():
    compliance = 3e-7
    few = {**CHANNELS, "starts": 0, "evaluations": 250}
    goals = [
        MaxDamping(),
        AxisSensitivity(gbid.control.ISO_LIMITS["A"]),
        PeakResponse(sources=("f_x", "f_y"), targets=("x", "y"), limit=compliance),
    ]
    design = gbid.tune(bearing(90.0), PD, goals=goals, bounds=BOUNDS, start=VALUES, **few)
    assert design.keeps_limits
    assert gain(90.0, ["f_x", "f_y"], ["x", "y"]).max() > 1.2 * compliance  # at the start
    reached = gain(90.0, ["f_x", "f_y"], ["x", "y"], HZ, tuple(design.gains.items())).max()
    assert reached <= compliance * (1 + 5e-4)
    assert reached >= 0.9 * compliance


def test_an_lpv_model_has_forces_on_the_rotor():
    # at rest the compliance of the open loop is the inverse of mass times k
    model = gbid.load_model("theisen2016")
    plants = plants_of(model, controller_structure("P"), TuneOptions(operating_points=[(6.0, 0.0)]))
    goal = PeakResponse(sources=("f_x", "f_y"), targets=("p_x", "p_y"), limit=1.0, high_hz=0.01)
    limits = limits_of([MaxDamping(), goal], plants.plant)
    problem = GainProblem((plants.family(plants.points),), limits, np.array([-1.0, -1.0]), np.ones(2), 500.0)
    family, x = problem.families[0], np.zeros(2)
    values = np.exp(problem.limits.measures[0].excess(problem.state(family, family.matrices(x), x)))[0]
    key = model.key_parameters(6.0, 0.0)
    K = np.array([[key["k_xx"], key["k_xy"]], [key["k_yx"], key["k_yy"]]])
    mass = model.machine.moving_mass_kg or 1.0
    assert values == pytest.approx(np.linalg.norm(np.linalg.inv(K), 2) / mass, rel=1e-3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"sources": ("g",), "targets": ("x",)}, "no source 'g'"),
        ({"sources": ("f_x",), "targets": ("f_y",)}, "no target 'f_y'"),
        ({"sources": ("i_x",), "targets": ("x",)}, "no source 'i_x'"),
    ],
)
def test_a_signal_that_is_not_there_is_named_with_those_that_are(arguments, words):
    with pytest.raises(UsageError, match=words):
        excess(PeakResponse(**arguments, limit=1.0), bearing())


def test_arguments_that_mean_nothing_are_refused():
    for wrong in ({"sources": ("f_x", "f_x")}, {"targets": ()}, {"orders": (0.0,)}, {"limit": -1.0}):
        with pytest.raises(UsageError, match=r"once|positive"):
            PeakResponse(**({"sources": ("f_x",), "targets": ("x",), "limit": 1.0} | wrong))
    force = DisturbanceSpectrum([0.0, 1.0], np.ones((2, 1, 1)))
    with pytest.raises(UsageError, match="1 channels for 2 sources"):
        excess(RmsResponse(sources=("f_x", "f_y"), targets=("x",), limit=1.0, spectrum=force), bearing())
    with pytest.raises(UsageError, match="give speeds_rpm= to tune"):
        excess(PeakResponse(sources=("f_x",), targets=("x",), limit=1.0, orders=(1.0,)), bearing())
