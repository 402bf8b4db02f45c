"""Exponentials of duals, compiled and in numpy: against scipy's expm of block matrices, and complex steps."""

import sys

import numpy as np
import pytest
from compilers import NEEDS_COMPILER
from scipy.linalg import block_diag, expm

from gbid.discretise import delayed_taps, discretise, exact, exponentials, squarings_for
from gbid.discretise.dual import Dual

N_P = 11  # more than fill the lanes of the compiled function once
RANDOM = np.random.default_rng(35)


def random_matrix(n):
    return RANDOM.normal(size=(n, n)) * 1.5 / np.sqrt(n)


MATRICES = {f"random {n}": random_matrix(n) for n in range(1, 13)}
MATRICES |= {
    "zero": np.zeros((3, 3)),
    "defective": np.eye(5, k=1) - 0.3 * np.eye(5),
    "stiff": block_diag([[-4e3, 1e4], [0.0, -2e3]], random_matrix(3)),
    "unstable": random_matrix(4) + 6.0 * np.eye(4),
    "scaled as a rotor": block_diag([[0.0, 1.0], [-2.5, -0.01]], [[0.0, 1.0], [-9e4, -3.0]]) * 1e-2,
    "large": random_matrix(exact.LARGEST + 1),
}


@pytest.fixture(params=[pytest.param("compiled", marks=NEEDS_COMPILER), "numpy"], autouse=True)
def _engine(request, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "RANDOM", np.random.default_rng(36))  # whatever ran before
    if request.param == "numpy":
        monkeypatch.setattr(exact, "compiled", lambda _: None)
    else:
        assert exact.compiled("gbid_exponentials") is not None


def slopes_of(matrix):
    """Random derivatives; those by every third parameter are zero."""
    slope = RANDOM.normal(size=(N_P, *matrix.shape)) * (np.abs(matrix).max(initial=0.1))
    slope[::3] = 0.0
    return slope


def by_blocks(Z):
    """e^Z, phi_1 and phi_2 side by side: the first rows of the exponential of one larger matrix."""
    n = len(Z)
    big = np.zeros((3 * n, 3 * n), Z.dtype)
    big[:n, :n], big[:n, n : 2 * n], big[n : 2 * n, 2 * n :] = Z, np.eye(n), np.eye(n)
    return np.split(expm(big)[:n], 3, axis=1)


def assert_close(computed, expected, share=1e-13):
    np.testing.assert_allclose(computed, expected, rtol=0, atol=share * np.abs(expected).max(initial=1e-300))


@pytest.mark.parametrize("name", MATRICES)
def test_against_expm(name):
    """Values by scipy; a derivative is a corner of the exponential of [[Z, dZ], [0, Z]]."""
    Z = MATRICES[name]
    slope, n = slopes_of(Z), len(Z)
    doublings = squarings_for([Z])
    computed = exponentials(Dual(Z, slope), doublings)
    accuracy = 1e-13 * max(1.0, np.linalg.norm(Z, 1))  # the condition number of an exponential is at least its norm
    for part, expected in zip(computed, by_blocks(Z), strict=True):
        assert_close(part.value, expected, accuracy)
    for j, dZ in enumerate(slope):
        twin = np.block([[Z, dZ], [np.zeros((n, n)), Z]])
        for part, expected in zip(computed, by_blocks(twin), strict=True):
            assert_close(part.slope[j], expected[:n, n:], accuracy)


@pytest.mark.parametrize("name", MATRICES)
def test_against_the_formula_of_arrays(name):
    """The numbers of the one formula: numpy for arrays, and complex steps for derivatives.

    A doubling also doubles the relative error that rounding left in `e^Z`. One order of sums gives the same bits.
    """
    Z = MATRICES[name]
    slope, doublings = slopes_of(Z), squarings_for([Z])
    accuracy = max(1e-13, np.finfo(float).eps * 2**doublings)
    computed = exponentials(Dual(Z, slope), doublings)
    for part, expected in zip(computed, exponentials(Z, doublings), strict=True):
        assert_close(part.value, expected, accuracy)
    for j, dZ in enumerate(slope):
        for part, complex_part in zip(computed, exponentials(Z + 1e-30j * dZ, doublings), strict=True):
            assert_close(part.slope[j], complex_part.imag / 1e-30, accuracy)


def test_points_are_independent():
    """Matrices at several points, of which each has its own parameters without effect."""
    Z = RANDOM.normal(size=(4, 6, 6))
    slope = RANDOM.normal(size=(N_P, 4, 6, 6))
    slope[1:4, 0], slope[:, 2] = 0.0, 0.0
    together = exponentials(Dual(Z, slope), 3)
    for i in range(len(Z)):
        for part, alone in zip(together, exponentials(Dual(Z[i], slope[:, i]), 3), strict=True):
            assert_close(part.value[i], alone.value, 1e-15)
            assert_close(part.slope[:, i], alone.slope, 1e-15)


def test_without_states_or_parameters():
    assert exponentials(Dual(np.zeros((0, 0)), np.zeros((2, 0, 0))), 0).exp.slope.shape == (2, 0, 0)
    alone = exponentials(Dual(np.eye(2), np.zeros((0, 2, 2))), 0)
    assert_close(alone.exp.value, np.e * np.eye(2))
    assert alone.phi2.slope.shape == (0, 2, 2)


def test_what_is_not_finite_stays_so():
    Z = np.diag([1.0, np.nan])
    assert not np.isfinite(exponentials(Dual(Z, np.ones((1, 2, 2))), 0).exp.value).all()


@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("n", [1, 2, 5, 8, 12])
def test_discretisation_by_complex_steps(n, hold):
    A, B, h = random_matrix(n), RANDOM.normal(size=(n, 2)), 0.7
    dA, dB = slopes_of(A), slopes_of(B)
    doublings = squarings_for([A * h])
    computed = discretise(Dual(A, dA), Dual(B, dB), h, hold)
    for j in range(N_P):
        stepped = discretise(A + 1e-30j * dA[j], B + 1e-30j * dB[j], h, hold, doublings)
        for part, expected in zip(computed, stepped, strict=True):
            assert_close(part.value, expected.real)
            assert_close(part.slope[j], expected.imag / 1e-30)


@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("samples", [0.0, 0.3, 0.999, 1.0, 7.4, 250.5])
def test_delayed_inputs_by_complex_steps(samples, hold):
    A, b, h = random_matrix(6), RANDOM.normal(size=(6, 1)), 0.4
    dA, db, d_tau = slopes_of(A), slopes_of(b), RANDOM.normal(size=(N_P, 1, 1))
    tau, doublings = samples * h, squarings_for([A * h])
    delay = Dual(np.array([[tau]]), d_tau)
    computed = delayed_taps(Dual(A, dA), Dual(b, db), delay, h, hold, near=(tau, doublings))
    for j in range(N_P):
        moved = tau + 1e-30j * d_tau[j]
        stepped = delayed_taps(A + 1e-30j * dA[j], b + 1e-30j * db[j], moved, h, hold, near=(tau, doublings))
        assert stepped.shift == computed.shift
        whole = np.hstack(stepped.columns)
        assert_close(np.hstack([c.value for c in computed.columns]), whole.real)
        assert_close(np.hstack([c.slope[j] for c in computed.columns]), whole.imag / 1e-30, 1e-12)
