"""Protocol of a kernel: what a fit asks of the recursion of a group of records, linear or nonlinear."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

from gbid.arrays import FloatArray
from gbid.identify.kernel.block_sums import BlockSums, Prediction
from gbid.identify.kernel.blocks import Blocks
from gbid.identify.kernel.sweep import Linked, Sweep
from gbid.identify.predictor import PredictorValues


class Traced(NamedTuple):
    """Pass over segments, with what happens within the windows.

    Attributes
    ----------
    begin : (n, W) array
        State at the start of each block.
    sums : Sweep
        Sums over the blocks of each window.
    linked : Linked
        Sensitivities of the starts of the blocks.
    by_block : BlockSums
        Sums of each block.
    """

    begin: FloatArray
    sums: Sweep
    linked: Linked
    by_block: BlockSums


class Moved(NamedTuple):
    """Predictor with one parameter moved.

    Attributes
    ----------
    column : int
        Position of the parameter among those of the predictor.
    step : float
        How far it is moved.
    v : object
        What the ``at`` of the predictor returns there.
    """

    column: int
    step: float
    v: Any


class Kernel(Protocol):
    """Kernel of one kind of predictor. In all methods, `v` is what the ``at`` of the predictor returns.

    `starts` are the states at the starts of the windows, (n_windows, n).
    """

    def sweep(self, v: Any, blocks: Blocks, starts: FloatArray, weight: FloatArray) -> Sweep:
        """Return cost, gradient, Gauss-Newton Hessian and ends of windows of ``sum e' W e / 2``."""
        ...

    def trace(self, v: Any, blocks: Blocks, starts: FloatArray, weights: Sequence[FloatArray]) -> list[Traced]:
        """Return the same with the sums of each block, for each weight."""
        ...

    def begin(self, v: Any, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the state at the start of each block, (n, W)."""
        ...

    def predict(self, v: Any, blocks: Blocks, starts: FloatArray) -> Prediction:
        """Return states and errors, without sensitivities."""
        ...

    def passed(self, v: Any, blocks: Blocks, begin: FloatArray) -> Prediction:
        """Return the same from the state at the start of each block, (n, W)."""
        ...

    def products(self, v: Any, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the products ``sum e e'`` of the errors of each block, (W, n_y, n_y)."""
        ...

    def gradient(
        self, v: Any, blocks: Blocks, starts: FloatArray, ends: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the gradient of ``sum e' W e / 2`` plus the ends of windows times `ends`, (n_windows, n).

        Returns
        -------
        (n_p,) array
            By the own parameters of the predictor.
        (n_windows, n) array
            By the starts of the windows.
        """
        ...

    def left_out(
        self,
        v: Any,
        blocks: Blocks,
        starts: FloatArray,
        ends: FloatArray,
        weight: FloatArray,
        moved: Sequence[Moved],
    ) -> tuple[FloatArray, FloatArray]:
        """Return the second derivatives of the same that Gauss-Newton omits, in the columns of the moved parameters.

        Returns
        -------
        (n_p, n_p) array
            By two of the own parameters of the predictor; zero in other columns.
        (n_windows, n_p, n) array
            By a parameter and the start of a window.
        """
        ...

    def growth(self, v: Any, blocks: Blocks, sweep: Sweep | None, state_scale: FloatArray) -> float:
        """Return the growth of a small deviation in a sample; infinite where the predictor overflows.

        `sweep` is the pass, None where it overflows; a linear predictor needs none. States are of the order of
        `state_scale`.
        """
        ...

    def feedback(self, v: Any, blocks: Blocks, prediction: Prediction) -> PredictorValues:
        """Return a linear predictor whose last regressors are the measured outputs, (n_y)."""
        ...

    def sensitivities(self, v: Any, blocks: Blocks, prediction: Prediction, linked: Linked, own: slice) -> FloatArray:
        """Return sensitivities of the predictions by the parameters and the start of the window, for some blocks.

        Returns
        -------
        (n_y * (n_p + n), n_blocks, length) array
            Zero where samples do not count.
        """
        ...
