"""Entries of the predictor's matrices that may differ from zero."""

from __future__ import annotations

from dataclasses import dataclass

from gbid.arrays import BoolArray


@dataclass(frozen=True, eq=False)
class KernelPattern:
    """Pattern of the entries of the predictor's matrices that may differ from zero.

    Attributes
    ----------
    F : (n, n), G : (n, n_z), C : (n_y, n), H : (n_y, n_z) boolean arrays
        Patterns of the matrices.
    dF, dG, dC, dH : boolean arrays
        Patterns of the derivatives, with a first axis of parameters.
    """

    F: BoolArray
    G: BoolArray
    C: BoolArray
    H: BoolArray
    dF: BoolArray
    dG: BoolArray
    dC: BoolArray
    dH: BoolArray

    def covers(self, other: KernelPattern) -> bool:
        """Whether every entry of another pattern is one of this."""
        return all(not (theirs & ~mine).any() for mine, theirs in zip(self.arrays(), other.arrays(), strict=True))

    def union(self, other: KernelPattern) -> KernelPattern:
        """Entries of either."""
        return KernelPattern(*(mine | theirs for mine, theirs in zip(self.arrays(), other.arrays(), strict=True)))

    def arrays(self) -> tuple[BoolArray, ...]:
        """Return the patterns in order."""
        return (self.F, self.G, self.C, self.H, self.dF, self.dG, self.dC, self.dH)

    def live(self, i: int) -> BoolArray:
        """Return which states ever depend on a parameter, when none does at the start, (n,)."""
        return reached(self.F, self.dF[i].any(axis=1) | self.dG[i].any(axis=1))


def reached(F: BoolArray, first: BoolArray) -> BoolArray:
    """Return the pattern of ``F^k first`` for all k: where a recursion that begins with `first` differs from zero."""
    for _ in F:  # a product of more than n factors has no other entries
        first = first | (F @ first)
    return first
