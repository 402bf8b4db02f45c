"""The gradient by the adjoint against the one that comes with sensitivities, and exact columns of the Hessian."""

import numpy as np
import pytest
from compilers import NEEDS_COMPILER
from shooting_problem import problem

from gbid.identify.disturbances import Disturbances, Trend
from gbid.identify.kernel.sums import Lagrangian
from gbid.identify.problem.hessian import entries_of, in_one_window, left_out_columns, on_ends

DISTURBED = Disturbances(("p_x", "p_y"), (Trend(3), Trend(0, random_walk=True)), (50.0,))


def of_pass(shooting, unknowns, lam):
    """Gradient of ``cost + lam' gaps`` from the sensitivities of a pass."""
    iterate, pattern = shooting.at(unknowns), shooting.jacobian_pattern
    weighted = iterate.jacobian * lam[pattern.rows]
    return iterate.gradient + np.bincount(pattern.columns, weighted, minlength=shooting.n_unknowns)


def by_adjoint(shooting, unknowns, lam):
    """The same by the adjoint, part by part."""
    theta, starts = shooting.unpack(unknowns)
    values = shooting.values(theta)
    weight = shooting.weight(shooting.error_products(values, starts))
    gradients = shooting.gradients(values, Lagrangian(starts, on_ends(shooting, lam), weight))
    by_theta = shooting.prior.information / shooting.likelihood_size * (theta - shooting.prior.mean)
    for part, (part_gradient, _) in zip(shooting.parts, gradients, strict=True):
        by_theta[part.index] += part_gradient
    by_start = np.concatenate([starts for _, starts in gradients]) * shooting.state_scale
    by_start[shooting.links[:, 1]] -= lam.reshape(-1, shooting.n_states)
    return np.concatenate([by_theta * shooting.theta_scale, by_start.ravel()])


@NEEDS_COMPILER
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"criterion": "det"},
        {"window": 600},
        {"left_out": {}, "local": {"tau_x": "recording"}, "disturbances": DISTURBED},
    ],
    ids=["windows", "det", "long windows", "local and disturbances"],
)
@pytest.mark.parametrize("joined", [False, True], ids=["cut", "joined"])
def test_the_adjoint_gives_the_gradient_of_the_pass(options, joined):
    shooting, unknowns = problem("compiled", **options)
    if joined:
        shooting, kept = in_one_window(shooting)
        unknowns = unknowns[kept]
    lam = np.random.default_rng(4).normal(size=shooting.n_gaps)
    expected = of_pass(shooting, unknowns, lam)
    assert np.isfinite(expected).all()
    gradients = by_adjoint(shooting, unknowns, lam)
    np.testing.assert_allclose(gradients, expected, rtol=1e-8, atol=1e-11 * np.abs(expected).max())


def test_the_problem_has_no_value_where_the_predictor_is_unstable():
    shooting, unknowns = problem()
    assert shooting.stable_only
    unstable = unknowns.copy()
    unstable[list(shooting.noise)] = 1e4
    assert np.isnan(shooting.at(unstable).cost)
    assert np.isnan(shooting.at(unstable).gradient).all()


GAINS = ("bd_xx", "bd_xy", "bd_yx", "bd_yy")


@NEEDS_COMPILER
@pytest.mark.parametrize("joined", [False, True], ids=["cut", "joined"])
@pytest.mark.parametrize(
    "local", [{}, dict.fromkeys(GAINS, "recording"), {"bd_xx": "recording"}], ids=["shared", "local", "one of four"]
)
def test_exact_columns_are_second_derivatives(local, joined):
    """Against differences of the pass's own gradient, and what the logarithm adds as the weight is held."""
    shooting, unknowns = problem("compiled", local=local)
    if joined:
        shooting, kept = in_one_window(shooting)
        unknowns = unknowns[kept]
    lam = np.random.default_rng(4).normal(size=shooting.n_gaps)
    assert len(shooting.noise) == 4 + len(local)
    pattern = shooting.hessian_pattern
    computed = shooting.at(unknowns).hessian + entries_of(shooting, left_out_columns(shooting, unknowns, lam))
    theta, _ = shooting.unpack(unknowns)
    known = shooting.prior.information / shooting.likelihood_size * (theta - shooting.prior.mean) * shooting.theta_scale
    slope = of_pass(shooting, unknowns, 0 * lam)
    slope[: shooting.n_theta] -= known
    for j in range(shooting.n_theta):
        ahead, behind = unknowns.copy(), unknowns.copy()
        ahead[j] += 1e-6
        behind[j] -= 1e-6
        column = (of_pass(shooting, ahead, lam) - of_pass(shooting, behind, lam)) / 2e-6 + 2 * slope * slope[j]
        for first, other in ((pattern.columns, pattern.rows), (pattern.rows, pattern.columns)):
            places = np.flatnonzero(first == j)
            if len(places) == 0:
                continue
            off = np.abs(computed[places] - column[other[places]])
            assert off.max() < 1e-3 * np.abs(column).max()
