"""Matrix exponential, holds and the linear recursion against scipy, fine integration and plain loops."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.signal import cont2discrete, lfilter

from gbid.core.arrays import recursion
from gbid.core.errors import UsageError
from gbid.discretise import discretise, exponentials, propagate, squarings_for
from gbid.discretise.exact import check_holds


def reference(Z):
    """e^Z, phi_1 and phi_2 as the first row of the exponential of one block matrix."""
    n = len(Z)
    zero, eye = np.zeros((n, n)), np.eye(n)
    big = expm(np.block([[Z, eye, zero], [zero, zero, eye], [zero, zero, zero]]))
    return big[:n, :n], big[:n, n : 2 * n], big[:n, 2 * n :]


def evaluated(Z, squarings):
    """The symbolic algorithm at a number."""
    symbol = ca.SX.sym("Z", *Z.shape)
    function = ca.Function("exponentials", [symbol], list(exponentials(symbol, squarings)))
    return [np.array(m) for m in function(Z)]


def rotor(pole=3000.0, frequency_hz=130.0, damping=0.03):
    """A lightly damped mode driven through a fast lag: positions of micrometres, accelerations of 10^5."""
    w = 2 * np.pi * frequency_hz
    A = np.array([[0, 1, 0], [-(w**2), -2 * damping * w, 1e5], [0, 0, -pole]])
    return A, np.array([[0.0], [1e4], [pole]])


STIFF = np.array([[-1.0, 2.0, 0.0], [0.0, -900.0, 30.0], [5.0, 0.0, -2e4]])
MATRICES = {
    "zero": np.zeros((3, 3)),
    "scalar": np.array([[-0.7]]),
    "nilpotent": np.diag([1e3, 1e3], 1),
    "rotation": np.array([[0.0, 40.0], [-40.0, 0.0]]),
    "stiff": STIFF,
    "growing": np.array([[2.0, 1.0], [0.0, 3.0]]),
    "badly scaled states": rotor()[0] * 2e-4,
    "four samples at once": rotor(pole=1e5)[0] * 8e-4,
    "random of ten": np.random.default_rng(2).normal(size=(10, 10)) * 3,
}


@pytest.mark.parametrize("name", MATRICES)
@pytest.mark.parametrize("algorithm", [exponentials, evaluated], ids=["numpy", "SX"])
def test_exponential_and_its_integrals_are_those_of_scipy(name, algorithm):
    Z = MATRICES[name]
    for computed, expected in zip(algorithm(Z, squarings_for([Z])), reference(Z), strict=True):
        assert computed.shape == Z.shape
        np.testing.assert_allclose(computed, expected, rtol=1e-10, atol=1e-12 * np.abs(expected).max())


@settings(max_examples=60, deadline=None)
@given(n=st.integers(1, 6), exponent=st.floats(-4, 1.5), seed=st.integers(0, 2**31))
def test_exponential_of_any_matrix(n, exponent, seed):
    Z = 10**exponent * np.random.default_rng(seed).normal(size=(n, n))
    for computed, expected in zip(exponentials(Z, squarings_for([Z])), reference(Z), strict=True):
        np.testing.assert_allclose(computed, expected, atol=1e-11 * np.abs(expected).max(), rtol=0)


def test_squarings_are_those_of_the_worst_sample_and_do_not_see_the_scaling_of_states():
    A = rotor()[0] * 2e-4
    # Each doubling halves the matrix: twice the sample time costs one more.
    assert squarings_for([A, 16 * A, 4 * A]) == squarings_for([16 * A])
    assert squarings_for([32 * A]) == squarings_for([16 * A]) + 1
    scale = np.diag([1e-6, 1.0, 1e3])
    assert squarings_for([scale @ A @ np.linalg.inv(scale)]) == squarings_for([A])
    assert squarings_for([1e-3 * A]) == 0
    assert squarings_for([]) == 0
    assert squarings_for([np.zeros((0, 0))]) == 0
    # 1e5 in an entry that no pole has: three poles far below one need no doubling.
    assert squarings_for([np.array([[-0.1, 1e5, 0], [0, -0.2, 1e5], [0, 0, -0.3]])]) <= 1


# ---- holds ----


def two_inputs():
    A, B = rotor()
    return A, np.hstack([B, [[300.0], [0.0], [-50.0]]])


@pytest.mark.parametrize("h", [1e-5, 2e-4, 3e-3])
def test_holds_are_those_of_scipy(h):
    A, B = two_inputs()
    C, D = np.eye(3), np.zeros((3, 2))
    zoh, foh = discretise(A, B, h, "zoh"), discretise(A, B, h, "foh")
    F, G, *_ = cont2discrete((A, B, C, D), h, "zoh")
    close = {"rtol": 1e-9, "atol": 1e-11 * np.abs(G).max()}
    np.testing.assert_allclose(zoh.F, F, rtol=1e-9, atol=1e-12 * np.abs(F).max())
    np.testing.assert_allclose(zoh.G_now, G, **close)
    assert not zoh.G_next.any()
    # scipy's state is x - G_next u (Franklin, Powell and Workman, Sec. 6.3.2).
    F, G, _, D, _ = cont2discrete((A, B, C, D), h, "foh")
    np.testing.assert_allclose(foh.F, F, rtol=1e-9, atol=1e-12 * np.abs(F).max())
    np.testing.assert_allclose(foh.G_now + foh.F @ foh.G_next, G, **close)
    np.testing.assert_allclose(foh.G_next, D, **close)


@pytest.mark.parametrize("hold", ["zoh", "foh", ("zoh", "foh"), ("foh", "zoh")])
def test_one_sample_is_that_of_fine_integration(hold):
    A, B = two_inputs()
    h, x0 = 4e-4, np.array([2e-6, -1e-3, 4e-6])
    now, following = np.array([4e-6, -3e-6]), np.array([-5e-6, 1e-6])
    line = np.array([kind == "foh" for kind in ((hold,) * 2 if isinstance(hold, str) else hold)])

    def slope(t, x):
        return A @ x + B @ (now + line * (following - now) * t / h)

    fine = solve_ivp(slope, (0, h), x0, method="DOP853", rtol=1e-12, atol=1e-20).y[:, -1]
    F, G_now, G_next = discretise(A, B, h, hold)
    np.testing.assert_allclose(F @ x0 + G_now @ now + G_next @ following, fine, rtol=1e-9)


def test_symbolic_and_numeric_discretisation_agree():
    A, B = two_inputs()
    h = 2e-4
    a, b = ca.SX.sym("A", *A.shape), ca.SX.sym("B", *B.shape)
    symbolic = discretise(a, b, h, ("foh", "zoh"), squarings_for([A * h]))
    function = ca.Function("discrete", [a, b], [ca.densify(m) for m in symbolic])
    for computed, expected in zip(function(A, B), discretise(A, B, h, ("foh", "zoh")), strict=True):
        np.testing.assert_allclose(np.array(computed), expected, rtol=1e-12, atol=0)


def test_the_symbolic_first_order_hold_keeps_zero_columns_of_held_inputs():
    A, B = (ca.SX(m) for m in two_inputs())
    assert discretise(A, B, 2e-4, ("zoh", "foh"), 1).G_next[:, 0].nnz() == 0
    assert discretise(A, B, 2e-4, "zoh", 1).G_next.nnz() == 0


def test_holds_are_checked():
    assert check_holds("foh", 2) == ("foh", "foh")
    assert check_holds(["zoh", "foh"], 2) == ("zoh", "foh")
    with pytest.raises(UsageError, match="intersample = 'linear'; choose 'zoh' or 'foh'"):
        check_holds("linear", 2)
    with pytest.raises(UsageError, match="names 2 inputs; there are 3"):
        check_holds(["zoh", "foh"], 3)
    with pytest.raises(UsageError, match="squarings"):
        discretise(ca.SX.sym("A", 2, 2), ca.SX.sym("B", 2, 1), 1e-3)


# ---- the recursion ----


@settings(max_examples=40, deadline=None)
@given(n=st.integers(1, 5), n_samples=st.integers(1, 140), seed=st.integers(0, 2**31))
def test_blocks_give_what_the_plain_loop_gives(n, n_samples, seed):
    random = np.random.default_rng(seed)
    F = random.normal(size=(n, n))
    F *= random.uniform(0.2, 1.02) / np.abs(np.linalg.eigvals(F)).max()
    w, x0 = random.normal(size=(n_samples, n)), random.normal(size=n)
    expected = np.empty((n_samples, n))
    x = x0
    for k in range(n_samples):
        expected[k] = x
        x = F @ x + w[k]
    computed = propagate(F, w, x0)
    np.testing.assert_allclose(computed, expected, rtol=1e-9, atol=1e-11 * max(1.0, np.abs(expected).max()))
    # The last forcing belongs to a sample that is not asked for.
    w[-1] += 1e6
    np.testing.assert_array_equal(propagate(F, w, x0), computed)


@pytest.mark.parametrize(("pole", "kind"), [(0.9, 0.0), (0.9, 1j), (0.6 + 0.79j, 0.0), (-1.001, 1j), (0.0, 0.0)])
@pytest.mark.parametrize("n", [1, 2, 3000])
def test_recursion_of_one_pole_is_that_of_scipy(pole, kind, n):
    real, imaginary = np.random.default_rng(n).normal(size=(2, n))
    forcing = real + kind * imaginary if kind else real
    computed = recursion(pole, forcing)
    expected = lfilter([1.0], [1.0, -pole], forcing)
    assert computed.dtype == expected.dtype
    np.testing.assert_allclose(computed, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_propagation_over_a_long_record_stays_exact():
    A, B = rotor()
    F, G, _ = discretise(A, B, 2e-4)
    n = 20_000
    states = propagate(F, np.ones((n, 1)) @ G.T, np.zeros(3))
    rest = np.linalg.solve(-A, B)[:, 0]
    np.testing.assert_allclose(states[-1], rest, rtol=1e-9, atol=1e-12)
