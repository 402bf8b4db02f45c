"""Loops of given plants and one controller, as numbers: continuous, or sampled in the plane of the search."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.plants.controller_law import ControllerLaw, Matrices
from gbid.control.tuning.search.loop_family import Derivatives, LoopFamily, Loops


@dataclass(frozen=True, eq=False)
class PlantMatrices:
    """Matrices of m plants of equal size: A (m, n, n), B (m, n, n_r), C (m, n_p, n), D (m, n_p, n_r)."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray


@dataclass(frozen=True, eq=False)
class ModelFamily(LoopFamily):
    r"""Loops of plants given by their matrices.

    With ``x' = A x + B r, p = C x + D r``, ``r = K (p + d)`` and :math:`X = (I - D_K D)^{-1}` the reference is
    ``r = X (C_K x_K + D_K C x + D_K d)``. The outputs are ``p + d = S_o d`` and ``r = K S_o d``. The equations of
    sampled loops are the same; their matrices are then those of the bilinear transform, see `search.plane`.

    Parameters
    ----------
    plants : PlantMatrices
        The plants.
    law : ControllerLaw
        The controller.
    """

    plants: PlantMatrices | None = None
    law: ControllerLaw | None = None
    companion: LoopFamily | None = None

    def __post_init__(self) -> None:
        assert self.plants is not None
        assert self.law is not None

    def matrices(self, gains: FloatArray) -> Loops:
        """Return the matrices of all loops."""
        assert self.law is not None
        loops = self._closed(self.law.matrices(gains))
        return loops if self.sample_time is None else _transformed(loops, self.sample_time)[0]

    def derivatives(self, gains: FloatArray) -> Derivatives:
        """Return the matrices with their derivatives."""
        assert self.law is not None
        values, slopes = self.law.derivatives(gains)
        loops, changes = self._closed(values), self._changes(values, slopes)
        if self.sample_time is None:
            return Derivatives(loops.A, loops.B, loops.C, loops.D, *changes)
        turned, P = _transformed(loops, self.sample_time)
        slopes_there = _transformed_slopes(loops, changes, P, self.sample_time)
        return Derivatives(turned.A, turned.B, turned.C, turned.D, *slopes_there)

    def _closed(self, K: Matrices) -> Loops:
        plant, (A_K, B_K, C_K, D_K) = self.plants, K
        assert plant is not None
        m, n_p = len(plant.A), plant.C.shape[1]
        A_K, B_K, C_K, D_K = (np.broadcast_to(M, (m, *M.shape[1:])) for M in (A_K, B_K, C_K, D_K))
        X = _inverse(np.eye(D_K.shape[1]) - D_K @ plant.D)
        r_x, r_k, r_d = X @ D_K @ plant.C, X @ C_K, X @ D_K
        p_x, p_k, p_d = plant.C + plant.D @ r_x, plant.D @ r_k, np.eye(n_p) + plant.D @ r_d
        return Loops(
            np.block([[plant.A + plant.B @ r_x, plant.B @ r_k], [B_K @ p_x, A_K + B_K @ p_k]]),
            np.concatenate([plant.B @ r_d, B_K @ p_d], axis=1),
            np.block([[p_x, p_k], [r_x, r_k]]),
            np.concatenate([p_d, r_d], axis=1),
        )

    def _changes(self, K: Matrices, slopes: Matrices) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the derivatives of the closed loop's A, B, C, D, each (m, d, ., .)."""
        assert self.plants is not None
        G_A, G_B, G_C, G_D = (M[:, None] for M in (self.plants.A, self.plants.B, self.plants.C, self.plants.D))
        _, B_K, C_K, D_K = (M[:, None] for M in K)
        dA_K, dB_K, dC_K, dD_K = slopes
        m, d = len(G_A), dA_K.shape[1]
        X = _inverse(np.eye(D_K.shape[2]) - D_K @ G_D)
        dX = X @ dD_K @ G_D @ X
        dX_C = dX @ C_K + X @ dC_K
        dX_D = dX @ D_K + X @ dD_K
        dr_x, dr_k, dr_d = dX_D @ G_C, dX_C, dX_D
        dr_x, dr_k, dr_d = (np.broadcast_to(M, (m, d, *M.shape[2:])) for M in (dr_x, dr_k, dr_d))
        p_x, p_k = G_C + G_D @ X @ D_K @ G_C, G_D @ X @ C_K
        p_d = np.eye(G_C.shape[2]) + G_D @ X @ D_K
        dA = np.block(
            [
                [G_B @ dr_x, G_B @ dr_k],
                [dB_K @ p_x + B_K @ G_D @ dr_x, dA_K + dB_K @ p_k + B_K @ G_D @ dr_k],
            ]
        )
        dB = np.concatenate([G_B @ dr_d, dB_K @ p_d + B_K @ G_D @ dr_d], axis=2)
        dC = np.block([[G_D @ dr_x, G_D @ dr_k], [dr_x, dr_k]])
        return dA, dB, dC, np.concatenate([G_D @ dr_d, dr_d], axis=2)


def model_family(
    plants: PlantMatrices,
    law: ControllerLaw,
    labels: tuple[str, ...],
    points: FloatArray | None,
    companion: LoopFamily | None = None,
) -> ModelFamily:
    """Return the loops of plants and a controller.

    Parameters
    ----------
    plants : PlantMatrices
        The plants; sampled when the controller is.
    law : ControllerLaw
        The controller.
    labels : tuple of str
        Names of the loops.
    points : (m, 2) array, optional
        Operating points.
    companion : LoopFamily, optional
        The same loops in continuous time, for measures that need it.
    """
    nothing = ca.Function("nothing", [ca.SX.sym("gains", len(tuple(law.structure.parameters)))], [])
    n, T = plants.C.shape[1], law.sample_time
    return ModelFamily(nothing, nothing, labels, points, n, T, plants=plants, law=law, companion=companion)


def _inverse(matrices: FloatArray) -> FloatArray:
    """Return inverses; not finite where there is none: an algebraic loop without solution, a pole at z = -1."""
    try:
        return np.asarray(np.linalg.inv(matrices), np.float64)
    except np.linalg.LinAlgError:
        found = np.full(matrices.shape, np.nan)
        for place in np.ndindex(*matrices.shape[:-2]):
            with suppress(np.linalg.LinAlgError):
                found[place] = np.linalg.inv(matrices[place])
        return found


def _transformed(loops: Loops, T: float) -> tuple[Loops, FloatArray]:
    """Return sampled loops in the plane ``w = (2 / T) (z - 1) / (z + 1)``, and ``(A + I)^-1``."""
    eye, s = np.eye(loops.A.shape[-1]), 2 / np.sqrt(T)
    P = np.asarray(_inverse(loops.A + eye), np.float64)
    CP = loops.C @ P
    return Loops(2 / T * (eye - 2 * P), s * P @ loops.B, s * CP, loops.D - CP @ loops.B), P


def _transformed_slopes(
    loops: Loops, changes: tuple[FloatArray, FloatArray, FloatArray, FloatArray], P: FloatArray, T: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    s, (dA, dB, dC, dD) = 2 / np.sqrt(T), changes
    P1, PB, CP = P[:, None], (P @ loops.B)[:, None], (loops.C @ P)[:, None]
    turned = P1 @ dA
    return (
        4 / T * turned @ P1,
        s * (P1 @ dB - turned @ PB),
        s * (dC @ P1 - CP @ dA @ P1),
        dD - dC @ PB - CP @ dB + CP @ dA @ PB,
    )
