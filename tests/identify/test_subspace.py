"""Models without structure: their order, and several of them side by side; data of scipy."""

import numpy as np
import pytest
from experiment_files import json_of, printed_by
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
        values = np.array(model.modes())
        np.testing.assert_allclose(values[:, 0], FREQUENCIES[:modes], rtol=2e-3)
        np.testing.assert_allclose(values[:, 1], 0.03, rtol=0.05)


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


def test_what_chooses_the_order_is_shown():
    orders = gbid.identify.subspace_orders(recording(2, 0))
    assert orders.order == gbid.subspace(recording(2, 0)).n_states == 4
    assert orders.singular_values[3] > 10 * orders.singular_values[4]  # two modes
    assert orders.errors[2] > 50 * orders.errors[3]
    assert orders.errors[3] == pytest.approx(0.05**2, rel=0.5)  # the noise
    left, right = orders.plot()
    assert right.get_title(loc="right") == "chosen: 4"
    assert len(left.lines[0].get_xdata()) == len(orders.errors) == len(orders.table().rows)


def test_models_are_compared_over_the_outputs_that_they_share():
    both = recording(2, 0)
    both = gbid.Recording({**both.signals, "z": -2 * both.signal("y")}, h, name="both")
    wide, narrow = gbid.subspace(both, 4, outputs=("z", "y")), gbid.subspace(both, 4, outputs="y")
    comparison = gbid.compare({"wide": wide, "narrow": narrow}, both)
    assert comparison.outputs == ("y",)
    alone = gbid.compare({"narrow": narrow}, both)
    np.testing.assert_array_equal(comparison.fit_percent[1], alone.fit_percent[0])
    assert [list(figure.values[0]) for figure in comparison.figures()] == [["wide"], ["narrow"]]
    with pytest.raises(UsageError, match="no output in common: 'wide' has y; 'narrow' has z"):
        gbid.compare({"wide": narrow, "narrow": gbid.subspace(both, 4, outputs="z")}, both)


def test_models_are_compared_from_the_command_line(tmp_path, capsys):
    paths = [tmp_path / f"run{seed}.h5" for seed in (0, 1)]
    for seed, path in enumerate(paths):
        gbid.save_recording(recording(2, seed), path)
    fit = tmp_path / "grey.h5"
    gbid.save(gbid.fit(SPRING, gbid.load_recording(paths[0]), focus="simulation"), fit)
    page = tmp_path / "models.html"
    made = json_of(capsys, "compare", fit, "--plain", paths[0], "--on", paths[1], "--output", page)
    assert made["order"] == 4
    grey, plain = made["models"]
    assert (plain["model"], plain["states"]) == ("subspace model of order 4", 4)
    assert grey["fit_percent"] < 80 < plain["fit_percent"] == pytest.approx(95, abs=0.5)
    text = page.read_text()
    assert "Models on run 1" in text
    assert text.count("<svg") == 2
    assert "subspace model of order 4" in printed_by(capsys, "compare", fit, "--plain", paths[0], "--on", paths[1]).out
    assert "--on is missing" in printed_by(capsys, "compare", fit, code=2).err


def test_a_fit_to_responses_is_compared_at_any_sample_time():
    f = np.linspace(20, 40, 60)
    exact = gbid.LinearModel([[0, 1], [-(188.5**2), -11.3]], [[0], [188.5**2]], [[1, 0]], [[0]]).frequency_response(f)
    fitted = gbid.fit(SPRING, gbid.FrequencyData(f, exact, 1e-2))
    result = gbid.compare(fitted, recording(1, 0))
    assert result.fit_percent[0, 0, 0] == pytest.approx(95, abs=1)
