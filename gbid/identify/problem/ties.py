"""Ties: parameters of a structure that are linear in unknowns shared by all recordings, as those of surfaces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.kernel.general_predictor import GeneralPredictor
from gbid.structure import Parameter


@dataclass(frozen=True, eq=False)
class Ties:
    """In piece i the parameters `names` have the values ``maps[i] @ shared + lift @ own``; a record has some pieces.

    Attributes
    ----------
    names : tuple of str
        Parameters of the structure.
    shared : tuple of Parameter
        The unknowns in their place.
    maps : (n_pieces, n_names, n_shared) array
    own : tuple of Parameter
        Further unknowns, which each record has for itself; there may be none.
    lift : (n_names, n_own) array
    edges : tuple of tuple of int
        For each record the first samples of its pieces after the first one; empty when every record is one piece.
    """

    names: tuple[str, ...]
    shared: tuple[Parameter, ...]
    maps: FloatArray
    own: tuple[Parameter, ...]
    lift: FloatArray
    edges: tuple[tuple[int, ...], ...] = ()

    def pieces(self, record: int) -> tuple[int, tuple[int, ...]]:
        """Return the number of the first piece of a record, and the first samples of its other pieces."""
        if not self.edges:
            return record, ()
        return sum(len(own) + 1 for own in self.edges[:record]), self.edges[record]

    def own_names(self, record: str) -> dict[str, str]:
        """Return the full names of the own unknowns of a record."""
        return {q.name: f"{q.name}[{record}]" for q in self.own}


def tie_of(
    predictor: GeneralPredictor, names: Mapping[str, str], position: Mapping[str, int], ties: Ties, piece: int
) -> tuple[tuple[int, ...], FloatArray]:
    """Unknowns that one piece of a record sees, and the matrix from them to its predictor's parameters.

    Parameters
    ----------
    predictor : GeneralPredictor
    names : dict of str to str
        Full names of its parameters that are not tied, and of what it has for itself.
    position : dict of str to int
        Place of each unknown by full name.
    ties : Ties
    piece : int
        Its number, over all records.

    Returns
    -------
    tuple of int
    (n_own, n_unknowns) array
    """
    own = [q.name for q in predictor.free if q.name in names]
    index = [position[q.name] for q in ties.shared] + [position[names[name]] for name in own]
    index += [position[names[q.name]] for q in ties.own]
    tie = np.zeros((len(predictor.free), len(index)))
    n_shared, n_lift = len(ties.shared), len(ties.own)
    for row, q in enumerate(predictor.free):
        if q.name in names:
            tie[row, n_shared + own.index(q.name)] = 1.0
        else:
            at = ties.names.index(q.name)
            tie[row, :n_shared] = ties.maps[piece][at]
            tie[row, len(index) - n_lift :] = ties.lift[at]
    return tuple(index), tie
