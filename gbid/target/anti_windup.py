"""Anti-windup gain of a sampled controller of any structure."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_discrete_are

from gbid.arrays import FloatArray
from gbid.structure import LinearModel


def anti_windup_gain(controller: LinearModel) -> FloatArray:
    r"""Return the gain L by which the states follow a saturated output.

    .. math:: x_{k+1} = A x_k + B e_k + L (\mathrm{sat}(w_k) - w_k), \quad w_k = C x_k + D e_k

    During saturation the states obey ``A - L C``. L is the stationary Kalman gain of the controller whose input e is
    white noise and whose output has noise of the size of its immediate response. For a PI controller this is
    back-calculation with a tracking time of 1.4 times the integral time. For a controller with invertible D it is close
    to the conditioning technique, ``L = B D^-1``. A fast filter gets a small gain, because it forgets by itself.

    Parameters
    ----------
    controller : LinearModel
        Sampled controller.

    Returns
    -------
    (n_states, n_outputs) array
        L; zero when no input reaches an output, or when a state that does not decay reaches none.

    Notes
    -----
    Hanus, R., Kinnaert, M., Henrotte, J.-L. (1987), Conditioning technique, a general anti-windup and bumpless transfer
    method, Automatica 23, 729-739.
    """
    A, B, C, D = (np.array(getattr(controller, letter), float) for letter in "ABCD")
    none = np.zeros((len(A), len(C)))
    if not A.size:
        return none
    size, column = float(np.linalg.norm(D, 2)), B
    for _ in range(2):
        size, column = max(size, float(np.linalg.norm(C @ column, 2))), A @ column
    if size == 0:
        return none
    Q, S = B @ B.T, B @ D.T
    R = D @ D.T + size**2 * np.eye(len(C))
    try:
        P = solve_discrete_are(A.T, C.T, Q, R, s=S)
    except np.linalg.LinAlgError:  # an integrator that no output shows, or that no input drives
        return none
    gain = np.linalg.solve((C @ P @ C.T + R).T, (A @ P @ C.T + S).T).T
    return np.asarray(np.where(np.abs(gain) < 1e-12 * np.abs(gain).max(), 0.0, gain))  # axes that do not mix
