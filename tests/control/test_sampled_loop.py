"""The loop as it runs: against a simulation in fine steps that knows nothing of the exact discretisation."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import cont2discrete

import gbid
from gbid.control import close_loop, controller_model, exact_plant, p_controller, sample_controller, sampled_loop
from gbid.control.loop.close import sample_plant
from gbid.control.loop.norm import largest_singular_values
from gbid.core.errors import UsageError
from gbid.structure import LinearModel

MACHINE = gbid.load_model("theisen2016")
PAPER = p_controller(1.125, 0.99)
TS = 2e-4


def with_delay(plant: LinearModel, delay: list[float]) -> LinearModel:
    return replace(plant, delay=np.array(delay))


def fine_steps(
    plant: LinearModel, controller: LinearModel, late: list[int], computation: int, start: np.ndarray, n: int
) -> np.ndarray:
    """Positions at the samples, the plant stepped 20 times a sample; delays are whole steps of that."""
    assert plant.B_delayed is not None
    h = TS / 20
    big = expm(np.block([[plant.A, plant.B_delayed], [np.zeros((2, plant.n_states + 2))]]) * h)
    F, G = big[: plant.n_states, : plant.n_states], big[: plant.n_states, plant.n_states :]
    x, xc, held = start.copy(), np.zeros(controller.n_states), np.zeros(2)
    waiting: deque[tuple[int, np.ndarray]] = deque()  # references computed but not out yet
    lines = [deque([0.0] * steps) for steps in late]  # references on their way into the rotor
    positions = []
    for step in range(20 * n):
        if step % 20 == 0:
            p = plant.C @ x
            positions.append(p)
            waiting.append((step + computation, controller.C @ xc + controller.D @ p))
            xc = controller.A @ xc + controller.B @ p
        while waiting and waiting[0][0] <= step:
            held = waiting.popleft()[1]
        arriving = np.empty(2)
        for i, line in enumerate(lines):
            line.append(held[i])
            arriving[i] = line.popleft()
        x = F @ x + G @ arriving
    return np.array(positions)


@pytest.mark.parametrize("computation", [0, 7, 20, 33])
@pytest.mark.parametrize("late", [[57, 12], [20, 0], [3, 83]])
def test_closed_loop_sample_by_sample(late: list[int], computation: int) -> None:
    plant = with_delay(exact_plant(MACHINE, 6, 0), [k * TS / 20 for k in late])
    loop = sampled_loop(plant, PAPER, TS, computation_s=computation * TS / 20)
    start = np.zeros(plant.n_states)
    start[6:8] = 0.01, -0.02  # velocities after an impact
    expected = fine_steps(plant, loop.controller, late, computation, start, 150)
    state = np.concatenate([start, np.zeros(loop.closed.n_states - plant.n_states)])
    got = loop.closed.simulate(np.zeros((150, 2)), initial_state=state)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize("point", [(6, 0), (3, 6000)])
def test_fast_sampling_is_the_continuous_loop(point: tuple[float, float]) -> None:
    """Damping and peak come to the continuous ones as c1 h + c2 h^2: extrapolated twice they are the same.

    Not so the peak at 3 bar, 6000 rpm: there it gives way to the gain at rest, which sampling does not change.
    """
    plant = exact_plant(MACHINE, *point)
    expected = [close_loop(gbid.structure.with_pade(plant, 8), PAPER).modes()[0][1]]
    if point == (6, 0):
        expected.append(gbid.sensitivities(plant, PAPER).peak("output").value)
    results = []
    for step in (8e-5, 4e-5, 2e-5):
        loop = sampled_loop(plant, PAPER, step, computation_s=0.0)
        results.append([loop.modes[0][1], loop.peak_output.value][: len(expected)])
    errors = np.array(results) - expected
    np.testing.assert_allclose(errors[2] / errors[1], 0.5, atol=0.03)
    once = 2 * errors[1:] - errors[:-1]
    np.testing.assert_allclose(4 * once[1] - once[0], 0.0, atol=2e-5)


def test_peak_of_the_sampled_loop_on_a_dense_grid() -> None:
    loop = sampled_loop(exact_plant(MACHINE, 7, 6000), p_controller(1.4, 1.2), TS)
    grid = np.linspace(0, 2500, 5001)
    top = grid[largest_singular_values(loop.sensitivities.response("output", grid)).argmax()]
    around = np.linspace(max(top - 0.5, 0.0), top + 0.5, 1001)
    dense = largest_singular_values(loop.sensitivities.response("output", around)).max()
    assert loop.peak_output.value == pytest.approx(dense, rel=1e-6)


@pytest.mark.parametrize("kind", ["P", "PD", "biquad"])
@pytest.mark.parametrize(("method", "scipys"), [("tustin", "bilinear"), ("zoh", "zoh")])
def test_sampled_controllers_by_scipy(kind: str, method: str, scipys: str) -> None:
    structure = gbid.controller_structure(kind)
    rng = np.random.default_rng(4)
    gains = {p.name: rng.uniform(max(p.lower, -2), min(p.upper, 2)) for p in structure.parameters}
    controller = controller_model(structure, gains)
    sampled = sample_controller(controller, TS, method)  # type: ignore[arg-type]
    *matrices, _ = cont2discrete((controller.A, controller.B, controller.C, controller.D), TS, scipys)
    expected = LinearModel(*matrices, dt=TS)  # type: ignore[misc]
    f = np.array([0.0, 30.0, 400.0, 2400.0])
    np.testing.assert_allclose(
        sampled.frequency_response(f),
        expected.frequency_response(f),
        rtol=1e-10,
        atol=1e-12 * np.abs(matrices[3]).max(),
    )
    assert sampled.is_stable()


def test_prompt_and_direct_inputs_wait_for_the_computation() -> None:
    plant = LinearModel([[-100.0]], [[50.0]], [[1.0]], [[0.5]])
    now, delayed = sample_plant(plant, 1e-3), sample_plant(plant, 1e-3, 2e-3)
    u = np.random.default_rng(0).normal(size=(30, 1))
    expected = np.vstack([np.zeros((2, 1)), now.simulate(u)[:-2]])
    np.testing.assert_allclose(delayed.simulate(u), expected, rtol=1e-12, atol=1e-14)


def test_published_loop_gains_damping_by_the_lag_of_its_computer() -> None:
    """One sample of computation adds lag, which the paper's positive feedback turns into damping."""
    plant = exact_plant(MACHINE, 6, 0)
    continuous = close_loop(MACHINE.plant_at(6, 0), PAPER).modes()[0][1]
    at_once = sampled_loop(plant, PAPER, TS, computation_s=0.0).damping
    one_sample = sampled_loop(plant, PAPER, TS).damping
    assert continuous < at_once < one_sample
    assert sampled_loop(plant, PAPER, TS, computation_s=6e-3).stable is False


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: sample_plant(MACHINE.plant_at(6, 0), -1.0), "sample_time = -1.0 s; give a positive"),
        (lambda: sample_plant(MACHINE.plant_at(6, 0), TS, -1.0), "computation_s = -1.0 s; it must not be negative"),
        (lambda: sample_plant(MACHINE.plant_at(6, 0).discretise(TS), TS), "is sampled already, at 0.0002 s"),
        (lambda: sample_controller(PAPER, TS, "euler"), "method = 'euler'; choose 'tustin' or 'zoh'"),  # type: ignore[arg-type]
        (lambda: sample_controller(sample_controller(PAPER, TS), TS), "is sampled already"),
        (lambda: sample_controller(PAPER, 0.0), "sample_time = 0.0 s; give a positive"),
        (lambda: sampled_loop(MACHINE.plant_at(6, 0), sample_controller(PAPER, 1e-3), TS), "bring both to one time"),
        (lambda: exact_plant(MACHINE, 9, 0), "lies outside its domain"),
    ],
)
def test_bad_input(make: object, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        make()  # type: ignore[operator]
