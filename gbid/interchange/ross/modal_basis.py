"""Modal reduction of a rotor whose bearings are to be varied."""

from __future__ import annotations

import numpy as np
from scipy.linalg import eigh

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.interchange.ross.lateral_matrices import LateralMatrices

N_GYROSCOPIC = 4
"""Number of modes whose gyroscopic moments have static shapes of their own."""
_DEPENDENT = 1e-10  # of the largest; below it a shape is a sum of the others


def modal_basis(equations: LateralMatrices, modes: int, loads: FloatArray) -> FloatArray:
    r"""Return shapes that describe the motion of a rotor for any coefficients of its unknown bearings.

    Parameters
    ----------
    equations : LateralMatrices
        Equations of the rotor.
    modes : int
        Number of modes of the rotor at rest on supports of the start values.
    loads : (n, n_loads) array
        Directions of the actuators.

    Returns
    -------
    (n, m) array
        Shapes :math:`\Phi`, orthonormal in the mass: :math:`\Phi^T M \Phi = I`.

    Raises
    ------
    UsageError
        When there are not that many modes.

    Notes
    -----
    To the modes come the static shapes under forces at the unknown bearings and at the actuators, and under the
    gyroscopic moments of the lowest modes (attachment modes; Craig, Structural Dynamics, ch. 19). With them the
    compliance at bearings and actuators is exact at frequency zero, whatever the number of modes.
    """
    n = len(equations.mass)
    if not 1 <= modes <= n:
        raise UsageError(f"modes = {modes}; the rotor has 1 to {n} lateral modes")
    supports = np.hstack([bearing.entry for bearing in equations.bearings])
    symmetric = (equations.stiffness + equations.stiffness.T) / 2.0
    stiff = np.repeat([_support(bearing.stiffness, symmetric) for bearing in equations.bearings], 2)
    supported = symmetric + (supports * stiff) @ supports.T
    _, shapes = eigh(supported, equations.mass, subset_by_index=[0, modes - 1])
    gyroscopic = (equations.damping - equations.damping.T) @ shapes[:, :N_GYROSCOPIC]
    loaded = np.hstack([supports, loads, gyroscopic])
    forced = np.linalg.solve(supported, loaded[:, loaded.any(axis=0)])
    whole = _size(equations, forced)
    for _ in range(2):  # twice: what rounding leaves of the first projection is then as small as rounding
        forced = forced - shapes @ (shapes.T @ (equations.mass @ forced))
    size = _size(equations, forced)
    new = size > np.sqrt(_DEPENDENT) * whole
    forced = forced[:, new] / size[new]
    if not forced.shape[1]:
        return np.asarray(shapes)
    weights, mix = np.linalg.eigh(forced.T @ equations.mass @ forced)
    kept = weights > _DEPENDENT * weights.max()
    return np.hstack([shapes, forced @ (mix[:, kept] / np.sqrt(weights[kept]))])


def _size(equations: LateralMatrices, shapes: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.einsum("ij,ij->j", shapes, equations.mass @ shapes)))


def _support(stiffness: FloatArray, shaft: FloatArray) -> float:
    """Return the stiffness of the support of a bearing in the basis: of its start values where they hold a rotor."""
    direct = float(np.mean(np.diag(stiffness)))
    return direct if direct > 0 else 1e-3 * float(np.diag(shaft).max())
