"""Eigenvalues of the same loops at nearby designs, and their gradients."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gbid.arrays import ComplexArray
from gbid.control.tuning.search.kernels.compiled import compiled_eigenvalue_slopes, kernels
from gbid.control.tuning.search.loop_family import Derivatives
from gbid.control.tuning.search.spectrum import Eigensystem


class NearbyEigenvalues:
    """Eigenvalues of m loops at several designs that lie near the first one.

    Where kernels are compiled, eigenvectors of the first design are the start of an inverse iteration for those of the
    others: a solution takes a tenth of the time of all eigenvalues.

    Parameters
    ----------
    loops : Derivatives
        The m loops at the first design, then those at the second one, and so on.
    m : int
        Number of loops.
    """

    def __init__(self, loops: Derivatives, m: int) -> None:
        self._loops, self._m, self._library = loops, m, kernels()
        self._system = Eigensystem.of(loops.A if self._library is None else loops.A[:m])

    def slopes(self, which: npt.NDArray[np.intp], places: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the eigenvalues (k,) nearest to known ones, and their gradients (k, d).

        Parameters
        ----------
        which : (n, q) array
            Loop of each of n eigenvalues in each of q designs.
        places : (n,) array
            Where they are at the first design.
        """
        system, flat = self._system, which.ravel()
        if self._library is None:
            at = np.abs(system.values[which] - places[:, None, None]).argmin(axis=2).ravel()
            return system.values[flat, at], system.slopes(flat, at, self._loops.dA)
        first = flat % self._m
        at = np.abs(system.values[first] - np.repeat(places, which.shape[1])[:, None]).argmin(axis=1)
        known = system.values[first, at], system.right[first, :, at], system.left[first, at]
        return compiled_eigenvalue_slopes(self._library, self._loops.A, self._loops.dA, flat, known)
