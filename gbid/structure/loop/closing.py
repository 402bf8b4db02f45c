"""Closed loop of a plant and a controller whose state-space matrices are symbols, numbers or duals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError


class LoopParts(NamedTuple):
    """State-space matrices of a plant or a loop, as casadi.SX, arrays or `Dual`.

    ``x' = A x + B w + K e``, ``y = C x + D w + e``.
    """

    A: Any
    B: Any
    C: Any
    D: Any
    K: Any


class ControlLaw(NamedTuple):
    """Controller ``z' = A z + B s``, ``r = C z + D s`` of measured outputs s, as casadi.SX, arrays or `Dual`.

    Attributes
    ----------
    A, B, C, D
        (n, n), (n, n_measured), (n_r, n), (n_r, n_measured).
    drive, feed
        Matrices from r to the states and to the outputs of the plant.
    """

    A: Any
    B: Any
    C: Any
    D: Any
    drive: Any
    feed: Any


class HeldFeedback(NamedTuple):
    """Sampled controller in the loop of a continuous plant, which holds its output between samples.

    Attributes
    ----------
    law : ControlLaw
        The controller as casadi.SX, from sample to sample.
    measured : tuple of int
        Outputs that it measures.
    set_point : bool
        Whether the injected signal is a set point, see `closed_parts`.
    sample_time : float
        Time between samples [s].
    """

    law: ControlLaw
    measured: tuple[int, ...]
    set_point: bool
    sample_time: float

    @property
    def n_states(self) -> int:
        """Number of states of the controller."""
        return int(self.law.A.shape[0])

    def refuse_other_data(self, name: str, holds: Sequence[str], sample_time: float) -> None:
        """Refuse data that the controller of a structure with this name cannot have run with.

        Raises
        ------
        UsageError
            When the data have another sample time, or inputs that are not held.
        """
        if not np.isclose(self.sample_time, sample_time, rtol=1e-6, atol=0):
            raise UsageError(
                f"{name}: the controller runs every {self.sample_time:g} s, the recordings are sampled at "
                f"{sample_time:g} s"
            )
        if "foh" in holds:
            raise UsageError(
                f"{name}: intersample = 'foh'; what is injected is held like the output of the controller: 'zoh'"
            )

    def close(self, plant: LoopParts, law: ControlLaw | None = None) -> LoopParts:
        """Return the loop of a plant with held inputs and this controller, or its numbers."""
        return closed_parts(plant, self.law if law is None else law, self.measured, self.set_point)


def closed_parts(plant: LoopParts, law: ControlLaw, measured: Sequence[int], set_point: bool) -> LoopParts:
    r"""Return the loop of a plant and a controller, with the states of the plant before those of the controller.

    The controller measures the outputs with their errors, so that the errors e drive it, too:

    .. math:: x' &= A x + B w + B_r r + K e, \quad y = C x + D w + D_r r + e \\
              z' &= A_K z + B_K S y, \quad r = C_K z + D_K S y

    where S selects the measured outputs.

    Parameters
    ----------
    plant : LoopParts
        The plant, from what is injected.
    law : ControlLaw
        The controller. Its D or its `feed` must be zero.
    measured : sequence of int
        Outputs that the controller measures.
    set_point : bool
        Whether w is a set point: the controller gets ``S y - w``. The columns of `plant.B` are then zero.

    Returns
    -------
    LoopParts
    """
    n, n_z, n_y = plant.A.shape[0], law.A.shape[0], plant.C.shape[0]
    told = np.eye(len(measured), plant.B.shape[1]) * set_point  # the set point as the first columns
    x_in, z_in, S, less = (
        _like(plant.A, matrix)
        for matrix in (np.eye(n + n_z, n), np.eye(n + n_z)[:, n:], np.eye(n_y)[list(measured)], told)
    )
    via = x_in @ law.drive @ law.D + z_in @ law.B  # from what the controller gets to all states
    C = plant.C @ x_in.T + law.feed @ law.C @ z_in.T
    A = x_in @ plant.A @ x_in.T + x_in @ law.drive @ law.C @ z_in.T + z_in @ law.A @ z_in.T + via @ S @ C
    B = x_in @ plant.B + via @ (S @ plant.D - less)
    return LoopParts(A, B, C, plant.D, x_in @ plant.K + via @ S)


def _like(kind: Any, matrix: FloatArray) -> Any:
    """Return a constant matrix that multiplies matrices of a kind."""
    return ca.sparsify(ca.DM(matrix)) if isinstance(kind, ca.SX) else matrix
