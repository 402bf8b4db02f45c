"""Matrices of a controller as symbols: continuous, or sampled with its computation time."""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca

from gbid.errors import UsageError
from gbid.structure.linear import Structure, symbolic_matrices
from gbid.structure.numeric.linear_model import LinearModel
from gbid.structure.numeric.pade_model import with_pade


class SymbolicLaw(NamedTuple):
    """Matrices A, B, C, D of a controller, as casadi.SX."""

    A: ca.SX
    B: ca.SX
    C: ca.SX
    D: ca.SX


def law_of(controller: LinearModel | Structure, gains: ca.SX, pade_order: int) -> SymbolicLaw:
    """Return the matrices of a controller.

    Parameters
    ----------
    controller : LinearModel or Structure
        The controller; exact delays of a model become Padé filters.
    gains : casadi.SX
        Symbols of the gains of a structure, in its order.
    pade_order : int
        Order of these filters.

    Raises
    ------
    UsageError
        When a structure has exact delays.
    """
    if isinstance(controller, LinearModel):
        model = with_pade(controller, pade_order)
        return SymbolicLaw(*(ca.SX(ca.sparsify(ca.DM(getattr(model, letter)))) for letter in "ABCD"))
    p, m = symbolic_matrices(controller)
    if m.has_delay:
        raise UsageError(f"controller {controller.name!r} has exact delays; give pade_delay filters instead")
    return SymbolicLaw(*ca.substitute([m.A, m.B, m.C, m.D], [p], [gains]))


def tustin(law: SymbolicLaw, sample_time: float) -> SymbolicLaw:
    """Return a controller sampled by the trapezoidal rule, as a program runs it.

    With ``M = (I - h A / 2)^-1`` the matrices are ``2 M - I``, ``h M B``, ``C M`` and ``D + h C M B / 2``.
    """
    n, h = law.A.shape[0], sample_time
    if not n:
        return law
    M = ca.sparsify(ca.inv(ca.SX.eye(n) - h / 2 * law.A))
    return SymbolicLaw(2 * M - ca.SX.eye(n), h * M @ law.B, law.C @ M, law.D + h / 2 * law.C @ M @ law.B)


def computed_later(law: SymbolicLaw, samples: int) -> SymbolicLaw:
    """Return a sampled controller whose output acts some samples later; each sample adds a state for each output."""
    for _ in range(samples):
        n, n_r = law.A.shape[0], law.C.shape[0]
        law = SymbolicLaw(
            ca.blockcat([[law.A, ca.SX(n, n_r)], [law.C, ca.SX(n_r, n_r)]]),
            ca.vertcat(law.B, law.D),
            ca.horzcat(ca.SX(n_r, n), ca.SX.eye(n_r)),
            ca.SX(n_r, law.D.shape[1]),
        )
    return law
