"""The portable pass over the samples against plain loops."""

from types import SimpleNamespace

import numpy as np
import pytest
from fit_cases import EVERY, EVERY_AT, H, fit_data, smooth

from gbid.identify.kernel.blocks import cut
from gbid.identify.kernel.linear import PortableLinearKernel
from gbid.identify.predictor import build_predictor

KERNEL = PortableLinearKernel()
WEIGHT = np.array([[2.0, 0.7], [0.7, 1.0]])
SIZES = {
    "one window": ((47,), None),
    "last window of one sample": ((50,), 7),
    "windows that fit": ((48,), 8),
    "three records, three lengths": ((50, 23, 31), 10),
    "records shorter than a window": ((40, 9, 12), 20),
    "one window of several blocks": ((1300,), None),
    "windows of several blocks": ((1400, 700), 600),
    "odd windows of several blocks": ((1511, 530, 1100), 777),
}


SLOW = {**EVERY_AT, "a": 0.01}  # in simulation focus its states are still alive after a thousand samples


def case(lengths, window, focus="prediction", values=EVERY_AT):
    """Predictor, its values, blocks, and some window starts that meet nothing."""
    predictor = build_predictor(EVERY, {}, H, ("zoh", "foh"), focus)
    theta = np.array([values[q.name] for q in predictor.free])
    data = fit_data([(smooth(n, seed=i), smooth(n, seed=50 + i)) for i, n in enumerate(lengths)])
    blocks = cut(data, predictor, window)
    starts = np.random.default_rng(9).normal(size=(blocks.n_windows, 2))
    return SimpleNamespace(predictor=predictor, theta=theta, data=data, blocks=blocks, starts=starts)


def windows_of(c):
    """Regressors, outputs of each window and whether another follows in its record."""
    size = c.blocks.length * c.blocks.per_window
    for record in c.data.records:
        z = c.predictor.regressors(record.inputs, record.outputs, ())
        for first in range(0, record.n_samples, size):
            part = slice(first, first + size)
            yield z[part], record.outputs[part], first + size < record.n_samples


def by_hand(c):
    """All sums by a loop over samples; state and sensitivities side by side."""
    v = c.predictor.at(c.theta)
    n, n_p, n_y = len(v.F), len(c.theta), len(v.C)
    lists = ("gradient_start", "hessian_mixed", "hessian_start", "end", "end_theta", "end_start", "linked", "errors")
    sums = {"error_products": np.zeros((n_y, n_y)), "gradient": np.zeros(n_p), "hessian": np.zeros((n_p, n_p))}
    total = SimpleNamespace(**sums, **{name: [] for name in lists})
    for w, (z, y, follows) in enumerate(windows_of(c)):
        x, s, t = c.starts[w], np.zeros((n, n_p)), np.eye(n)
        g, m, h = np.zeros(n), np.zeros((n_p, n)), np.zeros((n, n))
        for zk, yk in zip(z, y, strict=True):
            e = yk - v.C @ x - v.H @ zk
            psi = v.C @ s + (v.dC @ x + v.dH @ zk).T
            phi = v.C @ t
            total.error_products += np.outer(e, e)
            total.gradient -= psi.T @ WEIGHT @ e
            total.hessian += psi.T @ WEIGHT @ psi
            g -= phi.T @ WEIGHT @ e
            m += psi.T @ WEIGHT @ phi
            h += phi.T @ WEIGHT @ phi
            total.errors.append(e)
            s = v.F @ s + (v.dF @ x + v.dG @ zk).T
            x, t = v.F @ x + v.G @ zk, v.F @ t
        for name, value in zip(lists, (g, m, h, x, s, t, follows), strict=False):
            getattr(total, name).append(value)
    return total


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(("focus", "values"), [("prediction", EVERY_AT), ("simulation", SLOW)], ids=["fast", "slow"])
def test_the_pass_is_what_the_plain_loop_gives(size, focus, values):
    c = case(*SIZES[size], focus, values)
    sums = KERNEL.sweep(c.predictor.at(c.theta), c.blocks, c.starts, WEIGHT)
    expected = by_hand(c)
    assert c.blocks.n_windows == len(expected.end)
    linked = np.flatnonzero(expected.linked)
    for name in ("error_products", "gradient", "hessian", "gradient_start", "hessian_mixed", "hessian_start"):
        a, b = getattr(sums, name), np.array(getattr(expected, name))
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11 * np.abs(b).max(), err_msg=name)
    for name in ("end", "end_theta", "end_start"):  # ends of a record's last window meet nothing
        a, b = getattr(sums, name)[linked], np.array(getattr(expected, name))[linked]
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12 * np.abs(b).max(initial=0), err_msg=name)


@pytest.mark.parametrize("size", ["last window of one sample", "windows of several blocks"])
def test_residuals_are_the_errors_in_the_order_of_the_samples(size):
    c = case(*SIZES[size])
    error = KERNEL.predict(c.predictor.at(c.theta), c.blocks, c.starts).errors
    assert error.shape == c.blocks.y.shape
    rows = c.blocks.by_segment(error)
    assert [len(r) for r in rows] == [record.n_samples for record in c.data.records]
    np.testing.assert_allclose(np.concatenate(rows), by_hand(c).errors, rtol=1e-9, atol=1e-10)
    assert not error.transpose(0, 1, 3, 2)[c.blocks.used == 0].any()
    assert c.blocks.used.sum() == c.data.n_samples == c.blocks.n_samples
