"""Closing the loop: against the frequency responses, brute-force simulation, and the sign of the paper."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gbid.control import close_loop, p_controller
from gbid.core.errors import UsageError
from gbid.structure import LinearModel

FREQUENCIES = np.array([0.0, 0.03, 0.2, 1.0, 7.0])


def random_model(rng: np.random.Generator, n: int, n_in: int, n_out: int, dt: float | None) -> LinearModel:
    A = rng.normal(size=(n, n))
    if dt is None:
        A -= (np.linalg.eigvals(A).real.max() + 0.5) * np.eye(n)
    else:
        A *= 0.8 / np.abs(np.linalg.eigvals(A)).max()
    B, C, D = rng.normal(size=(n, n_in)), rng.normal(size=(n_out, n)), 0.3 * rng.normal(size=(n_out, n_in))
    return LinearModel(A, B, C, D, dt=dt)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    sizes=st.tuples(st.integers(1, 4), st.integers(0, 3), st.integers(1, 3), st.integers(1, 3)),
    dt=st.sampled_from([None, 0.05]),
)
def test_closed_loop_is_the_sensitivity_times_the_plant(
    seed: int, sizes: tuple[int, int, int, int], dt: float | None
) -> None:
    n_g, n_k, n_in, n_out = sizes
    rng = np.random.default_rng(seed)
    plant, controller = random_model(rng, n_g, n_in, n_out, dt), None
    controller = (
        random_model(rng, n_k, n_out, n_in, dt)
        if n_k
        else LinearModel(
            np.zeros((0, 0)), np.zeros((0, n_out)), np.zeros((n_in, 0)), rng.normal(size=(n_in, n_out)), dt=dt
        )
    )
    closed = close_loop(plant, controller)
    G, K = plant.frequency_response(FREQUENCIES), controller.frequency_response(FREQUENCIES)
    expected = np.linalg.solve(np.eye(n_out) - G @ K, G)
    tolerance = 1e-9 * np.linalg.cond(np.eye(n_out) - G @ K).max() * np.abs(G).max()
    np.testing.assert_allclose(closed.frequency_response(FREQUENCIES), expected, rtol=0, atol=tolerance)
    assert closed.dt == dt
    assert closed.n_states == n_g + n_k


def test_sign_is_positive_feedback() -> None:
    """G = 1/(s + 1), K = k: the pole moves to -(1 - k), stable below k = 1."""
    plant = LinearModel([[-1.0]], [[1.0]], [[1.0]], [[0.0]])
    for gain in (-2.0, 0.4, 1.5):
        controller = LinearModel(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[gain]])
        closed = close_loop(plant, controller)
        assert closed.poles() == pytest.approx([gain - 1.0])
        assert closed.is_stable() is (gain < 1)


def test_ill_posed_loop_is_refused() -> None:
    def static(d: float) -> LinearModel:
        return LinearModel(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[d]], name=f"gain {d}")

    with pytest.raises(UsageError, match=r"not well posed: I - D_K D_G is singular"):
        close_loop(static(0.25), static(4.0))
    with pytest.raises(UsageError, match="not well posed"):
        close_loop(static(1e-7 / 3), static(3e7))
    np.testing.assert_allclose(close_loop(static(0.25), static(3.0)).D, [[1.0]])


def test_models_that_do_not_fit() -> None:
    rng = np.random.default_rng(1)
    plant = random_model(rng, 2, 2, 2, None)
    with pytest.raises(UsageError, match=r"the plant is continuous, the controller sampled at 0\.1 s"):
        close_loop(plant, random_model(rng, 2, 2, 2, 0.1))
    with pytest.raises(UsageError, match="bring both to one time"):
        close_loop(random_model(rng, 2, 2, 2, 0.2), random_model(rng, 2, 2, 2, 0.1))
    with pytest.raises(UsageError, match="2 plant outputs to the controller, which takes 1"):
        close_loop(plant, random_model(rng, 2, 1, 2, None))
    with pytest.raises(UsageError, match="1 controller outputs to the plant, which takes 2"):
        close_loop(plant, random_model(rng, 2, 2, 1, None))
    crossed = replace(plant, output_names=("p_y", "p_x"))
    with pytest.raises(UsageError, match="come in another order: p_y, p_x to p_x, p_y"):
        close_loop(crossed, p_controller(1, 1))


def test_names_and_states_of_the_loop() -> None:
    plant = random_model(np.random.default_rng(2), 3, 2, 2, None)
    plant = replace(plant, input_names=("r_x", "r_y"), output_names=("p_x", "p_y"), K=np.ones((3, 2)))
    closed = close_loop(plant, p_controller(0.1, 0.2))
    assert (closed.input_names, closed.output_names) == (("r_x", "r_y"), ("p_x", "p_y"))
    assert closed.state_names == ("x1", "x2", "x3", "p_controller.lowpass1_x", "p_controller.lowpass1_y")
    assert closed.K is None


@pytest.mark.parametrize("order", [0, 1, 2, 5])
def test_p_controller_is_equation_21(order: int) -> None:
    controller = p_controller(1.5, -0.7, lowpass_hz=300.0, order=order)
    frequency = np.array([0.0, 10.0, 300.0, 4000.0])
    pole = 2 * np.pi * 300.0
    lowpass = (pole / (2j * np.pi * frequency + pole)) ** order
    expected = lowpass[:, None, None] * np.diag([1.5, -0.7])
    np.testing.assert_allclose(controller.frequency_response(frequency), expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(controller.static_gain(), np.diag([1.5, -0.7]), rtol=1e-12)
    assert controller.n_states == 2 * order
    assert (controller.input_names, controller.output_names) == (("p_x", "p_y"), ("r_x", "r_y"))
