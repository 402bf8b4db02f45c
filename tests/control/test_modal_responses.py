"""Frequency responses of loops from their modes, and without them where the matrix is defective."""

import numpy as np
import pytest

from gbid.control.tuning.loops import Loops
from gbid.control.tuning.peaks import ModalResponse
from gbid.control.tuning.plane import Eigensystem


@pytest.mark.parametrize("n", [5, 32, 33, 100])
def test_a_chain_of_equal_poles_has_the_response_of_its_closed_form(n: int) -> None:
    """1/(1 + s T)^n: one eigenvector for all poles, so that only the Schur form can tell."""
    T = 0.01
    A = (np.diag(np.ones(n - 1), -1) - np.eye(n)) / T
    B, C = np.zeros((n, 1)), np.zeros((1, n))
    B[0, 0], C[0, -1] = 1 / T, 1.0
    w = np.array([[0.1, 3.0, 10.0, 20.0]])
    loops = Loops(A[None], B[None], C[None], np.zeros((1, 1, 1)))
    responses = ModalResponse(loops, Eigensystem.of(A[None]), slice(0, 1))(w)[0, :, 0, 0]
    np.testing.assert_allclose(responses, 1 / (1 + 1j * w[0] * T) ** n, rtol=1e-9, atol=1e-12)
