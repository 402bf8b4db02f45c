"""LinearModel against scipy.signal and closed forms."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from gbid.core.errors import UsageError
from gbid.structure import LinearModel


def oscillators() -> LinearModel:
    """Two coupled oscillators with feedthrough: four states, two inputs, three outputs."""
    K, D = np.array([[-400.0, 30.0], [10.0, -900.0]]), np.array([[-2.0, 0.3], [-0.1, -5.0]])
    rng = np.random.default_rng(3)
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [K, D]])
    return LinearModel(A, rng.normal(size=(4, 2)), rng.normal(size=(3, 4)), rng.normal(size=(3, 2)))


def one_mode(frequency_hz: float, damping: float) -> LinearModel:
    w = 2 * np.pi * frequency_hz
    return LinearModel([[0, 1], [-(w**2), -2 * damping * w]], [[0], [w**2]], [[1, 0]], [[0]])


def static(D: list[list[float]]) -> LinearModel:
    n_y, n_u = np.shape(D)
    return LinearModel(np.zeros((0, 0)), np.zeros((0, n_u)), np.zeros((n_y, 0)), D)


def scipy_model(model: LinearModel, dt: float | None = None) -> signal.StateSpace:
    return signal.StateSpace(model.A, model.B, model.C, model.D, **({"dt": dt} if dt else {}))


@pytest.mark.parametrize(("frequency", "damping"), [(126.59, 0.03523), (3.0, 0.9), (10.0, 0.0), (10.0, -0.2)])
def test_modes_of_a_known_oscillator(frequency: float, damping: float) -> None:
    model = one_mode(frequency, damping)
    assert model.modes() == [pytest.approx((frequency, damping), abs=1e-12, rel=1e-10)]
    assert model.is_stable() is (damping > 0)
    sampled = model.discretise(0.02 / frequency)
    assert sampled.modes() == [pytest.approx((frequency, damping), rel=1e-9, abs=1e-11)]
    assert sampled.is_stable() is (damping > 0) or damping == 0


def test_real_poles_are_no_modes() -> None:
    model = LinearModel(np.diag([-5.0, -1.0]), np.ones((2, 1)), np.ones((1, 2)), [[0.0]])
    assert model.modes() == []
    np.testing.assert_allclose(model.poles(), [-1, -5])


def test_modes_come_by_rising_frequency() -> None:
    frequencies = [f for f, _ in oscillators().modes()]
    assert len(frequencies) == 2
    assert frequencies == sorted(frequencies)
    assert frequencies[0] == pytest.approx(20 / (2 * np.pi), rel=0.01)


def test_discretise_is_scipys_zero_order_hold() -> None:
    model = replace(oscillators(), K=np.arange(12.0).reshape(4, 3))
    sampled = model.discretise(0.01)
    F, G, *_ = signal.cont2discrete((model.A, model.B, model.C, model.D), 0.01)
    np.testing.assert_allclose(sampled.A, F, rtol=0, atol=1e-12)
    np.testing.assert_allclose(sampled.B, G, rtol=0, atol=1e-12)
    assert model.K is not None
    assert sampled.K is not None
    _, held, *_ = signal.cont2discrete((model.A, model.K, model.C, np.zeros((3, 3))), 0.01)
    np.testing.assert_allclose(sampled.K, held, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(sampled.C, model.C)
    assert sampled.dt == 0.01
    np.testing.assert_allclose(sampled.static_gain(), model.static_gain(), rtol=1e-9)


def test_an_integrator_has_no_static_gain() -> None:
    model = LinearModel([[0, 1], [0, -5]], [[0], [1]], [[1, 0]], [[0]])
    for integrator in (model, model.discretise(0.1)):
        with pytest.raises(UsageError, match="has an integrator"):
            integrator.static_gain()


@pytest.mark.parametrize("n_samples", [1, 2, 17, 500])
@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_simulate_is_scipys_lsim(n_samples: int, hold: str) -> None:
    model = oscillators()
    rng = np.random.default_rng(n_samples)
    u, x0, h = rng.normal(size=(n_samples, 2)), rng.normal(size=4), 0.013
    y = model.simulate(u, h, initial_state=x0, intersample=hold)
    assert y.shape == (n_samples, 3)
    if n_samples == 1:
        np.testing.assert_allclose(y[0], model.C @ x0 + model.D @ u[0])
        return
    _, expected, _ = signal.lsim(scipy_model(model), u, h * np.arange(n_samples), X0=x0, interp=hold == "foh")
    np.testing.assert_allclose(y, expected, rtol=1e-8, atol=1e-9)


def test_simulate_discrete_is_scipys_dlsim() -> None:
    model = oscillators().discretise(0.01)
    u = np.random.default_rng(4).normal(size=(123, 2))
    _, expected, _ = signal.dlsim(scipy_model(model, 0.01), u)
    np.testing.assert_allclose(model.simulate(u), expected, rtol=1e-9, atol=1e-11)
    np.testing.assert_array_equal(model.simulate(u), model.simulate(u, 0.01))


def test_frequency_response_is_scipys() -> None:
    model = oscillators()
    frequency = np.array([0.1, 3.2, 4.77, 50.0])
    response = model.frequency_response(frequency)
    assert response.shape == (4, 3, 2)
    sampled = model.discretise(0.005)
    sampled_response = sampled.frequency_response(frequency)
    for i in range(3):
        for j in range(2):
            part = model.A, model.B[:, [j]], model.C[[i]], model.D[[i], [j]]
            _, expected = signal.freqresp(signal.StateSpace(*part), 2 * np.pi * frequency)
            np.testing.assert_allclose(response[:, i, j], expected, rtol=1e-7, atol=1e-9)
            part = sampled.A, sampled.B[:, [j]], sampled.C[[i]], sampled.D[[i], [j]]
            system = signal.StateSpace(*part, dt=0.005)
            _, expected = signal.dfreqresp(system, 2 * np.pi * frequency * 0.005)
            np.testing.assert_allclose(sampled_response[:, i, j], expected, rtol=1e-6, atol=1e-7)


def test_frequency_response_at_rest_is_the_static_gain() -> None:
    for model in (oscillators(), oscillators().discretise(0.003), static([[1.0, -4.0]])):
        response = model.frequency_response(0.0)
        np.testing.assert_allclose(response[0].real, model.static_gain(), rtol=1e-9)
        np.testing.assert_array_equal(response[0].imag, 0)


def test_frequency_response_on_a_pole() -> None:
    integrator = LinearModel([[0.0]], [[1.0]], [[1.0]], [[0.0]])
    with pytest.raises(UsageError, match="a pole at one of the given frequencies"):
        integrator.frequency_response([0.0, 1.0])
    with pytest.raises(UsageError, match="frequency_hz holds values that are not finite"):
        integrator.frequency_response([np.nan])


def test_a_model_without_states() -> None:
    model = static([[2.0], [0.5]])
    assert model.is_stable()
    assert model.modes() == []
    np.testing.assert_allclose(model.simulate([[1.0], [3.0]], 0.1), [[2, 0.5], [6, 1.5]])
    np.testing.assert_allclose(model.discretise(0.1).frequency_response([1.0, 2.0])[:, :, 0], [[2, 0.5]] * 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"A": np.ones((4, 3))}, r"A has shape \(4, 3\), expected \(4, 4\)"),
        ({"B": np.ones((3, 2))}, r"B has shape \(3, 2\), expected \(4, 2\)"),
        ({"C": np.ones((3, 5))}, r"C has shape \(3, 5\), expected \(3, 4\)"),
        ({"D": np.ones((2, 2))}, r"D has shape \(2, 2\), expected \(3, 2\)"),
        ({"K": np.ones((4, 2))}, r"K has shape \(4, 2\), expected \(4, 3\)"),
        ({"B": np.full((4, 2), np.nan)}, "B holds entries that are not finite"),
        ({"input_names": ("u",)}, "input_names has 1 names for 2"),
        ({"dt": 0.0}, "sample time 0.0 s; it must be a positive number"),
        ({"dt": np.nan}, "sample time nan s"),
    ],
)
def test_models_that_do_not_fit_together(change: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        replace(oscillators(), **change)


def test_wrong_simulations() -> None:
    model = oscillators()
    u = np.ones((5, 2))
    for arguments, message in (
        ((u,), "is continuous: give the sample time"),
        ((u, -0.1), "sample time -0.1 s"),
        ((np.ones((5, 3)), 0.1), r"inputs have shape \(5, 3\), expected \(n_samples, 2\)"),
        ((np.ones(5), 0.1), r"inputs have shape \(5,\)"),
        ((u * np.nan, 0.1), "inputs hold values that are not finite"),
    ):
        with pytest.raises(UsageError, match=message):
            model.simulate(*arguments)
    with pytest.raises(UsageError, match=f"model '{model.name}': inputs have shape"):
        model.predict(np.ones((5, 3)), np.ones((5, 2)), 0.1)
    with pytest.raises(UsageError, match=r"initial_state has shape \(3,\), expected \(4,\)"):
        model.simulate(u, 0.1, initial_state=np.zeros(3))
    with pytest.raises(UsageError, match="choose 'zoh' or 'foh'"):
        model.simulate(u, 0.1, intersample="linear")
    sampled = model.discretise(0.1)
    with pytest.raises(UsageError, match=r"has sample time 0\.1 s, not 0\.2 s"):
        sampled.simulate(u, 0.2)
    with pytest.raises(UsageError, match="its inputs cannot be interpolated"):
        sampled.simulate(u, intersample="foh")
    with pytest.raises(UsageError, match="is discrete already"):
        sampled.discretise(0.1)
    for wrong in (0.0, float("nan")):
        with pytest.raises(UsageError, match=f"sample time {wrong} s"):
            model.discretise(wrong)


def test_values_are_frozen_copies() -> None:
    A = -np.eye(2)
    model = LinearModel(A, np.ones((2, 1)), np.ones((1, 2)), [[0.0]])
    A[0, 0] = 99.0
    assert model.A[0, 0] == -1.0
    with pytest.raises(ValueError, match="read-only"):
        model.A[0, 0] = 1.0
    copy = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(copy.A, model.A)
    assert copy.state_names == ("x1", "x2")
