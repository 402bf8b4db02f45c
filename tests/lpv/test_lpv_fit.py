"""Surfaces through a campaign's estimates: against closed forms, brute force and known truth."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from study_rig import CAMPAIGN, PAPER, POINTS

import gbid
from gbid.core.errors import DataError, UsageError
from gbid.lpv import Estimates, characteristics
from gbid.lpv.estimates import _finite, _reason, chosen_exponents, orthonormal
from gbid.lpv.model import regressors
from gbid.lpv.regression import (
    in_units_of_terms,
    lack_of_fit,
    solve_surfaces,
    with_scatter,
)
from gbid.rig import Machine, Scatter
from gbid.rig.machine import scatter_random, scattered
from gbid.structure import KEY_PARAMETERS
from gbid.structure.scheduling import exponents_of

GRID = np.array([point for point, _ in CAMPAIGN])
K = len(KEY_PARAMETERS)


def surface_of(model, points):
    values = model.key_parameters(points[:, 0], points[:, 1])
    return np.stack([values[key] * np.ones(len(points)) for key in KEY_PARAMETERS], axis=-1)


def campaign(seed=0, scatter=0.02, own=0.01, points=GRID, truth=PAPER):
    """Estimates with a known scatter between recordings and known errors of their own, all correlated."""
    rng = np.random.default_rng(seed)
    T = surface_of(truth, points)
    size = np.abs(T).mean(axis=0)

    def covariance():
        root = np.eye(K) + 0.2 * rng.normal(size=(K, K))
        return root @ root.T * np.outer(size, size)

    S = scatter**2 * covariance()
    C = np.array([own**2 * rng.uniform(0.2, 3) * covariance() for _ in points])
    errors = np.array([rng.multivariate_normal(np.zeros(K), c) for c in C]) if own else 0.0
    values = T + rng.multivariate_normal(np.zeros(K), S, len(points)) * (scatter > 0) + errors
    return Estimates(tuple(f"r{i}" for i in range(len(points))), points, values, C), S


@cache
def surfaces(seed=10):
    """Surfaces through a campaign with the scatter between recordings."""
    return gbid.fit_lpv(campaign(seed)[0])


def test_data_without_errors_give_the_table_of_the_paper_back():
    exact, _ = campaign(scatter=0.0, own=0.0)
    for weighting in ("ordinary", "scatter"):
        fit = gbid.fit_lpv(
            replace(exact, covariance=np.broadcast_to(np.eye(K) * 1e-9, (86, K, K))), weighting=weighting
        )
        for key in KEY_PARAMETERS:
            np.testing.assert_allclose(fit.model.coefficients[key], PAPER.coefficients[key], rtol=1e-7, atol=1e-20)
        assert max(d.rms for d in fit.deviations) < 1e-9
    assert fit.model.domain == PAPER.domain
    assert fit.model.operating_points == tuple(POINTS)


def test_ordinary_and_weighted_fits_are_least_squares_by_brute_force():
    data, _ = campaign(seed=1)
    Phi = regressors(*GRID.T) / [1, 7, 6000, 42000, 49, 36e6]
    plain = np.linalg.lstsq(Phi, data.values, rcond=None)[0].T / [1, 7, 6000, 42000, 49, 36e6]
    fit = gbid.fit_lpv(data, weighting="ordinary")
    np.testing.assert_allclose(fit.coefficients, plain, rtol=1e-8)

    size = np.abs(data.values).mean(axis=0)
    rows, targets = [], []
    for phi, y, C in zip(Phi, data.values / size, data.covariance / np.outer(size, size), strict=True):
        whiten = np.linalg.inv(np.linalg.cholesky(C))
        rows.append(whiten @ np.kron(np.eye(K), phi))
        targets.append(whiten @ y)
    complete = np.linalg.lstsq(np.vstack(rows), np.concatenate(targets), rcond=None)[0].reshape(K, 6)
    weighted = gbid.fit_lpv(data, weighting="fits")
    np.testing.assert_allclose(
        weighted.coefficients, complete * size[:, None] / [1, 7, 6000, 42000, 49, 36e6], rtol=1e-6
    )


def test_scatter_is_the_restricted_maximum_likelihood_estimate():
    rng = np.random.default_rng(3)
    n = 40
    X = np.stack([np.ones(n), np.linspace(-1, 1, n)], axis=-1)[:, None, :]
    C = rng.uniform(0.1, 2.0, n)[:, None, None]
    y = (X[:, 0] @ [1.0, 2.0] + np.sqrt(C[:, 0, 0] + 0.8) * rng.normal(size=n))[:, None]

    def minus_log_likelihood(s):
        V, A = C[:, 0, 0] + s, X[:, 0]
        information = A.T @ (A / V[:, None])
        r = y[:, 0] - A @ np.linalg.solve(information, A.T @ (y[:, 0] / V))
        return np.log(V).sum() + np.linalg.slogdet(information)[1] + (r**2 / V).sum()

    best = minimize_scalar(minus_log_likelihood, bounds=(1e-6, 10), method="bounded", options={"xatol": 1e-8}).x
    estimate = with_scatter(y, X, C)
    assert estimate.settled
    assert estimate.scatter[0, 0] == pytest.approx(best, rel=0.01)


def test_scatter_matrix_of_a_large_campaign_is_found():
    points = np.repeat(np.array(POINTS), 40, axis=0)
    data, S = campaign(seed=4, points=points, own=0.002)
    fit = gbid.fit_lpv(data)
    size = np.sqrt(np.diag(S))
    assert np.abs((fit.scatter - S) / np.outer(size, size)).max() < 4 * np.sqrt(2 / 600)  # of 105 entries


def solved(estimates, order):
    """Surfaces of any parameters with the scatter between recordings, and their coefficients with covariance."""
    design = orthonormal(estimates.points, chosen_exponents(order, estimates.scheduling), estimates.scheduling)
    surfaces = solve_surfaces(estimates, design, "scatter", robust=False)
    covariance = in_units_of_terms(surfaces.covariance, design.back)
    return surfaces, (surfaces.coefficients @ design.back.T)[0], covariance


def test_standard_deviations_are_right_where_recordings_scatter_more_and_less():
    """One scatter for all points makes them twice too large at one end of the range, and too small at the other."""
    rng = np.random.default_rng(21)
    points = np.repeat(np.linspace(-1, 1, 5), 6)[:, None]
    sigma = 1 + 0.5 * points
    names, C = tuple(f"r{i}" for i in range(30)), np.full((30, 1, 1), 0.01)
    ends, z = np.array([[1, -1, 1], [1, 1, 1]]), []
    for _ in range(90):
        values = sigma * rng.normal(size=(30, 1)) + 0.1 * rng.normal(size=(30, 1))
        _, c, covariance = solved(Estimates(names, points, values, C, (), ("a",), ("v",)), 2)
        z.append(ends @ c / np.sqrt(np.einsum("pi,ij,pj->p", ends, covariance, ends)))
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(z), axis=0)), 1.0, atol=0.25)


def test_a_recording_that_alone_determines_its_point_has_the_scatter_of_the_others_and_is_named():
    rng = np.random.default_rng(22)
    points = np.array([0.0, 0, 0, 0, 0, 1])[:, None]
    data = Estimates(tuple("abcdef"), points, rng.normal(size=(6, 1)), np.full((6, 1, 1), 0.1), (), ("a",), ("v",))
    computed, _, covariance = solved(data, 1)
    assert covariance.sum() == pytest.approx(computed.scatter[0, 0] + 0.1)  # that of one recording, at v = 1
    (note,) = computed.notes
    assert note.startswith("recordings that alone determine the surfaces at their operating point: f;")
    assert note.endswith("[GB307]")


def assert_covers_the_truth(fits, seed):
    """On average over campaigns each parameter is at 95 % of 1000 points, standard deviations of the right size."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(3, 7, 1000), rng.uniform(0, 6000, 1000)])
    truth, within, z_all = surface_of(PAPER, points), [], []
    for fit in fits:
        std = np.sqrt(np.einsum("nii->ni", fit.uncertainty_at(*points.T)))
        z = (surface_of(fit.model, points) - truth) / std
        within.append((np.abs(z) < 3).mean(axis=0))
        z_all.append(z)
    assert (np.mean(within, axis=0) > 0.95).all()
    assert 0.85 < np.std(z_all) < 1.2


def test_truth_lies_within_three_standard_deviations():
    assert_covers_the_truth((surfaces(seed) for seed in range(10, 13)), seed=6)


@pytest.mark.parametrize("robust", [False, True])
def test_truth_lies_within_three_standard_deviations_of_ordinary_surfaces(robust):
    fits = (gbid.fit_lpv(campaign(seed)[0], weighting="ordinary", robust=robust) for seed in range(10, 16))
    assert_covers_the_truth(fits, seed=6)


def test_truth_of_the_rigs_scatter_lies_within_three_standard_deviations():
    """The rig scatters modes, delays and static gains, so its fourteen parameters are neither normal nor alike."""
    bearings = {q: Machine.from_parameters(PAPER.key_parameters(*q), PAPER.actuators).rotor_bearing for q in POINTS}
    names = tuple(f"r{i}" for i in range(len(GRID)))
    rng = np.random.default_rng(8)
    points = np.column_stack([rng.uniform(3, 7, 1000), rng.uniform(0, 6000, 1000)])
    size = np.abs(surface_of(PAPER, points)).mean(axis=0)
    covariances = np.broadcast_to(np.diag((1e-5 * size) ** 2), (len(GRID), K, K))

    def scattered_campaign(seed):
        values = []
        for name, (p, n) in zip(names, GRID, strict=True):
            random = scatter_random(seed, name, {"pressure_bar": p, "speed_rpm": n})
            t = scattered(bearings[p, n], Scatter(share=0.35), random)[0]
            values.append(np.concatenate([t.stiffness.ravel(), t.damping.ravel(), t.input_gain.ravel(), t.delay]))
        return Estimates(names, GRID, np.array(values), covariances)

    assert_covers_the_truth((gbid.fit_lpv(scattered_campaign(seed)) for seed in range(10)), seed=8)


def test_outliers_are_named_and_held_down():
    data, _ = campaign(seed=7)
    values = data.values.copy()
    clean = gbid.fit_lpv(data, weighting="ordinary")
    for i, key in ((3, "k_xx"), (40, "b_xy"), (77, "tau_x")):
        j = KEY_PARAMETERS.index(key)
        values[i, j] += 15 * np.std(data.values[:, j] - clean.surface[:, j])
    spoilt = replace(data, values=values)
    plain, robust = (gbid.fit_lpv(spoilt, weighting="ordinary", robust=r) for r in (False, True))
    named = {(o.recording, o.parameter) for o in robust.outliers}
    assert {("r3", "k_xx"), ("r40", "b_xy"), ("r77", "tau_x")} <= named
    assert len(named) <= 5
    for key in ("k_xx", "b_xy", "tau_x"):
        j = KEY_PARAMETERS.index(key)
        shifted = [np.abs(fit.surface[:, j] - clean.surface[:, j]).max() for fit in (plain, robust)]
        assert shifted[1] < 0.5 * shifted[0]
    mixed = gbid.fit_lpv(spoilt, robust=True)
    assert {("r3", "k_xx"), ("r40", "b_xy"), ("r77", "tau_x")} <= {(o.recording, o.parameter) for o in mixed.outliers}


def test_order_is_chosen_by_points_left_out():
    second, _ = campaign(seed=8)
    assert gbid.fit_lpv(second, order="auto").options["order"] == "1, P, Omega, Omega P, P^2, Omega^2"
    linear = replace(PAPER, coefficients={k: (*v[:3], 0, 0, 0) for k, v in PAPER.coefficients.items()})
    first = gbid.fit_lpv(campaign(seed=9, truth=linear)[0], order="auto")
    assert first.options["order"] == "1, P, Omega"
    assert first.options["chosen"] == "by cross-validation"
    assert "third" not in first.orders[3].why_not
    assert "do not determine" in first.orders[3].why_not  # three speeds carry no cube


def test_left_out_errors_are_those_of_a_loop():
    data, _ = campaign(seed=10)
    score = surfaces(10).orders[1]
    errors = []
    for point in POINTS:
        out = (point == GRID).all(axis=1)
        A = np.column_stack([np.ones(86), GRID[:, 0], GRID[:, 1] / 1e3])
        solution = np.linalg.lstsq(A[~out], data.values[~out], rcond=None)[0]
        errors.append(data.values[out] - A[out] @ solution)
    np.testing.assert_allclose(score.rms, np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0)), rtol=1e-8)


def test_lack_of_fit_is_uniform_for_the_right_order_and_small_for_a_lower_one():
    data, _ = campaign(seed=11)
    right, lower = (lack_of_fit(GRID, data.values, exponents_of(order)) for order in (2, 1))
    assert right.min() > 1e-3
    assert lower[KEY_PARAMETERS.index("k_xx")] < 1e-6
    assert any("miss the means" in note for note in gbid.fit_lpv(data, order=1).notes)


def test_draws_have_the_stated_covariance_and_positive_delays():
    fit = surfaces()
    drawn = np.array([surface_of(model, np.array([[4.5, 2500.0]]))[0] for model in fit.draw(1000, seed=1)])
    stated = fit.uncertainty_at(4.5, 2500.0)
    size = np.sqrt(np.diag(stated))
    assert np.abs(np.cov(drawn.T) / np.outer(size, size) - stated / np.outer(size, size)).max() < 0.15
    wide = np.array([m.coefficients["k_xx"][0] for m in fit.draw(200, seed=2, scatter=True)])
    narrow = np.array([m.coefficients["k_xx"][0] for m in fit.draw(200, seed=2)])
    assert wide.std() > narrow.std()
    hopeless = replace(fit, covariance=fit.covariance * 1e8)
    with pytest.raises(UsageError, match="coefficients are too uncertain"):
        hopeless.draw(10, seed=0)


def test_characteristics_are_those_of_the_linear_model():
    values = surface_of(PAPER, np.array(POINTS))
    for row, (pressure, speed) in zip(characteristics(values), POINTS, strict=True):
        model = PAPER.at(pressure, speed)
        (f1, z1), (f2, z2) = [mode for mode in model.modes() if mode[0] < 1000]
        np.testing.assert_allclose(row[2:6], [f1, f2, z1, z2], rtol=1e-9)
        np.testing.assert_allclose(row[6:], model.static_gain().ravel(), rtol=1e-9)


def test_a_negative_delay_is_told_with_its_place():
    data, _ = campaign(seed=2, scatter=0.0, own=1e-6)
    j = KEY_PARAMETERS.index("tau_y")
    values = data.values.copy()
    values[:, j] -= 0.06e-3  # the least of the true surface is 0.055 ms
    (note,) = [n for n in gbid.fit_lpv(replace(data, values=values)).notes if "negative" in n]
    assert note.startswith("tau_y is negative in part of the domain, -0.00")
    assert "bar" in note
    assert not any("negative" in n for n in gbid.fit_lpv(data).notes)


def test_fits_that_did_not_converge_are_left_out_by_name():
    data, _ = campaign(seed=13)
    reasons = [""] * len(data.recordings)
    reasons[4:6] = _reason(False), _reason(False, "import r5: the file is truncated")
    left = _finite(data, reasons)
    assert left.left_out == (
        "r4: its fit did not converge", "r5: has no fit: import r5: the file is truncated",
    )  # fmt: skip
    assert len(left.recordings) == len(data.recordings) - 2


def test_failed_and_broken_fits_are_left_out_by_name():
    data, _ = campaign(seed=13)
    values, C = data.values.copy(), data.covariance.copy()
    values[5, 0], C[6, 2, 2] = np.nan, np.nan
    fit = gbid.fit_lpv(replace(data, values=values, covariance=C))
    assert "r5: k_xx not finite" in fit.estimates.left_out
    assert any(entry.startswith("r6: no covariance") for entry in fit.estimates.left_out)
    assert len(fit.estimates.recordings) == 84
    assert (
        len(gbid.fit_lpv(replace(data, values=values, covariance=C), weighting="ordinary").estimates.recordings) == 85
    )


@pytest.mark.parametrize(
    ("points", "match"),
    [
        ([(3, 0), (5, 0), (7, 0), (3, 6000), (7, 6000)], "5 operating points for 6 terms"),
        (
            [(p, w) for p in (3, 5) for w in (0, 3000, 6000)],
            r"do not determine 1, P, P\^2 separately: there are 2 pressures",
        ),
        ([(p, 0) for p in (3, 4, 5, 6, 6.5, 7)], "zero at all of them: Omega"),
    ],
)
def test_a_poor_grid_is_refused_with_its_reason(points, match):
    grid = np.array(points * 3, float)
    data, _ = campaign(seed=14, points=grid)
    with pytest.raises(DataError, match=match):
        gbid.fit_lpv(data)
    assert gbid.fit_lpv(data, order=0).success


def test_wrong_options_are_refused():
    data, _ = campaign(seed=15)
    for options, match in (
        ({"weighting": "best"}, "weighting = 'best'"),
        ({"order": 3}, "order = 3"),
        ({"order": ("P", "Q")}, "'Q' is not a term"),
        ({"weighting": "fits", "robust": True}, "robust"),
    ):
        with pytest.raises(UsageError, match=match):
            gbid.fit_lpv(data, **options)
    with pytest.raises(UsageError, match=r"fits = .*; give FitTable, a list .FitResult. or Estimates"):
        gbid.fit_lpv([object()])


def test_a_fit_is_read_back_as_it_was_written(tmp_path):
    fit = gbid.fit_lpv(campaign(seed=16)[0], name="mine", actuators=PAPER.actuators)
    path = tmp_path / "mine.h5"
    gbid.save(fit, path)
    again = gbid.load(path)
    assert again.model.coefficients == fit.model.coefficients
    assert again.options == fit.options
    assert again.outliers == fit.outliers
    for name in ("covariance", "scatter", "lack_of_fit"):
        np.testing.assert_array_equal(getattr(again, name), getattr(fit, name))
    np.testing.assert_array_equal(again.estimates.covariance, fit.estimates.covariance)
    assert [s.score for s in again.orders[:3]] == [s.score for s in fit.orders[:3]]
    assert gbid.load_model(path.with_suffix(".yaml")).actuators == PAPER.actuators
    with pytest.raises(UsageError, match="exists already"):
        gbid.save(fit, path)
    gbid.save(surfaces(), tmp_path / "other.h5")
    (tmp_path / "other.h5").replace(tmp_path / "mine.h5")
    with pytest.raises(DataError, match="belongs to other coefficients"):
        gbid.load(path)
