"""Invariant subspaces of many loops at one design."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from gbid.arrays import FloatArray
from gbid.control.tuning.search.loop_family import Derivatives, LoopFamily
from gbid.control.tuning.search.measure import LoopState
from gbid.control.tuning.search.nonsmooth.cluster import Cluster, InvariantSubspaces


@dataclass(frozen=True, eq=False)
class LoopSubspaces:
    """Invariant subspaces of the loops at one design; each Schur form is computed once, when it is first needed.

    Parameters
    ----------
    families : tuple of LoopFamily
        The loops.
    x : (d,) array
        The gains.
    least_rate : float
        Smallest unit of distances between eigenvalues [rad/s].
    known : sequence of LoopState, optional
        Loops of the families at this design, where they are known.
    """

    families: tuple[LoopFamily, ...]
    x: FloatArray
    least_rate: float
    known: Sequence[LoopState] = ()
    _loops: dict[int, Derivatives] = field(default_factory=dict, init=False, repr=False)
    _forms: dict[tuple[int, int], InvariantSubspaces] = field(default_factory=dict, init=False, repr=False)

    def cluster(self, family: int, loop: int, place: complex, size: int) -> Cluster | None:
        """Return the eigenvalues of a loop nearest to a place in the complex plane; None when they are not separate."""
        return self._of(family, loop).cluster(place, size, max(abs(place), self.least_rate))

    def _of(self, family: int, loop: int) -> InvariantSubspaces:
        if family not in self._loops:
            known = self.known[family].derivatives if self.known else None
            self._loops[family] = known or self.families[family].derivatives(self.x)
        if (family, loop) not in self._forms:
            loops = self._loops[family]
            self._forms[family, loop] = InvariantSubspaces(loops.A[loop], loops.dA[loop])
        return self._forms[family, loop]
