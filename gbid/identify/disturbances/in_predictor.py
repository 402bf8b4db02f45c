"""Disturbances in the equations of a predictor: columns of known regressors, and states of random walks."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray
from gbid.discretise import Dual
from gbid.identify.disturbances.disturbances import Disturbances
from gbid.structure import Matrices


def disturbing_columns(disturbances: Disturbances, theta: FloatArray) -> Dual:
    """Return the matrix from the regressors to the outputs, whose coefficients are the last of the parameters.

    Parameters
    ----------
    disturbances : Disturbances
        Trends and hum.
    theta : (..., n_p) array
        Parameters of a predictor, at one point or several.

    Returns
    -------
    Dual
        (..., n_outputs, n_columns), with its derivatives by all parameters.
    """
    n_p, count = theta.shape[-1], len(disturbances.terms)
    value = disturbances.matrix(theta[..., n_p - count :])
    slope = np.zeros((n_p, *value.shape))
    for i, (row, column) in enumerate(zip(*disturbances.places, strict=True)):
        slope[n_p - count + i, ..., row, column] = 1.0
    return Dual(value, slope)


def with_random_walks(m: Matrices, outputs: Sequence[int], gains: ca.SX) -> Matrices:
    """Return the matrices with one more state for each of these outputs: its offset, a random walk.

    Parameters
    ----------
    m : Matrices
        Matrices of a structure.
    outputs : sequence of int
        Outputs whose offset is a random walk.
    gains : casadi.SX
        Gain of each of them from the error of its output [1/s]; empty when the offsets stay as they are.

    Returns
    -------
    Matrices
        ``db/dt = gain e`` for each offset b, and ``y = C x + D u + b + e``.
    """
    if not outputs:
        return m
    n_u, n_y, added = m.B.shape[1], m.C.shape[0], len(outputs)
    onto = ca.SX(n_y, added)
    for column, output in enumerate(outputs):
        onto[output, column] = 1
    still = ca.SX(added, n_u)
    feedback = m.feedback
    if feedback is not None:
        drive = ca.vertcat(feedback.law.drive, ca.SX(added, feedback.law.drive.shape[1]))
        feedback = feedback._replace(law=feedback.law._replace(drive=drive))
    return m._replace(
        A=ca.diagcat(m.A, ca.SX(added, added)),
        B=ca.vertcat(m.B, still),
        C=ca.horzcat(m.C, onto),
        K=ca.vertcat(m.K, ca.diag(gains) @ onto.T if gains.numel() else ca.SX(added, n_y)),
        B_delayed=ca.vertcat(m.B_delayed, still),
        x0=ca.vertcat(m.x0, ca.SX(added, 1)) if m.x0.numel() else m.x0,
        feedback=feedback,
    )
