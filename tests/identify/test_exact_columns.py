"""Exact columns of the Hessian: against differences of the gradient over whole records, and their effect."""

import numpy as np
import pytest
from compilers import NEEDS_COMPILER
from fit_cases import H, levels
from scipy.signal import lfilter
from shooting_problem import problem

from gbid.identify import fit
from gbid.identify.kernel.sums import Lagrangian
from gbid.identify.problem.hessian import in_one_window, in_windows, omitted_part
from gbid.identify.uncertainty.covariance import Estimate, information_of_last_pass, information_over_records
from gbid.recording import Recording
from gbid.structure import LinearStructure, Parameter, evaluate


@NEEDS_COMPILER
@pytest.mark.parametrize(
    "options",
    [{}, {"criterion": "det"}, {"left_out": {}, "local": {"tau_x": "recording"}}],
    ids=["gap", "det", "local"],
)
def test_the_observed_information_is_the_slope_of_the_gradient(options):
    """Over parameters and initial states, the state carried across samples that are left out."""
    shooting, unknowns = problem("compiled", **options)
    joined, kept = in_one_window(shooting)
    theta, starts = joined.unpack(unknowns[kept])
    first = np.setdiff1d(np.arange(joined.n_windows), joined.links[:, 1])  # windows that records begin with
    n_p, n_all = joined.n_theta, joined.n_theta + len(first) * joined.n_states
    starts = passed_on(joined, theta, starts)
    weight = joined.weight(joined.error_products(joined.values(theta), starts))

    def gradient(moved):
        at, begun = theta + moved[:n_p], starts.copy()
        begun[first] += moved[n_p:].reshape(len(first), -1)
        information = information_over_records(
            Estimate(joined, at, passed_on(joined, at, begun), first), weight, block=100
        )
        total = np.zeros(n_all)
        for record in information.sensitivities:
            total[record.columns] -= np.einsum("amk,ab,kb->m", record.psi, weight, record.errors)
        return total

    information = information_over_records(Estimate(joined, theta, starts, first), weight, observed=True, block=100)
    steps = 1e-5 / np.sqrt(np.diag(information.hessian))
    expected = np.array([(gradient(s) - gradient(-s)) / (2 * s.max()) for s in np.diag(steps)])
    size = np.sqrt(np.outer(np.diag(information.hessian), np.diag(information.hessian)))
    assert information.observed.shape == (n_all, n_all)
    np.testing.assert_allclose(information.observed / size, expected / size, atol=2e-4)
    assert np.abs((information.hessian - expected) / size).max() > 0.05  # Gauss-Newton leaves something out


@pytest.mark.parametrize(
    "options",
    [{}, {"criterion": "det"}, {"left_out": {}, "local": {"tau_x": "recording"}}],
    ids=["gap", "det", "local"],
)
def test_the_last_pass_over_the_windows_has_the_information_of_whole_records(options):
    """Windows without gaps are linked by their sensitivities; with a gap there is none."""
    shooting, unknowns = problem(**options)
    joined, kept = in_one_window(shooting)
    theta, starts = joined.unpack(unknowns[kept])
    closed = in_windows(shooting, joined, joined.pack(theta, passed_on(joined, theta, starts)))
    theta, starts = shooting.unpack(closed)
    first = np.setdiff1d(np.arange(shooting.n_windows), shooting.links[:, 1])
    at = Estimate(shooting, theta, starts, first)
    weight = shooting.weight(shooting.error_products(shooting.values(theta), starts))
    shaped = weight @ np.diag([1.0, 3.0]) @ weight
    expected = information_over_records(at, weight, shaped=shaped)
    computed = information_of_last_pass(at, shaped=shaped)
    for name in ("hessian", "shaped"):
        whole = getattr(expected, name)
        size = np.sqrt(np.outer(np.diag(whole), np.diag(whole)))
        np.testing.assert_allclose(getattr(computed, name) / size, whole / size, atol=1e-9)
    starts = starts.copy()
    starts[shooting.links[0, 1]] += 1e-3 * shooting.state_scale
    assert information_of_last_pass(Estimate(shooting, theta, starts, first)) is None


def test_the_problem_has_no_value_where_the_predictor_is_unstable():
    shooting, unknowns = problem()
    assert shooting.stable_only
    unstable = unknowns.copy()
    unstable[list(shooting.noise)] = 1e4
    assert np.isnan(shooting.at(unstable).cost)
    assert np.isnan(shooting.at(unstable).gradient).all()


def test_columns_of_an_overflow_are_not_finite():
    """A fit that ended far off, with exact delays: its status says so, without an exception from a delay of nan."""
    shooting, unknowns = problem()
    joined, kept = in_one_window(shooting)
    theta, starts = joined.unpack(unknowns[kept])
    shares = [np.full(len(part.index), np.nan) for part in joined.parts]
    weight = np.eye(joined.error_products(joined.values(theta), starts).shape[0])
    ends = np.zeros_like(starts)
    for computed in omitted_part(joined, theta, Lagrangian(starts, ends, weight), shares):
        assert np.isnan(computed.theta).all()


def passed_on(joined, theta, starts):
    """Starts with those that follow another window where that ends."""
    for _ in joined.links:
        gaps = joined.at(joined.pack(theta, starts)).gaps.reshape(-1, joined.n_states) * joined.state_scale
        starts = starts.copy()
        starts[joined.links[:, 1]] += gaps
    return starts


LAG = LinearStructure(
    "lag with a gain",
    [Parameter("a", 1.0, lower=0.01, upper=50.0), Parameter("b", 1.0), Parameter("k", 0.5)],
    lambda p: {"A": [[-p.a]], "B": [[p.b]], "C": [[1]], "K": [[p.k]]},
)


def ringing(n, seed):
    """Noise of one oscillation, which no gain of `LAG` can follow, (n, 1)."""
    e = 6e-3 * np.random.default_rng(seed).normal(size=n + 500)
    return lfilter([1.0], [1.0, -1.96 * np.cos(0.4), 0.98**2], e)[500:, None]


def test_a_gain_that_cannot_follow_the_errors_is_as_uncertain_as_many_fits_are():
    """With Gauss-Newton's Hessian it would be said to be half as sure again as it is."""
    u = levels(1000, seed=2)
    clean = evaluate(LAG, {"a": 1.5, "b": 2.0, "k": 0.0}).simulate(u, H)
    data = [Recording({"u": u, "y": clean + ringing(1000, seed)}, H) for seed in range(30)]
    results = [fit(LAG, each, start={"a": 1.5, "b": 2.0, "k": 0.0}, max_iterations=40) for each in data]
    assert all(result.success for result in results)
    assert all(result.trusted == "robust" for result in results)
    spread = np.std([[result.parameters[name] for name in "abk"] for result in results], axis=0, ddof=1)
    stated = np.median([[result.std[name] for name in "abk"] for result in results], axis=0)
    np.testing.assert_allclose(stated / spread, 1, atol=0.25)
