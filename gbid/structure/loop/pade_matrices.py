"""Symbolic matrices whose exact delays are replaced by Padé filters."""

from __future__ import annotations

import casadi as ca

from gbid.structure.delay import pade_delay
from gbid.structure.linear import Matrices


def pade_matrices(m: Matrices, order: int) -> Matrices:
    """Return the matrices without exact delays: the signal of each delayed input passes a Padé filter.

    In a loop the delayed signal is not known in advance, so the delay must be a part of the state.

    Parameters
    ----------
    m : Matrices
        Matrices of a structure; without exact delays they are returned unchanged.
    order : int
        Order of the filters; each adds as many states for each delayed input, after those of the structure.
    """
    if not m.has_delay:
        return m
    late = sorted(set(m.B_delayed.sparsity().get_triplet()[1]))
    filters = [pade_delay(m.delay[i], order) for i in late]
    A, B, C, D = (ca.diagcat(*(getattr(each, letter) for each in filters)) for letter in "ABCD")
    n, n_u, n_y, added = m.A.shape[0], m.B.shape[1], m.C.shape[0], order * len(late)
    into = ca.SX(len(late), n_u)
    for row, i in enumerate(late):
        into[row, i] = 1
    drive = m.B_delayed[:, late]
    return Matrices(
        A=ca.blockcat([[m.A, drive @ C], [ca.SX(added, n), A]]),
        B=ca.vertcat(m.B + drive @ D @ into, B @ into),
        C=ca.horzcat(m.C, ca.SX(n_y, added)),
        D=m.D,
        K=ca.vertcat(m.K, ca.SX(added, n_y)),
        B_delayed=ca.SX(n + added, n_u),
        delay=ca.SX(0, 1),
        x0=ca.vertcat(m.x0, ca.SX(added, 1)) if m.x0.numel() else m.x0,
    )
