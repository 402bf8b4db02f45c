"""Modes of the chain against a reference that was written from docs/target.md, "What a sample computes"."""

from __future__ import annotations

import shutil
from math import nan

import numpy as np
import pytest
from chain_cases import BIQUAD
from page_law import PageLaw
from scipy.signal import cont2discrete

from gbid.control import ControllerDesign, controller_structure, scheduled
from gbid.export.chain import ChainOptions, anti_windup_gain, chain_of
from gbid.export.chain_c import CompiledChain
from gbid.export.chain_python import ChainInput, ChainMode, PythonChain
from gbid.structure import LinearModel

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
T, LIMIT, BEYOND = 2e-4, 22.5e-6, 20e-6
GAINS = {
    "P": {"kappa": 1.3},
    "PI": {"kappa": 0.8, "ki": -40.0},
    "PID": {"kappa": 0.8, "ki": -60.0, "kd": 0.3},
    "resonant": {"kappa": 0.8, "sine": 0.4, "cosine": -0.3, "width": 0.02},
    "observer": {"l1": 1.0, "l2": 0.5, "f1": 1.2, "f2": -0.8, "frequency": 0.12},
    "biquad": {name.removesuffix("_x"): value for name, value in BIQUAD.items() if name.endswith("_x")},
}


def design(kind: str) -> ControllerDesign:
    structure = controller_structure(kind)
    gains = {
        f"{name}_{axis}": value * (1.0 if axis == "x" else 0.7) for name, value in GAINS[kind].items() for axis in "xy"
    }
    if kind == "resonant":  # at 6000 rpm; the structure follows the speed
        at = ControllerDesign("r", scheduled(structure, ("1",)), {f"{k}_1": v for k, v in gains.items()}, T).at(
            6.0, 6e3
        )
        return ControllerDesign("r", None, {}, T, models={None: at})
    return ControllerDesign("damper", structure, gains, T)


def wild(seed: int, n: int, own: bool) -> tuple[ChainOptions, list[ChainInput]]:
    """Options and samples with any sequence of modes, positions near and far, stuck sensors and faulty samples."""
    random = np.random.default_rng(seed)
    machine = {"stroke_m": 2 * LIMIT, "disc_limit_m": BEYOND, "spike_limit_m": [None, "auto", 3e-6][random.integers(3)]}
    if own:  # at rest outside of what the control may reach
        limits, offsets = (LIMIT, LIMIT / 2), (3 * LIMIT, -2 * LIMIT)
        machine = {"limits": limits, "offsets": offsets, "beyond": (BEYOND, BEYOND / 2), "units": ("m", "A")}
        machine["spikes"] = [None, (3e-6, 8e-6)][random.integers(2)]
    options = ChainOptions(
        **machine,
        ramp_s=float(random.choice([1e-4, 2e-3, 0.01])),
        fade_s=float(random.choice([1e-4, 1e-3, 4e-3, 0.02])),
        median=int(random.choice([1, 3])),
        on_fault=str(random.choice(["fade", "control"])),
        stuck_samples=20,
        zero_m=(1e-6, -2e-6),
    )
    samples: list[ChainInput] = []
    while len(samples) < n:
        mode, length = ChainMode(int(random.integers(3))), int(random.choice([1, 3, 20, 90]))
        place = random.choice([0.0, 5e-6, 10e-6, 30e-6]) * random.normal(size=2)
        noise = random.choice([0.0, 1e-8, 1e-6], p=[0.1, 0.5, 0.4])
        for _ in range(length):
            x, y = (float(v) for v in place + noise * random.normal(size=2) + (1e-6, -2e-6))
            samples.append(ChainInput((nan if random.random() < 0.03 else x, y), mode=mode))
    return options, samples


@pytest.mark.parametrize("kind", GAINS)
@pytest.mark.parametrize("own", [False, True], ids=["stacks", "own"])
def test_any_sequence_of_modes_is_what_the_page_says(kind: str, own: bool) -> None:
    options, samples = wild(10 * own + len(kind), 1500, own)
    controller = design(kind)
    chain = chain_of(controller, options=options)
    model = controller.at()
    page = PageLaw(cont2discrete((model.A, model.B, model.C, model.D), T, "bilinear")[:4], T, chain.options)
    expected = [page.step(each.position, each.mode) for each in samples]
    outputs = PythonChain(chain).run(samples)
    assert CompiledChain(chain).run(samples) == outputs
    for k, name in enumerate(("stack", "reference", "deviation")):
        wanted = np.array([each[k] for each in expected])
        np.testing.assert_allclose([getattr(y, name) for y in outputs], wanted, rtol=0, atol=1e-7 * LIMIT, err_msg=name)
    assert [(int(y.fault), y.held, y.saturated) for y in outputs] == [each[3:] for each in expected]


@pytest.mark.parametrize("kind", GAINS)
@pytest.mark.parametrize("before", [(2,), (0, 2, 1, 2)])
def test_control_begins_without_a_bump_after_a_minute_in_offset(kind: str, before: tuple[int, ...]) -> None:
    chain = chain_of(design(kind), options=ChainOptions(stroke_m=2 * LIMIT, disc_limit_m=BEYOND))
    fade = chain.fade_samples
    modes = np.concatenate([*(np.full(7000, mode) for mode in before), np.full(300_000, 1), np.full(2 * fade, 2)])
    rows = np.zeros((len(modes), 6))
    rows[:, 5] = modes
    rows[: -2 * fade, 0], rows[::2, 1] = BEYOND / 2, 1e-12  # no sensor is stuck
    rows[::2, 0] += 1e-12
    reference = CompiledChain(chain)._run(rows)[-2 * fade :, 4:6]
    assert np.abs(reference).max() < 0.01 * LIMIT


def test_the_gain_of_an_axis_does_not_depend_on_another() -> None:
    step, ti = 2e-4, 0.02

    def pi(*kappas: float) -> np.ndarray:
        K = np.diag(kappas)
        return anti_windup_gain(LinearModel(np.eye(len(K)), K * step / ti, np.eye(len(K)), K, dt=step))

    alone = pi(0.8)
    for other in (0.8, 80.0, 1e-9, 0.0):
        assert pi(0.8, other)[0].tolist() == [alone[0, 0], 0.0]
