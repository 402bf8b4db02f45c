"""Measures: quantities of every loop that a design limits or minimises."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gbid.arrays import ComplexArray, FloatArray
from gbid.control.tuning.search.loop_family import Derivatives, LoopFamily, Loops
from gbid.control.tuning.search.spectrum import Eigensystem


@dataclass(frozen=True, eq=False)
class LoopState:
    """Loops of a family for given gains.

    Attributes
    ----------
    family : LoopFamily
        The loops.
    gains : (d,) array
        The gains.
    loops : Loops or Derivatives
        Matrices; with derivatives where slopes are wanted.
    system : Eigensystem
        Eigenvalues and eigenvectors.
    steps : (d,) array
        Changes of each gain for differences, towards the inside of the bounds.
    """

    family: LoopFamily
    gains: FloatArray
    loops: Loops
    system: Eigensystem
    steps: FloatArray

    @property
    def derivatives(self) -> Derivatives:
        """Matrices with their derivatives."""
        assert isinstance(self.loops, Derivatives)
        return self.loops


class Pieces(NamedTuple):
    """Smooth pieces of a measure: loop (k,), excess (k,), its gradient (k, d), place in the complex plane (k,)."""

    loop: npt.NDArray[np.intp]
    excess: FloatArray
    slope: FloatArray
    place: ComplexArray


class Measure(ABC):
    """Quantity of each loop. Its excess is at most 0 where it is within its limit, and larger is worse."""

    name: str

    @abstractmethod
    def excess(self, state: LoopState) -> FloatArray:
        """Return the excess of each loop (m,)."""

    @abstractmethod
    def pieces(self, state: LoopState, window: float) -> Pieces:
        """Return the smooth pieces whose excess is above ``-window``, with gradients."""


@dataclass(frozen=True)
class ExtraLimit(Measure):
    """Measure ``log(function(family, gains) / limit)`` of every loop, with gradients by differences.

    Parameters
    ----------
    name : str
        Name of the limit.
    function : callable
        From a family of m loops and gains (d,) to positive numbers (m,).
    limit : float
        Largest allowed number.
    """

    name: str
    function: Callable[[LoopFamily, FloatArray], FloatArray]
    limit: float

    def excess(self, state: LoopState) -> FloatArray:
        """Return the logarithm of the numbers over the limit (m,)."""
        return self._of(state.family, state.gains)

    def pieces(self, state: LoopState, window: float) -> Pieces:
        """Return one piece for each loop near the limit."""
        base = self.excess(state)
        near = np.flatnonzero(base > -window)
        slope = np.zeros((len(base), len(state.gains)))
        for i, step in enumerate(state.steps if len(near) else ()):
            moved = state.gains.copy()
            moved[i] += step
            slope[:, i] = (self._of(state.family, moved) - base) / step
        return Pieces(near, base[near], slope[near], np.zeros(len(near), complex))

    def _of(self, family: LoopFamily, gains: FloatArray) -> FloatArray:
        return np.asarray(np.log(self.function(family, gains) / self.limit))
