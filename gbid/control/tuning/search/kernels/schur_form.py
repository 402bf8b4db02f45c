"""Complex Schur form of a balanced matrix, and the eigenvalues near given places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dgebal, zgees

from gbid.arrays import ComplexArray, FloatArray
from gbid.control.tuning.search.kernels.compiled import compiled_schur_form, kernels


@dataclass(frozen=True, eq=False)
class SchurForm:
    """Complex Schur form of a matrix in balanced units of its states, which decide how good it is.

    With the balanced matrix ``A / unit[:, None] * unit`` it is ``basis form basis*``.

    Attributes
    ----------
    packed : complex array
        Form (n, n), vectors of the basis as rows (n, n), units (n,) as pairs of real numbers, and eigenvalues (n,).
    n : int
        Number of states.
    """

    packed: ComplexArray
    n: int

    @classmethod
    def of(cls, A: FloatArray) -> SchurForm | None:
        """Return the form of a finite matrix (n, n); None when it is not found."""
        n, library = len(A), kernels()
        found = None if library is None else compiled_schur_form(library, A)
        if found is not None:
            return cls(found, n)
        balanced, _, _, unit, _ = dgebal(A, scale=1)
        form, _, _, basis, _, failed = zgees(lambda _: None, balanced)
        pairs = np.append(unit, np.zeros(n % 2)).view(complex)
        return None if failed else cls(np.concatenate([form.ravel(), basis.T.ravel(), pairs, np.diag(form)]), n)

    @property
    def form(self) -> ComplexArray:
        """Upper triangular matrix (n, n)."""
        return self.packed[: self.n**2].reshape(self.n, self.n)

    @property
    def basis(self) -> ComplexArray:
        """Unitary matrix (n, n)."""
        return self.packed[self.n**2 : 2 * self.n**2].reshape(self.n, self.n).T

    @property
    def unit(self) -> FloatArray:
        """Units of the states (n,)."""
        return self.packed[2 * self.n**2 : -self.n].view(float)[: self.n]
