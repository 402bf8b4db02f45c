"""The piezo stacks against closed forms, Figs. A.28 and A.29, and Table 2."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rig_point import machine
from scipy.signal import lsim

import gbid
from gbid.core.errors import UsageError
from gbid.rig import PiezoStack, PiezoStacks, Prbs, SensorChain, StackStaircase, Stationary, record, saturations
from gbid.rig.piezo import ALLOCATION, pair_difference

TS = 2e-4
STILL = {"pressure_bar": 6.0, "speed_rpm": 0.0}
STACK = PiezoStacks().stacks[3]
QUIET = SensorChain(noise_p_m=0.0, noise_u_m=0.0, offset_u_m=(0, 0))


def rig(stacks=None, **parts):
    return replace(machine(6.0, 0.0), actuator=stacks or PiezoStacks(), **parts)


def run(stacks=None, **stairs):
    return record(rig(stacks), StackStaircase(**stairs), conditions=STILL, seed=1, name="stairs")


def ends_of_steps(rec, stack=4):
    """Mean position over the last tenth of each level, up and down."""
    y = rec.signal("y_p")[:, stack - 1].reshape(21, -1)
    ends = y[:, -y.shape[1] // 10 :].mean(axis=1)
    return ends[:11], ends[:9:-1]


def test_u_is_the_difference_of_each_pair():
    """Eq. 2, and the signs of Eq. 1 with it: r_x moves u_x by twice as much and not u_y, and the other way round."""
    np.testing.assert_array_equal(pair_difference(np.array([10.0, 7.0, 1.0, 2.0])), [7 - 2, 10 - 1])
    samples = np.array([[10.0, 7.0, 1.0, 2.0], [4.0, 3.0, 2.0, 1.0], [0.0, 0.0, 1.0, 0.0]])
    np.testing.assert_array_equal(pair_difference(samples), [[5, 9], [2, 2], [0, -1]])
    np.testing.assert_array_equal(pair_difference(5.0 + ALLOCATION @ [1.0, 0.0]), [2.0, 0.0])
    np.testing.assert_array_equal(pair_difference(5.0 + ALLOCATION @ [0.0, 1.0]), [0.0, 2.0])


def test_stacks_have_the_controllers_of_table_a5():
    printed = [(0.926, 1996, 101), (0.927, 1983, 101), (0.220, 8349, 101), (0.640, 2945, 101)]
    assert [(q.pd_gain, q.pd_zero, q.pd_pole) for q in PiezoStacks().stacks] == printed
    assert [q.slow_pole for q in PiezoStacks().stacks] == [zero for _, zero, _ in printed]


def test_a_stack_takes_its_reference_as_it_is_unless_it_has_a_gain():
    """In the steady state of a linear stack the loop alone lies between position and reference."""
    loop_gain = STACK.pd_scale * STACK.pd_gain * STACK.pd_zero / STACK.pd_pole
    values = {
        name: getattr(STACK, name) for name in ("pd_gain", "pd_zero", "pd_pole", "pd_scale", "slow_pole", "fast_pole")
    }
    stack = PiezoStack(**values, hysteresis=0.0, creep=0.0)
    slope = loop_gain * stack.stroke / stack.voltage_limit
    made = run(replace(PiezoStacks(), stacks=(*PiezoStacks().stacks[:3], stack)), stack=4, controlled=True, hold_s=0.1)
    up, _ = ends_of_steps(made)
    commands = made.signal("r_p")[:, 3].reshape(21, -1)[:11, -1]
    assert np.polyfit(commands[2:9], up[2:9], 1)[0] == pytest.approx(slope / (1 + slope), rel=1e-3)


@pytest.mark.parametrize(("axis", "numbers"), [("x", (2, 4)), ("y", (1, 3))])
def test_stacks_without_hysteresis_have_the_poles_and_gain_of_table_2(axis, numbers):
    """The zero cancels the slow pole: controller and fast pole alone make the two poles of the pair."""
    p1, p2, kappa = {"x": (3078.0, 8143.0, 1.863), "y": (2452.0, 6494.0, 1.865)}[axis]
    for q in (PiezoStacks().stacks[i - 1] for i in numbers):
        gain, fast = q.pd_gain * q.pd_scale * q.pd_zero * 0.72 * 4.5e-6, q.fast_pole / 1.26
        np.testing.assert_allclose(sorted(-np.roots([1, q.pd_pole + fast, fast * (q.pd_pole + gain)])), [p1, p2])
        assert 2 * q.reference_gain * gain / (q.pd_pole + gain) == pytest.approx(kappa)


# ---- the hysteresis itself ----


def test_plays_lag_by_half_a_step_and_whole_steps_of_the_voltage():
    np.testing.assert_allclose(STACK.thresholds, [0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5, 8.5, 9.5])
    np.testing.assert_allclose(replace(STACK, voltage_limit=20.0).thresholds, 2 * STACK.thresholds)


def play_by_hand(volts, threshold):
    """One-sided play, sample by sample."""
    y, out = 0.0, []
    for v in volts:
        y = max(v - threshold, min(v, y))
        out.append(y)
    return np.array(out)


@settings(deadline=None, max_examples=30)
@given(hysteresis=st.floats(0.0, 18e-6), stroke=st.floats(40e-6, 60e-6))
def test_loop_over_the_whole_range_has_the_stroke_and_the_hysteresis(hysteresis, stroke):
    stack = replace(STACK, hysteresis=hysteresis, stroke=stroke)
    up = np.linspace(0, 10, 201)
    volts = np.concatenate([up, up[-2::-1]])
    plays = np.array([play_by_hand(volts, rho) for rho in stack.thresholds])
    y = stack.spring * volts + stack.play_weight * plays.sum(axis=0)
    np.testing.assert_allclose([y[0], y[200], y[-1]], [0, stroke, 0], atol=1e-18)
    difference = y[:199:-1] - y[:201]
    assert difference.min() > -1e-18
    np.testing.assert_allclose(difference.max(), hysteresis, rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(difference[100], hysteresis, rtol=1e-9, atol=1e-18)


def test_small_loops_follow_rayleigh():
    """Around the middle, a loop of half width A volts is wide as A^2 and its slope grows with A."""
    amplitude = np.array([1.0, 2.0, 4.0])
    width, slope = [], []
    for a in amplitude:
        once = np.concatenate([np.linspace(0, a, 400), np.linspace(a, -a, 800), np.linspace(-a, a, 800)])
        volts = np.concatenate([np.linspace(0, 5, 500), 5 + once, 5 + once[400:]])
        y = STACK.spring * volts + STACK.play_weight * sum(play_by_hand(volts, rho) for rho in STACK.thresholds)
        down, up = y[-1600:-800], y[-800:]
        width.append((down[::-1] - up).max())
        slope.append((up[-1] - up[0]) / (2 * a))
    np.testing.assert_allclose(np.array(width) / width[0], amplitude**2, rtol=0.02)
    alpha = STACK.hysteresis / 25
    np.testing.assert_allclose(np.diff(slope), alpha * np.diff(amplitude), rtol=0.05)


# ---- Figs. A.28 and A.29 ----


def test_open_loop_staircase_shows_the_papers_hysteresis():
    rec = run(controlled=False, hold_s=0.3)
    up, down = ends_of_steps(rec)
    assert np.abs(down - up).max() == pytest.approx(8.4e-6, rel=0.05)
    assert 4 <= np.abs(down - up).argmax() <= 6
    assert up[-1] == pytest.approx(45e-6, rel=0.01)
    np.testing.assert_array_equal(np.unique(rec.signal("v")[:, 3]), np.arange(11.0))


def test_without_creep_an_open_staircase_is_that_of_the_plays():
    plain = tuple(replace(s, creep=0.0) for s in PiezoStacks().stacks)
    rec = run(PiezoStacks(plain), controlled=False, hold_s=0.1)
    volts = rec.signal("v")[:, 3]
    plays = sum(play_by_hand(volts, rho) for rho in STACK.thresholds)
    expected = STACK.spring * volts + STACK.play_weight * plays
    np.testing.assert_allclose(rec.signal("y_p")[499::500, 3], expected[499::500], rtol=0, atol=1e-12)


@pytest.mark.parametrize("stack", [1, 2, 3, 4])
def test_controlled_staircase_has_less_than_a_tenth_of_it(stack):
    up, down = ends_of_steps(run(controlled=True, stack=stack, hold_s=0.3), stack)
    assert np.abs(down - up).max() < 0.84e-6
    assert np.diff(up)[1:].std() < 0.03 * np.diff(up)[1:].mean()


def test_open_loop_step_creeps_by_two_percent_in_half_a_minute():
    slow = tuple(replace(s, slow_pole=1000.0, fast_pole=3000.0) for s in PiezoStacks().stacks)
    stairs = StackStaircase(steps=2, hold_s=30.0)
    made = record(rig(PiezoStacks(slow)), stairs, conditions=STILL, seed=0, name="c", sample_time=2e-3, settle_s=0)
    y = made.signal("y_p")[15_000:30_000, 3]  # at 5 V
    after = y[[10, 500, 5000, 15_000 - 1]]
    share = after / after[0] - 1
    expected = [sum(0.01 * (1 - np.exp(-t / tau)) for tau in (1, 10, 100)) for t in (0.02, 1, 10, 30)]
    np.testing.assert_allclose(share, np.array(expected) - expected[0], rtol=0.03, atol=1e-5)
    assert 0.02 < share[-1] < 0.03


def test_ends_of_the_range_are_flagged_and_hold():
    rec = run(controlled=False, hold_s=0.2)
    assert rec.signal("y_p").max() <= 45e-6
    ((begin, end),) = saturations(rec)["4"]
    assert begin == pytest.approx(2.0, abs=0.05)
    assert end == pytest.approx(2.2, abs=0.05)
    usual = record(rig(), Prbs(0.2), conditions=STILL, seed=0, name="a")
    assert saturations(usual) == {}
    wide = record(
        rig(), Prbs(0.2, amplitude_m=22e-6), conditions=STILL, seed=0, name="a", touch_down="flag", stacks=True
    )
    assert saturations(wide)
    assert 0 <= wide.signal("v").min() <= wide.signal("v").max() <= 10


# ---- the controlled pair ----


def test_without_its_nonlinearities_a_stack_is_its_transfer_function():
    ideal = tuple(replace(s, hysteresis=0.0, creep=0.0) for s in PiezoStacks().stacks)
    rec = record(rig(PiezoStacks(ideal)), Prbs(0.1), conditions=STILL, seed=2, name="a", settle_s=0, stacks=True)
    time = np.arange(rec.n_samples * 20) * TS / 20
    for i, s in enumerate(ideal):
        told = np.repeat(rec.signal("r_p")[:, i], 20)
        # y (s + p)(s + w_s)(s + w_f) = g P c (s + z) w_s w_f b (r - y / g) with b the slope of the stack
        loop = s.pd_gain * s.pd_scale * s.slow_pole * s.fast_pole * s.stroke / s.voltage_limit
        open_poles = np.poly([-s.pd_pole, -s.slow_pole, -s.fast_pole])
        numerator = loop * np.array([0, 0, 1, s.pd_zero])
        start = rec.signal("y_p")[0, i]
        assert start == pytest.approx(
            s.reference_gain * 22.5e-6 * numerator[-1] / (open_poles + numerator)[-1],
            rel=1e-9,
        )
        shifted = rec.signal("y_p")[:, i] - start
        _, from_start, _ = lsim(
            (s.reference_gain * numerator[2:], open_poles + numerator), told - 22.5e-6, time, interp=False
        )
        np.testing.assert_allclose(shifted, from_start[::20], rtol=0, atol=2e-12)


@pytest.mark.parametrize(("spread", "least", "most"), [(0.0, 99.7, 99.95), (0.2, 97.0, 99.95)])
def test_pairs_fit_as_well_as_the_papers_and_come_close_to_table_2(spread, least, most):
    made = record(rig(PiezoStacks.unequal(spread, 3)), Prbs(2.0), conditions=STILL, seed=1, name="a")
    centred = {k: v - v.mean(axis=0) for k, v in made.signals.items()}
    result = gbid.fit(gbid.PiezoPair(), replace(made, signals=centred))
    assert ((result.fit_percent > least) & (result.fit_percent < most)).all()
    p = result.parameters
    for axis, (p1, p2, kappa) in {"x": (3078, 8143, 1.863), "y": (2452, 6494, 1.865)}.items():
        assert p[f"kappa_{axis}"] == pytest.approx(kappa, rel=0.01)
        if spread == 0:
            assert p[f"p1_{axis}"] == pytest.approx(p1, rel=0.05)
            assert p[f"p2_{axis}"] == pytest.approx(p2, rel=0.05)


def test_stacks_begin_at_rest():
    unequal = PiezoStacks.unequal(0.1, 4)
    rec = record(rig(unequal, sensors=QUIET), Stationary(0.5), conditions=STILL, seed=0, name="a", stacks=True)
    assert np.ptp(rec.signal("y_p"), axis=0).max() < 1e-12
    assert rec.signal("y_p").mean() == pytest.approx(22e-6, abs=1.5e-6)
    np.testing.assert_allclose(rec.signal("u"), rec.signal("y_p")[:, [1, 0]] - rec.signal("y_p")[:, [3, 2]], atol=1e-15)


def test_unequal_stacks_are_seeded():
    assert PiezoStacks.unequal(0.1, 1) == PiezoStacks.unequal(0.1, 1)
    assert PiezoStacks.unequal(0.1, 1) != PiezoStacks.unequal(0.1, 2)
    assert PiezoStacks.unequal(0.0, 1) == PiezoStacks()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: replace(STACK, hysteresis=30e-6), "hysteresis = 30 um is too large for a stroke of 45 um"),
        (lambda: replace(STACK, fast_pole=0.0), "fast_pole = 0.0; give a number above 0"),
        (lambda: replace(STACK, creep=-0.1), "creep = -0.1"),
        (lambda: PiezoStacks((STACK,) * 3), "3 stacks; give four"),
        (lambda: PiezoStacks(offset=50e-6), "offset = 5e-05 m; it must lie inside the stroke"),
        (lambda: PiezoStacks.unequal(0.5), "spread = 0.5"),
        (lambda: StackStaircase(stack=5), "stack = 5; give a whole number of at least 1 and of at most 4"),
        (lambda: record(machine(), StackStaircase(), conditions=STILL, seed=0, name="a"), "linear actuators"),
        (lambda: record(machine(), Prbs(0.1), conditions=STILL, seed=0, name="a", stacks=True), "linear actuators"),
        (
            lambda: record(rig(), Prbs(0.1), conditions=STILL, seed=0, name="a", sample_time=1e-3),
            "raise oversampling to at least",
        ),
    ],
)
def test_bad_stacks_are_one_clear_line(call, words):
    with pytest.raises(UsageError, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)
    assert isinstance(STACK, PiezoStack)
