"""Results of a pass over the samples, and the protocol of its engine."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.kernel.blocks import Blocks
from gbid.identify.predictor import PredictorValues


class BlockSums(NamedTuple):
    """Results of a pass: sums over all blocks, then values of each of the W blocks, with padding.

    Attributes
    ----------
    hessian : (n_p, n_p) array
        Gauss-Newton Hessian by the parameters.
    products : (n_y, n_y) array
        Sum of the products of errors.
    gradient : (W, n_p) array
        Gradient by the parameters.
    gradient_start : (W, n) array
        Gradient by the start state of each block.
    mixed : (W, n_p, n) array
        Gauss-Newton Hessian by parameters and start state.
    end : (W, n) array
        State at the end of each block.
    end_theta : (W, n, n_p) array
        Derivative of this state by the parameters.
    """

    hessian: FloatArray
    products: FloatArray
    gradient: FloatArray
    gradient_start: FloatArray
    mixed: FloatArray
    end: FloatArray
    end_theta: FloatArray


class Prediction(NamedTuple):
    """States and errors of all blocks.

    Attributes
    ----------
    states : (n_groups, length, n, lanes) array
    errors : (n_groups, length, n_y, lanes) array
        ``y - yhat``, zero where samples do not count.
    end : (n, W) array
        State after the whole length of each block, padding included.
    """

    states: FloatArray
    errors: FloatArray
    end: FloatArray

    @property
    def products(self) -> FloatArray:
        """Products ``sum e e'`` of the errors of each block, (W, n_y, n_y)."""
        e = self.errors.transpose(0, 3, 2, 1)
        return np.asarray(e @ e.swapaxes(2, 3)).reshape(-1, e.shape[2], e.shape[2])


class Adjoint(NamedTuple):
    """Adjoint of a cost, backwards over all blocks.

    Attributes
    ----------
    start : (n, W) array
        The adjoint at the start of each block.
    sums : (n + n_y, n + n_z) array
        Derivative of the cost by the entries of ``[F G; C H]``.
    factors : (n_groups, length, n + n_y, lanes) array
        For each sample ``a[k+1]`` and then ``-w[k]``: `sums` are their products with states and regressors.
    """

    start: FloatArray
    sums: FloatArray
    factors: FloatArray


class Second(NamedTuple):
    """Results of the second pass over the samples, each block from a start that does not depend on the parameters.

    Attributes
    ----------
    products : (n + n_y, n_p, n) array
        Sums over all samples of the factors of the adjoint times the sensitivities of the state by the parameters.
    end_theta : (W, n, n_p) array
        These sensitivities after the whole length of each block, padding included.
    """

    products: FloatArray
    end_theta: FloatArray


class PassEngine(Protocol):
    """Engine: it runs the recursion over all blocks."""

    def __call__(
        self, v: PredictorValues, blocks: Blocks, starts: FloatArray, root: FloatArray, free: FloatArray
    ) -> BlockSums:
        """Run it.

        Parameters
        ----------
        v : PredictorValues
        blocks : Blocks
        starts : (W, n) array
            Start state of each block, padding included.
        root : (n_y, n_y) array
            Upper triangular, ``root' root`` the weight.
        free : (length, n_y, n) array
            Weighted response to the start, ``root C F^k``.
        """
        ...

    def predict(self, v: PredictorValues, blocks: Blocks, starts: FloatArray) -> Prediction:
        """Return states and errors from starts (n, W), without sensitivities."""
        ...

    def products(self, v: PredictorValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the products ``sum e e'`` of the errors of each block, (W, n_y, n_y), from starts (n, W)."""
        ...

    def adjoint(
        self, v: PredictorValues, blocks: Blocks, weighted: FloatArray, states: FloatArray, last: FloatArray
    ) -> Adjoint:
        """Run the adjoint backwards: ``a[k] = F' a[k+1] - C' w[k]``.

        Parameters
        ----------
        v : PredictorValues
        blocks : Blocks
        weighted : (n_groups, length, n_y, lanes) array
            Weighted errors ``w``.
        states : (n_groups, length, n, lanes) array
        last : (n, W) array
            The adjoint at the end of each block.
        """
        ...

    def second(self, v: PredictorValues, blocks: Blocks, states: FloatArray, factors: FloatArray) -> Second:
        """Run the sensitivities of the states, and sum their products with the factors of the adjoint.

        Parameters
        ----------
        v : PredictorValues
        blocks : Blocks
        states : (n_groups, length, n, lanes) array
        factors : (n_groups, length, n + n_y, lanes) array
            From `adjoint`.
        """
        ...

    def sensitivities(
        self, v: PredictorValues, blocks: Blocks, prediction: Prediction, first: FloatArray, own: slice
    ) -> FloatArray:
        """Return derivatives of the predictions by the parameters and the start of the window, for some blocks.

        Parameters
        ----------
        v : PredictorValues
        blocks : Blocks
        prediction : Prediction
            States from the starts of the blocks.
        first : (n_blocks, n, n_p + n) array
            Derivatives of the starts of these blocks.
        own : slice
            The blocks.

        Returns
        -------
        (n_y * (n_p + n), n_blocks, length) array
            Zero where samples do not count.
        """
        ...
