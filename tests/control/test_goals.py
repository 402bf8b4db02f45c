"""Goals as values: each against the analysis of the loop, its gradient against differences, and in a design."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import gbid
from gbid.control import (
    DisturbanceSpectrum,
    HalfSine,
    MaxDamping,
    MaxDecay,
    MinDamping,
    MinDiskMargin,
    MinGainMargin,
    MinPhaseMargin,
    PeakComplementary,
    PeakControl,
    PeakSensitivity,
    PiezoTravel,
    RmsControl,
    RmsPosition,
    RollOff,
    SlowestPole,
    StaticAmplification,
    controller_at,
    disk_margin,
    disk_margins_by_loop,
    loop_margins,
    recorded_disturbance,
    sample_controller,
    sensitivities,
    static_amplification,
)
from gbid.control.controllers.structures import controller_structure
from gbid.control.loop.close import sample_plant
from gbid.control.tuning.goals import Goal, limits_of
from gbid.control.tuning.plants import LpvPlants, TuneOptions, plants_of
from gbid.control.tuning.problem import GainProblem
from gbid.core.errors import UsageError

MODEL = gbid.load_model("theisen2016")
ONE = [(6.0, 0.0)]
TWO = [(6.0, 0.0), (3.0, 6000.0)]
BIQUAD = controller_structure("biquad")
GAINS = np.array([0.7, 0.5, 0.8, 0.9, 0.1, -0.1, 0.15, 0.25, 0.7, 0.6])
T = 2e-4


def spectrum() -> DisturbanceSpectrum:
    f = np.linspace(0.0, 1000.0, 2001)
    size = 1e-14 * (1 + 40 * np.exp(-(((f - 50) / 2) ** 2)))
    return DisturbanceSpectrum(f, size[:, None, None] * np.array([[1.0, 0.2], [0.2, 2.0]]))


def problem_of(goal: Goal, sampled: bool = False) -> tuple[GainProblem, LpvPlants]:
    design = plants_of(MODEL, BIQUAD, TuneOptions(operating_points=TWO, sample_time=T if sampled else None))
    family = design.family(design.points)
    low, high = np.array([(p.lower, p.upper) for p in BIQUAD.parameters]).T
    limits = limits_of([MaxDamping(), goal], design.plant)
    return GainProblem((family,), limits, low, high, 500.0), design


def excess(goal: Goal, sampled: bool = False) -> np.ndarray:
    problem, _ = problem_of(goal, sampled)
    family = problem.families[0]
    return problem.limits.measures[0].excess(problem.state(family, family.matrices(GAINS), GAINS))


@cache
def loops(sampled: bool = False) -> list[gbid.control.Sensitivities]:
    results = []
    for point in TWO:
        K = controller_at(BIQUAD, dict(zip((p.name for p in BIQUAD.parameters), GAINS, strict=True)), *point)
        G = MODEL.plant_at(*point)
        if sampled:
            G, K = sample_plant(gbid.control.exact_plant(MODEL, *point), T, T), sample_controller(K, T)
        results.append(sensitivities(G, K))
    return results


GRID = np.union1d([0.0, 10.0, 100.0, 400.0], np.geomspace(0.1, 2400, 6001))


def largest(loop: gbid.control.Sensitivities, which: str, bound: object = None) -> float:
    sizes = np.linalg.norm(loop.response(which, GRID), 2, axis=(1, 2))
    return float((sizes / (1.0 if bound is None else bound(GRID))).max())


def rms(loop: gbid.control.Sensitivities, which: str) -> float:
    d = spectrum()
    M = loop.response(which, d.frequency_hz)
    power = np.einsum("kij,kjl,kil->k", M, d.density, M.conj()).real
    return float(np.sqrt((power * d.widths).sum()))


def slope(hz: np.ndarray) -> np.ndarray:
    return np.exp(np.interp(np.log(np.maximum(hz, 1e-9)), np.log([10.0, 100.0, 400.0]), np.log([0.9, 2.0, 1.2])))


RECORDED = gbid.Recording({"p": np.zeros((100, 2))}, T)
BREAKPOINTS = [(10.0, 0.9), (100.0, 2.0), (400.0, 1.2)]
CASES = {
    "T_o": (PeakComplementary(1.5), lambda q: np.log(largest(q, "complementary") / 1.5)),
    "K S_o soft": (PeakControl(2.0, soft=True, weight=3.0), lambda q: np.log(3 * largest(q, "control") / 2.0)),
    "breakpoints": (PeakSensitivity(BREAKPOINTS), lambda q: np.log(largest(q, "output", slope))),
    "static": (StaticAmplification(2.0, soft=True), lambda q: np.log(static_amplification(q) / 2.0)),
    "disk": (MinDiskMargin(0.5), lambda q: np.log(0.5 / disk_margin(q).alpha)),
    "disk of x": (MinDiskMargin(0.6, channel=0), lambda q: np.log(0.6 / disk_margins_by_loop(q)[0].alpha)),
    "disk of y": (MinDiskMargin(0.6, channel=1), lambda q: np.log(0.6 / disk_margins_by_loop(q)[1].alpha)),
    "phase": (MinPhaseMargin(40.0), lambda q: np.log(40 / min(m.phase_deg for m in loop_margins(q)))),
    "gain": (
        MinGainMargin(1.7),
        lambda q: np.log(np.log(1.7) / min(abs(np.log(g)) for m in loop_margins(q) for g in m.gain if g > 0)),
    ),
    "rms p": (RmsPosition(1e-6, spectrum()), lambda q: np.log(rms(q, "output") / 1e-6)),
    "rms r": (RmsControl(1e-6, spectrum()), lambda q: np.log(rms(q, "control") / 1e-6)),
}


@pytest.mark.parametrize("sampled", [False, True], ids=["continuous", "sampled"])
@pytest.mark.parametrize("case", CASES)
def test_excess_is_that_of_the_analysis(case: str, sampled: bool) -> None:
    goal, known = CASES[case]
    tolerance = 5e-3 if case.startswith("rms") else 2e-4
    np.testing.assert_allclose(excess(goal, sampled), [known(q) for q in loops(sampled)], atol=tolerance)


def test_roll_off_limits_high_frequencies_only() -> None:
    goal = RollOff(300.0, 0.4, slope_db=3.0)
    bound = lambda f: np.where(f < 300, np.inf, 0.4 * (300 / np.maximum(f, 1)) ** 0.15)  # noqa: E731
    expected = [np.log(largest(q, "control", bound)) for q in loops()]
    np.testing.assert_allclose(excess(goal), expected, atol=1e-3)


def test_a_transfer_function_is_a_limit() -> None:
    a = 2 * np.pi * 80
    lead = gbid.LinearModel([[-4 * a]], [[1.0]], [[-6 * a]], [[2.0]])  # 2 (s + a) / (s + 4 a)
    gain = np.abs(2 * (2j * np.pi * GRID + a) / (2j * np.pi * GRID + 4 * a))
    expected = [np.log(largest(q, "output", lambda f: gain)) for q in loops()]
    np.testing.assert_allclose(excess(PeakSensitivity(lead)), expected, atol=2e-4)


@pytest.mark.parametrize("rate", [2e-3, 100.0, 3e6])
def test_goals_on_any_time_scale_see_narrow_limits(rate: float) -> None:
    """A light mode of a slow, a usual and a fast plant; a limit with a dip of 4 % width, and one with a step."""
    unit, zeta = rate / (2 * np.pi), 0.01
    plant = gbid.LinearModel(rate * np.array([[0, 1], [-1, -2 * zeta]]), [[0], [rate]], [[0.5, 0]], [[0]], name="slow")
    form = controller_structure("lead-lag", axes=("",), lowpass_hz=10 * unit, corner_khz=(1e-4 * unit, 1e-2 * unit))
    gains = np.array([-0.8, -0.2, 3e-3 * unit])
    design = plants_of(plant, form, TuneOptions())
    family = design.family(design.points)
    low, high = np.array([(p.lower, p.upper) for p in form.parameters]).T
    w = 2j * np.pi * unit * np.geomspace(1e-3, 1e4, 400_001)
    hz = np.abs(w) / (2 * np.pi)
    K = (-0.2 * w - 0.8 * 3 * rate) / (w + 3 * rate) / (1 + w / (10 * rate))
    L = 0.5 * rate**2 / (w**2 + 2 * zeta * rate * w + rate**2) * K
    S = 1 / (1 - L)
    corners = np.array([[0.1, 1.0], [1.0, 0.9], [2.5, 0.01], [2.55, 0.9], [30.0, 2.0]]) * [unit, 1.0]
    crossings = np.nonzero(np.diff(np.sign(np.abs(L) - 1)))[0]
    flat = np.linspace(0.0, 50 * unit, 21)  # far apart beside the width of the mode
    noise, within = DisturbanceSpectrum(flat, np.full((21, 1, 1), 1 / unit)), hz <= 50 * unit
    power = np.trapezoid(np.abs(K * S)[within] ** 2, hz[within]) / unit
    cases = [
        (RmsControl(0.1, noise), np.array([np.sqrt(power) / 0.1])),
        (PeakSensitivity(corners.tolist()), np.abs(S) / np.exp(np.interp(np.log(hz), *np.log(corners.T)))),
        (RollOff(1.3 * unit, 0.05, slope_db=0.0), np.where(hz >= 1.3 * unit, np.abs(K * S) / 0.05, 0.0)),
        (MinPhaseMargin(30.0), 30 / np.abs(np.degrees(np.angle(L[crossings])))),
    ]
    for goal, shares in cases:
        limits = limits_of([MaxDamping(), goal], design.plant)
        problem = GainProblem((family,), limits, low, high, rate)
        result = limits.measures[0].excess(problem.state(family, family.matrices(gains), gains))
        assert result[0] == pytest.approx(np.log(shares.max()), abs=2e-3), goal


def test_a_transfer_function_may_have_a_zero_at_rest_or_a_pole_on_the_axis() -> None:
    a = 2 * np.pi * 5
    high_pass = gbid.LinearModel([[-a]], [[1.0]], [[-2 * a]], [[2.0]])  # 2 s / (s + a): S_o must vanish at rest
    assert excess(PeakSensitivity(high_pass)).min() > 5
    undamped = gbid.LinearModel([[0, 300.0], [-300.0, 0]], [[0], [300.0]], [[1.0, 0]], [[0.0]])
    assert np.isfinite(excess(PeakSensitivity(undamped))).all()


@pytest.mark.parametrize("bounds", [(-1.0, 1.0), (0.5, 1.5)])
def test_gains_at_which_the_loop_has_no_solution_are_stepped_back_from(bounds: tuple[float, float]) -> None:
    # 1 - kappa is singular at 1, and the pole -1 + kappa / (1 - kappa) lies at zero for 0.5
    plant = gbid.LinearModel([[-1.0]], [[1.0]], [[1.0]], [[1.0]], name="direct")
    form = controller_structure("P", axes=("",), order=0, lower=bounds[0], upper=bounds[1])
    design = gbid.tune(plant, form, goals=[MaxDecay(), PeakSensitivity(3.0)])
    kappa = design.gains["kappa"]
    assert design.value == pytest.approx(1 - kappa / (1 - kappa))
    if bounds[0] < 0:
        assert (design.status, kappa) == ("optimal", pytest.approx(-1.0))


def test_a_sampled_loop_keeps_its_limit_at_half_the_sample_rate() -> None:
    plant = gbid.LinearModel([[-1.0]], [[1.0]], [[1.0]], [[1.0]], name="direct")
    form = controller_structure("P", axes=("",), order=0, lower=-1.0, upper=1.0)
    design = gbid.tune(plant, form, goals=[MaxDecay(), PeakSensitivity(3.0)], sample_time=0.01)
    assert design.peak_sensitivity == pytest.approx(3.0, rel=1e-6)


def test_a_limit_that_cannot_be_met_leaves_a_stable_design() -> None:
    arm = gbid.LinearModel([[0.0, 1.0], [-100.0, -0.4]], [[0.0], [100.0]], [[1.0, 0.0]], [[0.0]], name="arm")
    form = controller_structure("PD", axes=("",), lowpass_hz=20.0)
    design = gbid.tune(arm, form, goals=[MaxDamping(), StaticAmplification(1e-6)], starts=2)
    assert design.status == "infeasible"
    assert not any("budget" in note for note in design.notes)
    assert gbid.close_loop(arm, gbid.control.controller_model(form, design.gains)).is_stable()
    short = gbid.tune(arm, form, goals=[MaxDamping(), StaticAmplification(1e-6)], starts=2, evaluations=20)
    assert any("exceeds them by" in note and "the budget ended the search" in note for note in short.notes)


def test_modes_in_a_band() -> None:
    every = [q.model("output").modes() for q in loops()]
    expected = [0.5 - min(z for hz, z in modes if 80 <= hz <= 150) for modes in every]
    np.testing.assert_allclose(excess(MinDamping(0.5, low_hz=80, high_hz=150)), expected, atol=1e-9)
    rates = [min(2 * np.pi * hz * z for hz, z in modes if 80 <= hz <= 150) for modes in every]
    np.testing.assert_allclose(excess(SlowestPole(100.0, low_hz=80, high_hz=150)), 1 - np.array(rates) / 100, atol=1e-9)


@pytest.mark.parametrize("sampled", [False, True], ids=["continuous", "sampled"])
@pytest.mark.parametrize(
    "goal",
    [goal for goal, _ in CASES.values()]
    + [
        MinDamping(0.3, low_hz=50, soft=True),
        SlowestPole(90.0, low_hz=1.0),
        PiezoTravel(HalfSine(peak_n=20.0, mass_kg=2.18), travel_m=45e-6),
    ],
    ids=[*CASES, "damping", "decay", "travel"],
)
def test_gradients_are_those_of_differences(goal: Goal, sampled: bool) -> None:
    problem, _ = problem_of(goal, sampled)
    family, measure = problem.families[0], problem.limits.measures[0]
    state = problem.state(family, family.derivatives(GAINS), GAINS)
    loop, value, gradient, _ = measure.pieces(state, np.inf)
    assert [value[loop == i].max() for i in range(2)] == pytest.approx(measure.excess(state).tolist(), abs=1e-9)
    which = int(np.argmax(value))
    for direction in np.random.default_rng(0).choice([-1.0, 1.0], (1 if sampled else 3, len(GAINS))):
        ends = []
        for step in (1e-5, -1e-5):
            x = GAINS + step * direction
            ends.append(measure.excess(problem.state(family, family.matrices(x), x))[loop[which]])
        assert gradient[which] @ direction == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=2e-3, abs=2e-4)


def test_a_peak_alone_and_goals_are_the_same_design() -> None:
    short = gbid.tune(MODEL, operating_points=ONE, peak_sensitivity=2.0)
    slowest = min(2 * np.pi * f * zeta for f, zeta in MODEL.at(6, 0).modes())
    goals = [MaxDamping(), PeakSensitivity(2.0), SlowestPole(slowest)]
    values = gbid.tune(MODEL, "P", operating_points=ONE, goals=goals)
    assert dict(values.gains) == dict(short.gains)
    assert values.value == short.value


def test_limits_hold_at_their_edge() -> None:
    free = gbid.tune(MODEL, operating_points=ONE, goals=[MaxDamping(), PeakSensitivity(2.6)], starts=1)
    goals = [MaxDamping(), PeakSensitivity(2.6), MinDiskMargin(0.9), PeakControl([(50.0, 5.0), (200.0, 1.2)])]
    bound = gbid.tune(MODEL, operating_points=ONE, goals=goals, starts=1)
    assert bound.success
    assert bound.value < free.value - 1e-3
    loop = sensitivities(MODEL.plant_at(6, 0), controller_at(bound.controller, bound.gains, 6, 0))
    assert disk_margin(loop).alpha > 0.9 * (1 - 1e-5)
    figures = {figure.name: figure for figure in bound.goals}
    assert figures["disk margin"].excess == pytest.approx(np.log(0.9 / disk_margin(loop).alpha), abs=1e-4)
    assert max(figure.excess for figure in bound.goals) == pytest.approx(0.0, abs=1e-4)
    assert all(figure.where == "6 bar, 0 rpm" for figure in bound.goals)


def test_objectives_other_than_damping() -> None:
    options = {"operating_points": ONE, "starts": 1}
    best = gbid.tune(MODEL, goals=[PeakSensitivity(1.0, soft=True), MinDamping(0.2)], **options)
    assert best.objective == "goals"
    assert best.success
    assert best.worst.damping == pytest.approx(0.2, abs=1e-4)  # the least damping that is allowed costs the lowest peak
    more = gbid.tune(MODEL, goals=[MaxDamping(), PeakSensitivity(float(best.peak_sensitivity))], **options)
    assert more.value == pytest.approx(0.2, abs=2e-3)  # the same point of the front, from the other side
    assert best.value == pytest.approx(-np.log(best.peak_sensitivity), abs=1e-6)


def test_soft_goals_share_by_their_weights() -> None:
    def both(weight: float) -> gbid.GainResult:
        goals = [MaxDamping(), PeakSensitivity(2.0, soft=True, weight=weight), SlowestPole(0.0)]
        return gbid.tune(MODEL, operating_points=ONE, goals=goals, starts=1)

    lax, strict = both(1.0), both(1.2)
    assert strict.peak_sensitivity < lax.peak_sensitivity - 0.01
    assert strict.value < lax.value
    assert lax.value == pytest.approx(lax.worst.damping)
    assert -lax.goals[0].excess == pytest.approx(lax.value, abs=1e-4)  # both objectives are equally good


def test_disturbance_of_a_recording() -> None:
    rng = np.random.default_rng(1)
    n, dt = 40000, 2e-4
    noise = 1e-6 * rng.standard_normal((n, 2)) @ np.array([[1.0, 0.5], [0.0, 0.8]])
    line = 2e-6 * np.sin(2 * np.pi * 50 * dt * np.arange(n))
    recording = gbid.Recording({"p": noise + line[:, None]}, dt)
    disturbance = recorded_disturbance(recording)
    np.testing.assert_allclose(disturbance.rms, recording.signals["p"].std(axis=0), rtol=0.02)
    np.testing.assert_allclose(disturbance.density, disturbance.density.conj().transpose(0, 2, 1), atol=1e-30)


@pytest.mark.parametrize(
    ("goals", "message"),
    [
        (lambda: [PeakSensitivity(2.0)], "none of them is an objective"),
        (lambda: [MaxDamping(), 2.0], "give a list such as"),
        (lambda: [MaxDamping(), MaxDecay()], "either MaxDamping or MaxDecay"),
        (lambda: [MaxDamping(), PeakSensitivity(-1.0)], "positive number"),
        (lambda: [MaxDamping(), PeakSensitivity([(10.0, 1.0), (5.0, 2.0)])], "rising frequencies"),
        (lambda: [MaxDamping(), PeakControl(2.0, weight=3.0)], "give soft=True"),
        (lambda: [MaxDamping(), MinDiskMargin(2.5)], "between 0 and 2"),
        (lambda: [MaxDamping(), MinDiskMargin(0.5, channel=2)], "from the 2 channels"),
        (lambda: [MaxDamping(), MinPhaseMargin(200.0)], "between 0 and 180"),
        (lambda: [MaxDamping(), MinGainMargin(0.5)], "above 1"),
        (lambda: [MaxDamping(low_hz=50, high_hz=10)], "low < high"),
        (lambda: MaxDamping(), "give a list"),
        (lambda: [MaxDamping(), PiezoTravel(impact=20.0)], "give a HalfSine"),
        (lambda: [MaxDamping(), RollOff(100.0, 1.0, slope_db=1e9)], "0 to 200 dB"),
        (lambda: [RmsPosition(1e-6, DisturbanceSpectrum([0, 1], -np.ones((2, 1, 1))))], "negative eigenvalues"),
        (lambda: [RmsPosition(1e-6, recorded_disturbance(RECORDED, segment_s=np.nan))], "segment_s = nan"),
    ],
)
def test_goals_that_make_no_sense_are_refused(goals: object, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        gbid.tune(MODEL, operating_points=ONE, goals=goals())


def test_both_forms_at_once_are_refused() -> None:
    with pytest.raises(UsageError, match="peak_sensitivity beside goals"):
        gbid.tune(MODEL, operating_points=ONE, goals=[MaxDamping()], peak_sensitivity=2.0)


@pytest.mark.parametrize("sample_time", [None, 5e-4])
@pytest.mark.parametrize("natural", [300.0, 777.0])
def test_the_rms_of_a_light_mode_is_that_of_a_fine_sum(sample_time, natural):
    """A mode whose resonance is narrower than every band of the integral, against a sum with points at its peak."""
    plant = gbid.LinearModel([[0, 1], [-(natural**2), -0.02 * natural]], [[0], [1.0]], [[0.1 * natural**2, 0]], [[0.0]])
    plants = plants_of(plant, controller_structure("P", axes=("",)), TuneOptions(sample_time=sample_time))
    family = plants.family(plants.points)

    def poles(kappa):
        return np.linalg.eigvals(family.matrices(np.array([kappa])).A[0])

    light_damping, unstable = 0.0, -5.0
    for _ in range(40):  # a gain near the edge of stability
        kappa = (light_damping + unstable) / 2
        damping = (-poles(kappa).real / np.abs(poles(kappa))).min()
        light_damping, unstable = (kappa, unstable) if damping > 3e-4 else (light_damping, kappa)
    loops = family.matrices(np.array([light_damping]))
    A, B, C, D = loops.A[0], loops.B[0], loops.C[0], loops.D[0]
    rates = poles(light_damping)
    peak = np.abs(rates[np.argmin(-rates.real / np.abs(rates))].imag)
    T = sample_time
    peak_hz = peak / (2 * np.pi) if T is None else np.arctan(peak * T / 2) / (np.pi * T)
    near = peak_hz + 40 * np.sinh(np.linspace(-14, 14, 20001)) / np.sinh(14)
    hz = np.unique(np.concatenate([np.linspace(0, 400, 20001), near[(near > 0) & (near < 400)]]))
    w = 2 * np.pi * hz if T is None else 2 / T * np.tan(np.pi * hz * T)
    values, vectors = np.linalg.eig(A)
    response = C @ vectors @ (np.linalg.solve(vectors, B.astype(complex)) / (1j * w - values[:, None])) + D
    known, density = np.array([0.0, 20.0, 60.0, 200.0, 400.0]), 1e-12 * np.array([1, 1, 3, 0.5, 0.1])
    squares = np.abs(response) ** 2 * np.interp(hz, known, density)
    expected = np.sqrt(((squares[:, 1:] + squares[:, :-1]) / 2 * np.diff(hz)).sum(axis=1))
    noise = DisturbanceSpectrum(known, density[:, None, None])
    for goal, one in ((RmsPosition(1.0, noise), expected[0]), (RmsControl(1.0, noise), expected[1])):
        # the density counts as constant within a band: 0.3 % of the rms where it is steepest
        assert goal.measure(plant).function(family, np.array([light_damping]))[0] == pytest.approx(one, rel=3e-3)
