"""What the chain does, against independent ways: linear model, online filter, allocation, ramps, watchdog, wind-up."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan, sin

import numpy as np
import pytest
from chain_cases import BIQUAD, design, grid_of_maps, runout_map

import gbid
from gbid.control import ControllerDesign
from gbid.export.chain import STACKS, ChainOptions, anti_windup_gain, chain_of
from gbid.export.chain_c import CompiledChain
from gbid.export.chain_python import ChainFault, ChainInput, ChainMode, PythonChain
from gbid.rig import PiezoStack, PiezoStacks
from gbid.rig.piezo import ALLOCATION
from gbid.structure import LinearModel

QUICK = {"stroke_m": 45e-6, "disc_limit_m": 20e-6, "ramp_s": 2e-4, "fade_s": 2e-4, "spike_limit_m": None}
"""One sample of ramp and one of fade."""


def moving(n: int, size: float = 3e-6) -> list[ChainInput]:
    random = np.random.default_rng(5)
    positions = size * random.normal(size=(n, 2))
    return [ChainInput((float(x), float(y)), 0.1257 * k % 6.28, 5.0, 3000.0) for k, (x, y) in enumerate(positions)]


@pytest.mark.parametrize("kind", ["P", "biquad"])
def test_in_the_linear_range_it_is_the_filter_and_the_sampled_controller(kind: str) -> None:
    controller, map_ = design(kind), runout_map()
    chain = chain_of(controller, runout_maps=[map_], options=ChainOptions(**QUICK))
    samples = moving(400)
    outputs = PythonChain(chain).run(samples)
    online = gbid.OnlinePrefilter(map_)
    e = np.array([online.step(u.position, u.angle) for u in samples])
    np.testing.assert_array_equal([y.deviation for y in outputs], e)
    expected = controller.sampled_at().simulate(e[1:])
    values = np.array([y.reference for y in outputs])[1:]  # the first sample is that of the ramp
    assert not any(y.saturated for y in outputs)
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-17)
    np.testing.assert_allclose(
        np.array([y.stack for y in outputs])[1:], 22.5e-6 + values @ ALLOCATION.T, rtol=0, atol=1e-18
    )


def test_the_allocation_is_that_of_the_rig() -> None:
    np.testing.assert_array_equal(STACKS, ALLOCATION)
    assert PiezoStacks().offset == ChainOptions(stroke_m=PiezoStack.stroke).offset_m
    assert PiezoStacks().travel == ChainOptions(stroke_m=PiezoStack.stroke).limit_m


def test_a_schedule_is_the_exact_controller_within_its_tolerance_and_changes_without_a_bump() -> None:
    controller = design("scheduled")
    chain = chain_of(controller, options=ChainOptions(**QUICK))
    assert 0 < chain.controller.error < 2e-3
    samples = moving(300)
    values = np.array([y.reference for y in PythonChain(chain).run(samples)])
    exact = controller.sampled_at(5.0, 3000.0).simulate(np.array([u.position for u in samples[1:]]))
    assert np.abs(values[1:] - exact).max() < 2e-3 * np.abs(exact).max()

    def gains(jump: bool) -> np.ndarray:
        twin = PythonChain(chain)
        steady = [
            ChainInput((3e-6 * sin(0.02 * k), 1e-9 * k), 0.0, 7.0 if jump and k >= 500 else 3.0, 0.0)
            for k in range(600)
        ]
        return np.array([y.reference[0] for y in twin.run(steady)])

    stayed, jumped = gains(False), gains(True)
    step = np.abs(np.diff(jumped - stayed)).max()
    assert 0 < step < 0.01 * np.abs(stayed).max()  # 4 bar in a sample; the schedule follows with 2 bar/s


def test_maps_are_interpolated_over_speed() -> None:
    maps = grid_of_maps()
    chain = chain_of(design("P"), runout_maps=maps, options=ChainOptions(**QUICK))
    for speed, weight in ((2000.0, 0.0), (4000.0, 0.5), (6000.0, 1.0), (0.0, 0.0)):
        twin = PythonChain(chain)
        step = twin.step(ChainInput((0.0, 0.0), 1.0, 3.0, speed)).deviation
        low, high = (m.evaluate(np.array([1.0]))[0] for m in maps[:2])
        np.testing.assert_allclose(step, -((1 - weight) * low + weight * high), rtol=0, atol=1e-18)


def test_ramps_and_fades() -> None:
    chain = chain_of(design("P"), options=ChainOptions(ramp_s=0.02, fade_s=0.01, spike_limit_m=None))
    twin = PythonChain(chain)
    e = 5e-6

    def run(mode: ChainMode, n: int) -> np.ndarray:
        dither = [1e-12 * (k % 2) for k in range(n)]
        return np.array([twin.step(ChainInput((e + d, d), mode=mode)).stack for d in dither])

    up = run(ChainMode.CONTROL, 100)
    np.testing.assert_allclose(up[:, 0], 22.5e-6, atol=22.5e-6)
    assert up[0, 0] == pytest.approx(22.5e-8)
    assert (np.diff(up[:, 1]) > -1e-12).all()
    assert np.abs(np.diff(up[:, 1])).max() < 1e-6  # no step anywhere
    assert up[100 - 1, 1] == pytest.approx(22.5e-6, abs=1e-9)
    full = run(ChainMode.CONTROL, 100)
    assert full[-1, 1] == pytest.approx(22.5e-6 + 1.3 * e, abs=1e-8)
    assert full[-1, 3] == pytest.approx(22.5e-6 - 1.3 * e, abs=1e-8)
    down = run(ChainMode.OFF, 200)
    np.testing.assert_array_equal(down[-1], 0.0)
    assert np.abs(np.diff(down[:, 1])).max() < 1e-6
    assert (down[60:, 0] == down[60:, 1]).all()  # first the control fades out, then the offset goes


@pytest.mark.parametrize(
    ("what", "fault", "within"),
    [
        ("nan", ChainFault.SIGNAL, 5),
        ("inf", ChainFault.SIGNAL, 5),
        ("stuck", ChainFault.STUCK, 51),
        ("angle", ChainFault.STUCK, 51),
        ("far", ChainFault.POSITION, 3),
    ],
)
def test_the_watchdog_fades_to_the_offset(what: str, fault: ChainFault, within: int) -> None:
    options = ChainOptions(ramp_s=2e-4, fade_s=0.01, spike_limit_m=None)
    twin = PythonChain(chain_of(design("P"), runout_maps=[runout_map()], options=options))
    twin.run(moving(200))
    wrong = {
        "nan": lambda k: ChainInput((nan, 0.0), 0.1 * k),
        "inf": lambda k: ChainInput((1e-6, inf), 0.1 * k),
        "stuck": lambda k: ChainInput((1e-6 * sin(k), 2e-6), 0.1 * k),
        "angle": lambda k: ChainInput((1e-6 * sin(k), 1e-6 * sin(2 * k)), 2.0, 5.0, 3000.0),
        "far": lambda k: ChainInput((30e-6 + 1e-7 * sin(k), 1e-9 * k), 0.1 * k),
    }[what]
    outputs = [twin.step(wrong(k)) for k in range(200)]
    first = next(k for k, y in enumerate(outputs) if y.fault)
    assert outputs[-1].fault == fault
    assert first + 1 <= within
    assert outputs[-1].reference == (0.0, 0.0)
    assert outputs[-1].stack == (22.5e-6,) * 4
    assert all(np.isfinite([*y.stack, *y.reference]).all() for y in outputs)
    stacks = np.array([y.stack for y in outputs])[first:]
    assert np.abs(np.diff(stacks, axis=0)).max() < 2e-6  # a fade, no step
    assert [y.fault for y in twin.run(moving(20))] == [fault] * 20  # it stays
    twin.step(ChainInput((0.0, 0.0), 0.1, mode=ChainMode.OFFSET))
    assert twin.run(moving(20))[-1].fault == ChainFault.NONE


@pytest.mark.parametrize("factor", [1.0, 1.001])
def test_an_angle_may_rest_up_to_the_speed_that_says_so(factor: float) -> None:
    """The limit itself is not above the limit, in C and in Python."""
    chain = chain_of(design("P"), runout_maps=[runout_map()], options=ChainOptions(ramp_s=2e-4, fade_s=0.01))
    speed = factor * chain.options.stuck_speed_rpm
    samples = [ChainInput((1e-6 * sin(k), 1e-6 * sin(2 * k)), 2.0, 5.0, speed) for k in range(100)]
    faults = {ChainFault.NONE} if factor == 1 else {ChainFault.NONE, ChainFault.STUCK}
    assert {y.fault for y in PythonChain(chain).run(samples)} == faults
    assert {y.fault for y in CompiledChain(chain).run(samples)} == faults


def test_single_faulty_samples_and_spikes_are_bridged() -> None:
    chain = chain_of(design("P"), options=ChainOptions(ramp_s=2e-4, fade_s=2e-4))
    wave = [3e-6 * sin(0.15 * k) for k in range(300)]
    clean = PythonChain(chain).run([ChainInput((v, 1e-9 * k)) for k, v in enumerate(wave)])
    broken = [v + (2e-5 if k in (100, 101, 150) else 0.0) for k, v in enumerate(wave)]
    broken[200] = nan
    outputs = PythonChain(chain).run([ChainInput((v, 1e-9 * k)) for k, v in enumerate(broken)])
    miss = np.abs(np.array([y.deviation for y in outputs]) - np.array([y.deviation for y in clean]))
    assert miss.max() < 0.6e-6  # of 20 um; a held sample of this wave is 0.45 um late
    assert not any(y.fault for y in outputs)
    step = [0.0] * 50 + [15e-6] * 50
    after = PythonChain(chain).run([ChainInput((v + 1e-9 * (k % 2), 1e-9 * k)) for k, v in enumerate(step)])
    assert after[52].deviation[0] < 1e-6
    np.testing.assert_allclose([y.deviation[0] for y in after[53:]], 15e-6, atol=1e-8)  # a step is no spike


def test_anti_windup_of_an_integrator_is_back_calculation() -> None:
    h, ti, kp = 2e-4, 0.02, 0.8
    one = np.eye(2)
    pi = LinearModel(
        one, one * (kp * h / ti), one, one * kp, dt=h, input_names=("p_x", "p_y"), output_names=("r_x", "r_y")
    )
    gain = anti_windup_gain(pi)
    np.testing.assert_allclose(gain, one * (h / (np.sqrt(2) * ti)), rtol=0.01)  # T_t = 1.4 T_i

    slow = ControllerDesign("slow", None, {}, h, models={None: integrator_like(kp, ti)})
    chain = chain_of(slow, options=ChainOptions(**{**QUICK, "disc_limit_m": 1.0}, stuck_samples=30000))
    twin, without = PythonChain(chain), PythonChain(chain)
    without._chain = without_gain(chain)
    push = [ChainInput((40e-6, 0.0))] * 2000 + [ChainInput((-15e-6, 0.0))] * 400
    back = [sum(y.reference[0] >= 0 for y in each.run(push)[2000:]) for each in (twin, without)]
    assert back[1] == 400  # wound up: still at the old limit
    assert back[0] < 250


def integrator_like(kp: float, ti: float) -> LinearModel:
    """Proportional and slow lag: as an integrator with a leak of 1 s."""
    one = np.eye(2)
    return LinearModel(-one, one * (kp / ti), one, one * kp, input_names=("p_x", "p_y"), output_names=("r_x", "r_y"))


def without_gain(chain):
    states = tuple(tuple(t for t in terms if t.kind != "d") for terms in chain.states)
    return replace(chain, states=states)


def test_the_gain_of_a_fast_filter_keeps_it_stable() -> None:
    for kind in ("P", "biquad"):
        model = design(kind).sampled_at()
        closed = model.A - anti_windup_gain(model) @ model.C
        assert np.abs(np.linalg.eigvals(closed)).max() < 1.0
    zero = ControllerDesign(
        "zero",
        gbid.controller_structure("biquad"),
        {**BIQUAD, **dict.fromkeys([f"b{i}_{a}" for i in range(3) for a in "xy"], 0.0)},
        sample_time=2e-4,
    )
    outputs = PythonChain(chain_of(zero, options=ChainOptions(**QUICK))).run(moving(20))
    assert all(y.reference == (0.0, 0.0) for y in outputs)
