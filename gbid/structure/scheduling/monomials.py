"""Terms of polynomials in scheduling variables (paper, Eq. 16)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations_with_replacement

import numpy as np

from gbid.arrays import FloatArray

TERMS = ("1", "P", "Omega", "Omega P", "P^2", "Omega^2")
"""Terms in the order of the coefficients; P in bar, Omega in rpm."""

SCHEDULING = ("pressure_bar", "speed_rpm")
"""Scheduling variables of a gas bearing."""

EXPONENTS = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2))
"""Powers of (P, Omega) of each term."""

Exponents = tuple[tuple[int, ...], ...]


def exponents_of(order: int, n_variables: int = 2) -> Exponents:
    """Return the powers of the scheduling variables up to a total order; for two in the order of `gbid.lpv.TERMS`."""
    if n_variables == 2:
        higher = [(i, total - i) for total in range(3, order + 1) for i in range(total, -1, -1)]
        return (*(e for e in EXPONENTS if sum(e) <= order), *higher)
    chosen = (c for total in range(order + 1) for c in combinations_with_replacement(range(n_variables), total))
    return tuple(tuple(c.count(i) for i in range(n_variables)) for c in chosen)


def term_name(exponent: Sequence[int], scheduling: Sequence[str] = SCHEDULING) -> str:
    """Return the name of a term: for a gas bearing as in `gbid.lpv.TERMS`, else as ``"current^2 gap"``."""
    if tuple(scheduling) == SCHEDULING:
        if tuple(exponent) in EXPONENTS:
            return TERMS[EXPONENTS.index((exponent[0], exponent[1]))]
        scheduling = ("P", "Omega")
    powers = zip(scheduling, exponent, strict=True)
    return " ".join(f"{name}^{power}" if power > 1 else name for name, power in powers if power) or "1"


def monomials(points: FloatArray, exponents: Sequence[Sequence[int]]) -> FloatArray:
    """Return the terms ``P^i Omega^j ...`` of points (..., n_variables) in their own units, shape (..., n_terms)."""
    return np.stack([np.prod(points ** np.array(e), axis=-1) for e in exponents], axis=-1)
