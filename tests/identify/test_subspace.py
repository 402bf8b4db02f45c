"""Models without structure: their order, and several of them side by side; data of scipy."""

import numpy as np
import pytest
from scipy import signal

import gbid
from gbid import LinearStructure, Parameter
from gbid.core.errors import UsageError

h = 1e-3
FREQUENCIES = (30.0, 80.0, 150.0)


def recording(modes, seed, n=3000, noise=0.05):
    """Response of light modes to held noise."""
    A, B, C = np.zeros((2 * modes, 2 * modes)), np.zeros((2 * modes, 1)), np.zeros((1, 2 * modes))
    for i, frequency in enumerate(FREQUENCIES[:modes]):
        w = 2 * np.pi * frequency
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[0, 1], [-(w**2), -0.06 * w]]
        B[2 * i + 1], C[0, 2 * i] = w**2, 1.0
    sampled = signal.cont2discrete((A, B, C, np.zeros((1, 1))), h)
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n, 1))
    y = signal.dlsim((*sampled[:4], h), u)[1]
    y += noise * y.std() * rng.standard_normal(y.shape)
    return gbid.Recording({"u": u, "y": y}, h, name=f"run {seed}")


@pytest.mark.parametrize("modes", [1, 2, 3])
def test_the_order_is_that_of_the_system(modes):
    for seed in range(2):
        model = gbid.subspace(recording(modes, seed))
        assert model.n_states == 2 * modes
        found = np.array(model.modes())
        np.testing.assert_allclose(found[:, 0], FREQUENCIES[:modes], rtol=2e-3)
        np.testing.assert_allclose(found[:, 1], 0.03, rtol=0.05)


def spring(p):
    return {"A": [[0, 1], [-p.k, -p.d]], "B": [[0], [p.b]], "C": [[1, 0]]}


SPRING = LinearStructure("spring", [Parameter("k", 3e4), Parameter("d", 10.0), Parameter("b", 3e4)], spring)


def test_models_are_compared_on_data_that_none_has_seen(tmp_path):
    seen, unseen = recording(2, 0), recording(2, 1)
    models = {
        "grey": gbid.fit(SPRING, seen, focus="simulation"),
        "right": gbid.subspace(seen),
        "order 8": gbid.subspace(seen, 8),
    }
    comparison = gbid.compare(models, unseen)
    assert comparison.orders.tolist() == [2, 4, 8]
    assert comparison.parameters.tolist() == [3, 8, 16]
    assert np.argmin(comparison.aic) == 1
    grey, right, large = comparison.fit_percent[:, 0, 0]
    assert grey < 80 < right == pytest.approx(95, abs=0.5)  # noise of 5 %
    assert large == pytest.approx(right, abs=0.5)
    assert comparison.whiteness[0, 0] < 1e-6 < comparison.whiteness[1, 0]
    again = gbid.cross_validate(models["grey"], unseen)
    assert grey == pytest.approx(again.fit_percent[0])
    assert comparison.table().rows[1][:3] == ["right", "y", 4]
    axes = comparison.plot()
    assert len(axes[0, 0].lines) >= 3


def test_an_unstable_plant_in_its_loop_has_the_order_that_is_stated():
    rng, x, n = np.random.default_rng(3), np.zeros(2), 4000
    A, B = np.array([[1.002, 0.05], [0.0, 0.95]]), np.array([0.0, 0.1])
    u, y, noise = np.zeros(n), np.zeros(n), 1e-3 * rng.standard_normal(n)
    for k, push in enumerate(rng.standard_normal(n)):
        y[k] = x[0] + noise[k]
        u[k] = push - 2.0 * y[k]
        x = A @ x + B * u[k]
    model = gbid.subspace(gbid.Recording({"u": u, "y": y}, h), 2)
    np.testing.assert_allclose(sorted(np.linalg.eigvals(model.A).real), [0.95, 1.002], atol=5e-3)


@pytest.mark.parametrize("order", [0, -1, True, "many"])
def test_orders_that_are_no_numbers_of_states_are_refused(order):
    with pytest.raises(UsageError, match="order"):
        gbid.subspace(recording(1, 0, 500), order)


def test_models_of_other_signals_are_refused():
    model = gbid.subspace(recording(1, 0), 2)
    other = gbid.Recording({"r": np.ones((100, 1)), "y": np.ones((100, 1))}, h)
    with pytest.raises(UsageError, match="give inputs"):
        gbid.compare(model, other)
