"""Modes of the chain against a reference that was written from docs/target.md, "What a sample computes"."""

from __future__ import annotations

import shutil
from math import isfinite, nan

import numpy as np
import pytest
from chain_cases import BIQUAD

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


class FromThePage:
    """The page's steps with four stacks and no run-out map."""

    def __init__(self, model: LinearModel, options: ChainOptions) -> None:
        self.A, self.B, self.C, self.D = model.A, model.B, model.C, model.D
        self.L = self.kalman_gain()
        self.o, self.x, self.e = options, np.zeros(len(self.A)), np.zeros(2)
        self.N, self.F = max(1, round(options.ramp_s / T)), max(1, round(options.fade_s / T))
        self.window: list[np.ndarray] = []
        self.accepted: list[list[float]] = [[], []]
        self.replaced, self.equal, self.last = [0, 0], [0, 0], None
        self.bad = self.beyond = self.n = self.f = self.fault = 0

    def kalman_gain(self) -> np.ndarray:
        A, B, C, D = self.A, self.B, self.C, self.D
        s = np.max([np.linalg.norm(M, axis=1) for M in (D, C @ B, C @ A @ B)], axis=0)
        S, R, P = B @ D.T, D @ D.T + np.diag(s**2), np.zeros_like(A)
        for _ in range(200_000):
            L = (A @ P @ C.T + S) @ np.linalg.inv(C @ P @ C.T + R)
            step = A @ P @ A.T + B @ B.T - L @ (A @ P @ C.T + S).T - P
            P = P + step
            if np.abs(step).max(initial=0.0) <= 1e-15 * np.abs(P).max(initial=0.0):
                break
        return L if len(A) else np.zeros((0, 2))

    def step(self, p: tuple[float, float], mode: int) -> tuple:
        o = self.o
        good = all(isfinite(v) and abs(v) < 1e6 for v in p)
        if good:
            self.deviation(np.array(p) - (np.array(o.zero_m) if o.zero_m else 0.0))
        self.watchdog(p, good, mode)
        # levels
        n, f = self.n, self.f
        up = mode == 2 and (self.fault == 0 or o.on_fault == "control") and n == self.N
        self.f = min(f + 1, self.F) if up else max(f - 1, 0)
        if mode in (1, 2):
            self.n = min(n + 1, self.N)
        elif f == 0:
            self.n = max(n - 1, 0)
        # controller
        phi = self.f / self.F
        w = phi * (self.C @ self.x + self.D @ self.e)
        r = np.clip(w, -o.limit_m, o.limit_m)
        mu = 0.0 if self.f == 0 else 1 - (1 - phi) * min(1.0, 16 / self.F)
        self.x = mu * (self.A @ self.x + self.B @ self.e + self.L @ (r - w))
        rest = o.offset_m * self.n / self.N
        stack = np.clip(rest + np.array([r[1], r[0], -r[1], -r[0]]), 0, o.stroke_m)  # Eq. 1: x by stacks 2 and 4
        return stack, r, self.e.copy(), self.fault, not good, bool((np.abs(w) > o.limit_m).any())

    def deviation(self, value: np.ndarray) -> None:
        if self.o.median == 3:
            self.window = [*self.window, value][-3:]
            if len(self.window) == 1:
                return
            value = self.window[0] if len(self.window) == 2 else np.median(self.window, axis=0)
        for i, v in enumerate(value):
            before = self.accepted[i]
            if len(before) == 2 and self.o.spike_guard_m is not None:
                line = 2 * before[1] - before[0]
                if abs(v - line) <= self.o.spike_guard_m:
                    self.replaced[i] = 0
                elif self.replaced[i] < 3:
                    self.replaced[i] += 1
                    v = line
                else:
                    self.replaced[i] = 0
                    before = [v, v]
            self.accepted[i] = [*before, v][-2:]
            self.e[i] = v

    def watchdog(self, p: tuple[float, float], good: bool, mode: int) -> None:
        o = self.o
        self.bad = 0 if good else min(self.bad + 1, o.bad_samples)
        if good:
            for i in range(2):
                same = self.last is not None and p[i] == self.last[i]
                self.equal[i] = min(self.equal[i] + 1, o.stuck_samples) if same else 0
            self.last = p
            self.beyond = min(self.beyond + 1, o.beyond_samples) if np.hypot(*self.e) > o.disc_limit_m else 0
        found = (
            1 * (self.bad >= o.bad_samples)
            | 2 * (max(self.equal) >= o.stuck_samples)
            | 4 * (self.beyond >= o.beyond_samples)
        )
        self.fault = self.fault | found if mode == 2 else 0


def wild(seed: int, n: int) -> tuple[ChainOptions, list[ChainInput]]:
    """Options and samples with any sequence of modes, positions near and far, stuck sensors and faulty samples."""
    random = np.random.default_rng(seed)
    options = ChainOptions(
        stroke_m=2 * LIMIT,
        disc_limit_m=BEYOND,
        ramp_s=float(random.choice([1e-4, 2e-3, 0.01])),
        fade_s=float(random.choice([1e-4, 1e-3, 4e-3, 0.02])),
        median=int(random.choice([1, 3])),
        spike_limit_m=[None, "auto", 3e-6][random.integers(3)],
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
@pytest.mark.parametrize("seed", range(2))
def test_any_sequence_of_modes_is_what_the_page_says(kind: str, seed: int) -> None:
    options, samples = wild(10 * seed + len(kind), 1500)
    controller = design(kind)
    chain = chain_of(controller, options=options)
    page = FromThePage(controller.sampled_at(), chain.options)
    expected = [page.step(each.position, int(each.mode)) for each in samples]
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
