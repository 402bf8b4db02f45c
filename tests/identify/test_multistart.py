"""Fits from several starts."""

from dataclasses import replace
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from fit_cases import MODE, MODE_AT, H, levels, simulated
from scipy.integrate import solve_ivp

from gbid import load, save
from gbid.core.errors import DataError, UsageError
from gbid.identify import FitStatus, fit, fit_multistart
from gbid.identify.fitting import fitted
from gbid.recording import Recording
from gbid.structure import LinearStructure, NonlinearStructure, Parameter, evaluate

# One mode whose frequency is bounded widely: its cost has a dip at each multiple that the input excites.
WIDE = LinearStructure(
    "wide",
    [
        Parameter("w", 1.0, lower=0.5, upper=30.0, unit="rad/s"),
        Parameter("z", 0.5, lower=0.005, upper=1.0),
        Parameter("g", 0.1),
    ],
    lambda p: {"A": [[0, 1], [-p.w * p.w, -2 * p.z * p.w]], "B": [[0], [p.g * p.w * p.w]], "C": [[1, 0]]},
)
WIDE_AT = {"w": 12.0, "z": 0.02, "g": 2.0}
ONCE = {"max_iterations": 49}  # with so few a fit makes no second attempt of its own


@pytest.fixture(scope="module")
def rec():
    return simulated(WIDE, WIDE_AT, levels(600, hold=2), noise=0.3)


@pytest.fixture(scope="module")
def result(rec):
    return fit_multistart(WIDE, rec, starts=8, seed=1, window=None, **ONCE)


def test_the_best_of_several_starts_is_the_truth(rec, result):
    assert result.losses.shape == result.converged.shape == (8,)
    assert (result.status, result.success) == (result.best.status, True)
    assert result.best._repr_html_() in result._repr_html_()
    single = fit(WIDE, rec, window=None, **ONCE)
    assert result.losses[0] == single.loss  # the structure's own start comes first
    assert single.loss > 2 * result.best.loss  # and ends elsewhere: that is what the others are for
    assert result.best.success
    assert result.best.loss == result.losses[result.converged].min()
    for name, value in WIDE_AT.items():
        assert abs(result.best.parameters[name] - value) < 4 * result.best.std_with("white")[name]


def test_a_fit_in_a_local_minimum_begins_again_with_values_from_the_data(rec, result):
    single = fit(WIDE, rec, window=None)
    assert single.loss == pytest.approx(result.best.loss)
    assert "GB112" in " ".join(single.notes)


def test_the_second_start_is_from_the_data_also_where_an_observer_moved_the_first():
    def matrices(p):
        a, b = 2 * np.pi * p.f1, 2 * np.pi * p.f2
        A = [[0, 1, 0, 0], [-a * a, -0.04 * a, 0, 0], [0, 0, 0, 1], [0, 0, -b * b, -0.04 * b]]
        return {"A": A, "B": [[0], [p.g1], [0], [p.g2]], "C": [[1, 0, 1, 0]]}

    stated = {"f1": (2.0, 1.0, 40.0), "f2": (30.0, 1.0, 40.0), "g1": (100.0, 0.0), "g2": (100.0, 0.0)}
    parameters = [Parameter(name, *values) for name, values in stated.items()]
    modes = LinearStructure("modes", parameters, matrices, intersample="zoh")
    random = np.random.default_rng(1)
    u = np.repeat(random.choice([-1.0, 1.0], 60), 10)[:, None]
    y = evaluate(modes, {"f1": 7.0, "g1": 500.0, "f2": 13.0, "g2": 800.0}).simulate(u, 0.01)
    rec = Recording({"u": u, "y": y + 0.01 * random.standard_normal(y.shape)}, 0.01, name="swing")
    result = fit_multistart(modes, rec, starts=2, window=None, **ONCE)
    assert result.losses[1] < 0.01 * result.losses[0]


def test_the_counts_are_those_of_the_losses(result):
    good = result.losses[result.converged]
    assert result.same_optimum == (result.losses <= result.best.loss * (1 + 1e-6)).sum() >= 2
    assert result.spread == pytest.approx(good.max() / good.min())
    assert result.spread > 2


def test_every_minimum_is_listed_once_with_its_loss(result):
    losses = [m.loss for m in result.minima]
    assert losses == sorted(losses)
    assert losses[0] == result.best.loss
    assert len(losses) > 1
    assert all(b > a * (1 + 1e-6) for a, b in pairwise(losses))  # one mode: no loss occurs twice
    listed = [i for m in result.minima for i in m.starts]
    assert len(listed) == len(set(listed))
    assert set(np.flatnonzero(result.converged)) <= set(listed)
    for m in result.minima:
        np.testing.assert_allclose(result.losses[list(m.starts)], m.loss, rtol=1e-6)
        assert m.status.success
    assert (result.best.multi_start.minima, sum(result.best.multi_start.minima_starts)) == (tuple(losses), len(listed))


def test_minima_with_equal_losses_at_other_parameters_are_distinct():
    """Two equal modes: their names can be exchanged, and the loss stays."""
    pair = LinearStructure(
        "pair",
        [Parameter("a", 0.6, 0.0, 50.0), Parameter("b", 5.0, 0.0, 50.0)],
        lambda p: {"A": [[-p.a, 0], [0, -p.b]], "B": [[1], [1]], "C": [[1, 1]]},
    )
    rec = simulated(pair, {"a": 1.0, "b": 4.0}, levels(400), noise=0.01)
    multistart = fit_multistart(pair, rec, starts=8, seed=0)
    assert multistart.same_optimum == 8
    assert [len(m.starts) for m in multistart.minima] != [8]
    values = sorted((m.parameters["a"] > m.parameters["b"]) for m in multistart.minima)
    assert values == [False, True]


def test_the_best_is_the_smallest_loss_whatever_its_status(rec, monkeypatch, tmp_path):
    """A fit that nearly arrived at the best minimum beats one that converged at a worse one, and says what it is."""
    limits = iter((49, 4))  # the first converges to a poor minimum; the second is stopped on its way to the best one

    def limited(structure, recordings, options):
        if options.start == "data":
            raise DataError("too short")
        return fitted(structure, recordings, replace(options, max_iterations=next(limits)))

    monkeypatch.setattr("gbid.identify.multistart.fitted", limited)
    near = LinearStructure("near", [Parameter("w", 1.0, 0.5, 30.0), *WIDE.parameters[1:]], WIDE.matrices)
    monkeypatch.setattr(np.random, "default_rng", lambda seed: Fixed())
    multistart = fit_multistart(near, rec, starts=2, seed=0, window=None, **ONCE)
    assert multistart.converged.tolist() == [True, False]
    assert multistart.losses[1] < multistart.losses[0]
    assert multistart.best.loss == multistart.losses[1]
    assert not multistart.best.success
    assert multistart.best.status is FitStatus.ITERATION_LIMIT
    assert "but did not converge" in multistart.best.notes[-1]
    assert f"{multistart.losses[0]:.6g}" in multistart.best.notes[-1]
    assert [m.status.success for m in multistart.minima] == [False, True]
    save(multistart.best, tmp_path / "best.h5")
    assert load(tmp_path / "best.h5").multi_start == multistart.best.multi_start


class Fixed:
    """Draws that lie near the truth."""

    def uniform(self, low, high):
        return {0.5: 11.8, 0.005: 0.03}.get(low, 0.15)


def test_the_seed_settles_the_starts(rec, result):
    again = fit_multistart(WIDE, rec, starts=3, seed=1, window=None, **ONCE)
    np.testing.assert_array_equal(again.losses, result.losses[:3])
    other = fit_multistart(WIDE, rec, starts=3, seed=2, window=None, **ONCE)
    assert (other.losses[1:] != result.losses[1:3]).any()
    assert other.losses[0] == result.losses[0]


def test_starts_lie_within_bounds_and_reach(monkeypatch):
    """Between two finite bounds; else within reach of the start, and about zero where that is zero."""
    seen, made = [], []

    def watched(structure, recordings, options):
        seen.append(options.start)
        made[:] = made or [fitted(structure, recordings, options)]
        return made[0]

    monkeypatch.setattr("gbid.identify.multistart.fitted", watched)
    structure = LinearStructure(
        "four",
        [
            Parameter("a", 2.0, lower=1.0, upper=9.0),
            Parameter("b", 4.0),
            Parameter("c", 0.0),
            Parameter("d", 0.5, lower=0.45),
            Parameter("e", 1.0),
            Parameter("f", 1.0, fixed=True),
        ],
        lambda p: {"A": [[-p.a]], "B": [[p.b + p.f - p.e]], "C": [[1]], "D": [[p.c + p.d]]},
    )
    rec = simulated(MODE, MODE_AT, levels(100), noise=0.3)
    options = {"max_iterations": 1, "window": None, "fixed": {"e": 1.0}}
    fit_multistart(structure, rec, starts=40, seed=0, reach=0.25, bounds={"a": (1.5, 6.0)}, **options)
    assert len(seen) == 40
    assert seen[:2] == [None, "data"]
    drawn = {name: np.array([s[name] for s in seen[2:]]) for name in "abcd"}
    assert all(set(s) == set("abcd") for s in seen[2:])
    for name, low, high in (("a", 1.5, 6.0), ("b", 3.0, 5.0), ("c", -0.25, 0.25), ("d", 0.45, 0.625)):
        assert low <= drawn[name].min() < low + 0.2 * (high - low), name
        assert high - 0.2 * (high - low) < drawn[name].max() <= high, name


def test_one_start_is_a_plain_fit(rec):
    multistart = fit_multistart(WIDE, rec, starts=1, start=WIDE_AT)
    single = fit(WIDE, rec, start=WIDE_AT)
    assert multistart.best.parameters == single.parameters
    assert (multistart.same_optimum, multistart.spread) == (1, 1.0)


def test_starts_that_fail_are_counted_as_such():
    """A wild start overflows: a status among the others, not the end of them all."""
    wild = LinearStructure(
        "wild",
        [Parameter("a", -1.0, lower=-5.0, upper=300.0), Parameter("b", 1.0)],
        lambda p: {"A": [[p.a]], "B": [[p.b]], "C": [[1]]},
    )
    u = levels(2000)
    y = evaluate(wild, {"a": -1.0, "b": 1.0}).simulate(u, H) + 0.1 * np.random.default_rng(0).normal(size=(2000, 1))
    multistart = fit_multistart(wild, Recording({"u": u, "y": y}, H), starts=5, seed=0, window=None, max_iterations=30)
    assert multistart.best.success
    assert multistart.best.parameters["a"] == pytest.approx(-1.0, abs=0.1)
    assert not multistart.converged.all()
    assert multistart.converged[0]
    assert np.isfinite(multistart.spread)


TANK = NonlinearStructure(
    "tank",
    [Parameter("inflow", 0.25), Parameter("outflow", 0.25)],
    ["level"],
    lambda x, u, p: p["inflow"] * u[0] - p["outflow"] * ca.sqrt(x[0]),
    lambda x, u, p: x[0],
    ["u"],
    ["y"],
)


@pytest.fixture(scope="module")
def filling():
    """The level of a tank by the integrator of scipy."""
    rng, n, h, x = np.random.default_rng(0), 400, 0.5, np.array([1.0])
    u, y = np.repeat(rng.uniform(0.5, 1.5, n // 10), 10), np.empty(n)
    for i in range(n):
        y[i] = x[0]
        x = solve_ivp(lambda _, z, u=u[i]: 0.3 * u - 0.3 * np.sqrt(z), (0, h), x, rtol=1e-9, atol=1e-11).y[:, -1]
    return Recording({"u": u[:, None], "y": (y + 0.005 * rng.standard_normal(n))[:, None]}, h, name="filling")


def test_a_start_that_empties_the_tank_costs_no_other_start(filling):
    """Below an empty tank the root has no value, and at its level of zero no slope for a linear model."""
    multistart = fit_multistart(TANK, filling, starts=6, seed=1, reach=3.0, window=None, focus="simulation")
    assert multistart.converged[0]
    assert np.isnan(multistart.losses).any()
    assert not multistart.converged[np.isnan(multistart.losses)].any()
    assert multistart.same_optimum >= 2
    for name in ("inflow", "outflow"):
        assert abs(multistart.best.parameters[name] - 0.3) < 4 * multistart.best.std[name]


def test_a_nonlinear_fit_that_diverges_is_a_status(filling):
    result = fit(TANK, filling, focus="simulation", window=None, start={"inflow": -0.5, "outflow": 0.3})
    assert result.status is FitStatus.OVERFLOW
    assert result.model.modes() == []
    assert "overflows" in repr(result)


def test_local_parameters_can_be_started_anew():
    recs = [
        simulated(WIDE, {**WIDE_AT, "g": g}, levels(300, seed=i), noise=0.3, name=f"r{i}")
        for i, g in enumerate((1.0, 3.0))
    ]
    multistart = fit_multistart(WIDE, recs, starts=3, seed=0, reach=0.1, local={"g": "recording"}, start=WIDE_AT)
    assert multistart.best.success
    assert multistart.best.parameters["g[r1]"] == pytest.approx(3.0, abs=0.2)


WRONG = [{"starts": 0}, {"starts": 2.5}, *({"reach": r} for r in (0.0, -1.0, np.inf, np.nan, None, "0.5"))]


@pytest.mark.parametrize("wrong", WRONG, ids=str)
def test_wrong_use_is_refused(rec, wrong):
    with pytest.raises(UsageError, match=f"{next(iter(wrong))} = "):
        fit_multistart(WIDE, rec, **wrong)
    with pytest.raises(UsageError, match="focus = 'both'"):
        fit_multistart(WIDE, rec, focus="both")
