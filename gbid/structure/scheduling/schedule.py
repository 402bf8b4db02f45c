"""Polynomials over the range of scheduling variables, as a fit uses and stores them."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb, prod

import numpy as np

from gbid.arrays import FloatArray
from gbid.structure.scheduling.monomials import Exponents, monomials


@dataclass(frozen=True)
class Schedule:
    r"""Terms of the surfaces of a fit, in variables from -1 to 1 over the range of the recordings.

    The term of exponents (i, j) is :math:`\pi^i \omega^j` with
    :math:`\pi = (P - P_c) / P_h`: P_c is the centre of the range and P_h half its width. So the terms are of the order
    of one, and the first coefficient is the value at the centre.

    Attributes
    ----------
    variables : tuple of str
        Scheduling variables.
    low, high : tuple of float
        Range of each over the recordings.
    surfaces : tuple of str
        Parameters that are surfaces.
    exponents : tuple of tuple of int
        Powers of the variables in each term.
    pieces : int
        Number of pieces with constant parameters, in all recordings.
    pade_order : int
        Order of the delays of the structure.
    """

    variables: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    surfaces: tuple[str, ...]
    exponents: Exponents
    pieces: int
    pade_order: int = 1

    @property
    def centre(self) -> FloatArray:
        """Middle of the range of each variable, (n_variables,)."""
        return np.asarray((np.array(self.low, float) + np.array(self.high, float)) / 2, np.float64)

    @property
    def half(self) -> FloatArray:
        """Half the width of the range of each variable, (n_variables,); one for a constant."""
        half = np.asarray((np.array(self.high, float) - np.array(self.low, float)) / 2, np.float64)
        return np.asarray(np.where(half > 0, half, 1.0))

    def terms(self, points: FloatArray) -> FloatArray:
        """Return the terms at points (..., n_variables), shape (..., n_terms)."""
        return monomials((points - self.centre) / self.half, self.exponents)

    def names(self, key: str) -> list[str]:
        """Return the names of the coefficients of a surface."""
        return coefficient_names(key, len(self.exponents))

    @property
    def to_own_units(self) -> FloatArray:
        """Matrix from the coefficients of a surface to those of terms in the units of the variables, (m, m).

        ``(P - c)^i = sum_k comb(i, k) P^k (-c)^(i - k)``, a product over the variables. All lower terms are there.
        """
        m = len(self.exponents)
        onto = np.zeros((m, m))
        for column, of in enumerate(self.exponents):
            for row, to in enumerate(self.exponents):
                if all(k <= i for k, i in zip(to, of, strict=True)):
                    onto[row, column] = prod(
                        comb(i, k) * (-c) ** (i - k) / h**i
                        for i, k, c, h in zip(of, to, self.centre, self.half, strict=True)
                    )
        return onto


def coefficient_names(key: str, n_terms: int) -> list[str]:
    """Return the names of the coefficients of a surface, in the paper's numbers: ``k_xx_0`` to ``k_xx_5``."""
    return [f"{key}_{i}" for i in range(n_terms)]
