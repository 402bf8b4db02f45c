"""Designs for the loop as it runs: the delay of sampling and computation, and what the sampled loop reaches."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import ss2tf

import gbid
from gbid.control import MaxDamping, controller_model, exact_plant, p_controller, sampled_loop, smallest_damping
from gbid.core.errors import UsageError

MODEL = gbid.load_model("theisen2016")
ONE = [(6.0, 0.0)]
BEST = 0.8495
"""The best damping known of the sampled biquad at 6 bar, peak 2.0 and 0.2 ms."""
BIQUAD = """
import json, sys, gbid
model = gbid.load_model("theisen2016")
asked = dict(operating_points=[(6.0, 0.0)], peak_sensitivity=2.0, sample_time=2e-4, seed=int(sys.argv[1]))
found = gbid.tune(model, "biquad", **asked)
print(json.dumps({"status": str(found.status), "value": found.value, "gains": dict(found.gains)}))
"""


def test_design_for_sampling_is_true_of_the_sampled_loop_and_damps_it_more() -> None:
    points = [(3.0, 0.0), (3.0, 6000.0), (7.0, 0.0), (7.0, 6000.0)]
    continuous = gbid.tune(MODEL, operating_points=points, starts=1)
    runs = gbid.tune(MODEL, operating_points=points, sample_time=2e-4, starts=1)
    assert runs.success
    assert runs.sample_time == 2e-4

    def sampled(gains: object) -> tuple[float, float]:
        loops = [sampled_loop(exact_plant(MODEL, *point), p_controller(**gains)) for point in points]
        return min(loop.damping for loop in loops), max(loop.peak_output.value for loop in loops)

    damping, peak = sampled(runs.gains)
    assert damping == pytest.approx(runs.value, abs=2e-3)
    assert peak == pytest.approx(2.6, abs=5e-3)
    assert damping > sampled(continuous.gains)[0] + 0.04
    assert f"damping factor of {damping:.3f}" in runs.notes[-1]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 5, 17])
def test_sampled_biquad_is_the_best_known_and_true_of_the_sampled_loop(seed: int) -> None:
    """With kernels as users compile them. From the best continuous design alone seeds 1 and 5 end at 0.716 and 0.731.

    Climbed with first steps of one length only, seed 17 ends at 0.818.

    At the best design five eigenvalues meet: whether a design beside it has a certificate hangs on rounding.
    """
    environment = {name: value for name, value in os.environ.items() if name != "GBID_CFLAGS"}
    command = [sys.executable, "-c", BIQUAD, str(seed)]
    said = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    document = json.loads(said.stdout)
    assert document["status"] in ("local optimum", "stalled")
    assert document["value"] > 0.995 * BEST
    controller = controller_model(gbid.controller_structure("biquad"), document["gains"])
    loop = sampled_loop(exact_plant(MODEL, *ONE[0]), controller, 2e-4)
    assert loop.damping == pytest.approx(document["value"], rel=1e-2)
    assert loop.peak_output.value == pytest.approx(2.0, rel=1e-3)


def test_computation_costs_damping() -> None:
    options = {"operating_points": ONE, "sample_time": 2e-4, "starts": 0}
    quick, slow = (gbid.tune(MODEL, computation_s=seconds, **options) for seconds in (0.0, 4e-4))
    assert quick.value != pytest.approx(slow.value, abs=1e-3)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"computation_s": 1e-4}, "give sample_time as well"),
        ({"sample_time": 0.0}, "above 0"),
        ({"sample_time": 2e-4, "computation_s": -1e-4}, "0 or more"),
    ],
)
def test_times_that_make_no_sense_are_refused(options: dict[str, float], word: str) -> None:
    with pytest.raises(UsageError, match=word):
        gbid.tune(MODEL, operating_points=ONE, **options)


def test_modes_that_die_within_a_sample_do_not_count() -> None:
    dt = 2e-4

    def model(*eigenvalues: complex) -> gbid.LinearModel:
        A = np.zeros((2 * len(eigenvalues),) * 2)
        for i, z in enumerate(eigenvalues):
            A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[z.real, z.imag], [-z.imag, z.real]]
        return gbid.LinearModel(A, np.zeros((len(A), 1)), np.zeros((1, len(A))), np.zeros((1, 1)), dt=dt)

    slow, fast = np.exp(dt * 2 * np.pi * 100 * (-0.5 + 0.75**0.5 * 1j)), 0.3 * np.exp(2j)
    assert smallest_damping(model(slow)) == pytest.approx(0.5)
    assert smallest_damping(model(slow, 0.9 * np.exp(2j))) < 0.1
    assert smallest_damping(model(slow, fast)) == pytest.approx(0.5)
    within = np.exp(dt * (-0.8 / dt + 2j * np.pi * 2000))  # it dies within more than a sample
    assert smallest_damping(model(slow, within)) == pytest.approx(4000 / np.hypot(4000, 4000 * np.pi))


def test_half_of_a_budget_is_for_the_sampled_loop() -> None:
    """The continuous search alone takes more than the budget; its design had only been judged in the sampled loop."""
    budgeted = gbid.tune(MODEL, "PD", operating_points=ONE, sample_time=2e-4, evaluations=600)
    assert budgeted.success
    assert budgeted.history[-1].count <= 620


def test_a_delay_of_87_samples_is_exact() -> None:
    """The modes are the roots of the characteristic polynomial of degree 89, and no static gain has a better one."""
    T, w, samples = 2.5e-4, 300.0, 87
    A, B, C = np.array([[0.0, 1.0], [-(w**2), -6.0]]), np.array([[0.0], [w**2]]), np.array([[1.0, 0.0]])
    late = {"B_delayed": B, "delay": np.array([(samples - 1) * T])}  # and a sample of computation
    plant = gbid.LinearModel(A, 0 * B, C, np.zeros((1, 1)), **late)
    gain, none = gbid.Parameter("k", 0.0, -0.5, 0.5, unit="m/m"), {"A": ca.SX(0, 0), "C": ca.SX(1, 0)}
    law = gbid.LinearStructure("static", [gain], lambda p: {**none, "D": [[p["k"]]]}, ("p",), ("r",))
    design = gbid.tune(plant, law, goals=[MaxDamping()], sample_time=T)

    held = expm(T * np.block([[A, B], [np.zeros((1, 3))]]))[:2]
    numerator, denominator = ss2tf(held[:, :2], held[:, 2:], C, np.zeros((1, 1)))

    def damping(k: float) -> float:
        z = np.roots(np.polysub(np.append(denominator, np.zeros(samples)), k * numerator[0]))
        rates = np.log(z[np.abs(z) > np.exp(-1)]) / T  # shorter modes do not oscillate visibly
        rates = rates[np.abs(rates.imag) > 1e-6 * np.abs(rates)]
        return float((-rates.real / np.abs(rates)).min())

    assert design.value == pytest.approx(damping(design.gains["k"]), rel=1e-6)
    assert design.value >= (1 - 1e-6) * max(damping(k) for k in np.linspace(-0.5, 0.5, 401))
