"""Robust loss: known thresholds, derivatives with weights, coverage with outliers, efficiency without."""

import sys
from functools import cache

import numpy as np
import pytest
from fit_cases import EVERY, EVERY_AT, MODE, MODE_AT, innovations, levels, simulated
from shooting_problem import problem

import gbid
from gbid.core.errors import UsageError
from gbid.identify import FitOptions, fit
from gbid.identify.kernel.sums import Lagrangian
from gbid.identify.problem.hessian import on_ends
from gbid.identify.robust import _counted, _with_weights, efficiency, robust_loss

NAMES = ("w", "z", "g")
AT = np.array([MODE_AT[name] for name in NAMES])
LOSSES = ("huber", "student")


def data(seed, outliers=0.0, n=500):
    """White noise, and a share of samples that are twenty times off."""
    rec = simulated(MODE, MODE_AT, levels(n, seed=seed), noise=0.1, seed=seed)
    random = np.random.default_rng(1000 + seed)
    y = rec.signal("y").copy()
    hit = random.random(n) < outliers
    y[hit, 0] += 2.0 * random.standard_normal(hit.sum())
    return rec.with_signals(y=y)


@cache
def estimates(outliers, seeds, **options):
    fits = [fit(MODE, data(seed, outliers), focus="simulation", **options) for seed in range(seeds)]
    assert all(each.success for each in fits)
    values = np.array([[each.parameters[name] for name in NAMES] for each in fits])
    return values - AT, np.array([[each.std[name] for name in NAMES] for each in fits])


# ---- the loss ----


def test_thresholds_are_those_of_the_textbook():
    """Huber (1981): 1.345 for 95 % of one output; bivariate 1.5 (Maronna, Martin, Yohai, 2006)."""
    assert robust_loss(FitOptions(robust="huber"), 1).threshold == pytest.approx(1.345, abs=0.003)
    for kind in LOSSES:
        for n_outputs in (1, 2, 4):
            assert efficiency(robust_loss(FitOptions(robust=kind), n_outputs), n_outputs) == pytest.approx(
                0.95, abs=1e-3
            )


@pytest.mark.parametrize("kind", LOSSES)
def test_the_elasticity_is_the_derivative_of_the_weight(kind):
    loss, squared, step = (
        robust_loss(FitOptions(robust=kind, robust_threshold=2.5), 1),
        np.array([0.3, 1.7, 8.0, 90.0]),
        1e-6,
    )
    shifted_weight = loss.weight(squared * (1 + step) ** 2, 1)
    np.testing.assert_allclose(
        (shifted_weight / loss.weight(squared, 1) - 1) / step, loss.elasticity(squared), atol=1e-5
    )


@pytest.mark.parametrize("engine", ["numpy", "compiled"])
@pytest.mark.parametrize("criterion", ["trace", "det"])
def test_gradients_hold_for_weights_of_samples(engine, criterion):
    shooting, unknowns = problem(engine, criterion=criterion)
    count = len(_counted(shooting))
    weighted = _with_weights(shooting, np.random.default_rng(0).uniform(0.1, 1.0, count))
    gradient, random = weighted.at(unknowns).gradient.copy(), np.random.default_rng(1)
    for _ in range(3):
        along = 1e-6 * random.standard_normal(len(unknowns))
        change = (weighted.at(unknowns + along).cost - weighted.at(unknowns - along).cost) / 2
        assert change == pytest.approx(gradient @ along, rel=1e-6, abs=1e-14)
    theta, starts = weighted.unpack(unknowns)
    values, nothing = weighted.values(theta), np.zeros(weighted.n_gaps)
    weight = weighted.weight(weighted.error_products(values, starts))
    by_adjoint = weighted.gradients(values, Lagrangian(starts, on_ends(weighted, nothing), weight))
    by_start = np.concatenate([starts for _, starts in by_adjoint]) * weighted.state_scale
    np.testing.assert_allclose(by_start.ravel(), gradient[weighted.n_theta :], rtol=1e-6, atol=1e-9)
    same = _with_weights(shooting, np.ones(count))
    np.testing.assert_array_equal(same.at(unknowns).hessian, shooting.at(unknowns).hessian)


# ---- recovery and coverage ----


@pytest.mark.parametrize("kind", LOSSES)
def test_outliers_cost_little(kind):
    plain, _ = estimates(0.05, 8)
    robust, std = estimates(0.05, 8, robust=kind)
    clean, _ = estimates(0.0, 8)
    assert np.sqrt((plain**2).mean(0) / (clean**2).mean(0)).min() > 2
    assert np.sqrt((robust**2).mean(0) / (clean**2).mean(0)).max() < 1.6
    assert 0.7 < np.sqrt(((robust / std) ** 2).mean()) < 1.4


@pytest.mark.parametrize("kind", LOSSES)
def test_without_outliers_little_is_lost(kind):
    plain, plain_std = estimates(0.0, 8)
    robust, std = estimates(0.0, 8, robust=kind)
    assert np.abs((robust - plain) / plain_std).max() < 1
    assert 1.0 < np.median(std / plain_std) < 1.05


@pytest.mark.slow
@pytest.mark.parametrize("kind", LOSSES)
@pytest.mark.parametrize("outliers", [0.0, 0.05, 0.1])
def test_intervals_cover(kind, outliers, capsys):
    off, std = estimates(outliers, 200, robust=kind)
    plain, _ = estimates(outliers, 200)
    covered = (np.abs(off / std) < 1.96).mean()
    ratio = np.sqrt((off**2).mean(0) / (plain**2).mean(0))
    words = f"{kind}, {outliers:.0%} outliers: intervals of 95 % cover {covered:.1%}, scatter {ratio} of least squares"
    with capsys.disabled():
        sys.stdout.write(f"\n{words}\n")
    assert 0.92 < covered < 0.98
    assert ratio.max() < (1.05 if outliers == 0 else 0.6)


# ---- several outputs, a disturbance gain, files ----


def test_an_outlier_of_one_output_does_not_spoil_the_other(tmp_path):
    rec = innovations(EVERY, EVERY_AT, levels(1500, 2, hold=3), noise=[0.2, 0.1])
    y = rec.signal("y").copy()
    y[::50, 0] += 10.0
    bad = rec.with_signals(y=y)
    clean = fit(EVERY, rec, start=EVERY_AT, focus="simulation")
    result = fit(EVERY, bad, start=EVERY_AT, focus="simulation", robust="huber", left_out={"data": [(300, 320)]})
    plain = fit(EVERY, bad, start=EVERY_AT, focus="simulation")
    for name in "awbcd":
        assert abs(result.parameters[name] - EVERY_AT[name]) < 4 * result.std[name] < 7 * clean.std[name]
    assert any("robust loss" in note for note in result.notes)
    np.testing.assert_allclose(result.error_covariance[0, 0], plain.error_covariance[0, 0], rtol=0.1)
    gbid.save(result, tmp_path / "fit.h5")
    assert gbid.load(tmp_path / "fit.h5").options == result.options


def test_unknown_losses_are_refused():
    with pytest.raises(UsageError, match="robust = 'tukey'; give 'huber', 'student' or None"):
        fit(MODE, data(0), robust="tukey")
    with pytest.raises(UsageError, match="robust_threshold = -1; give a number above 0"):
        fit(MODE, data(0), robust="huber", robust_threshold=-1)
    with pytest.raises(UsageError, match="robust_threshold is for robust"):
        fit(MODE, data(0), robust_threshold=2.0)
