"""Kernel of nonlinear predictors: blocks run side by side, and are linked by their own transitions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gbid.core.arrays import BoolArray, FloatArray
from gbid.identify.kernel.blocks import Blocks, Prediction, at_windows
from gbid.identify.kernel.portable import MappedSteps, SampleRunner, sample_sensitivities
from gbid.identify.kernel.sample import NonlinearValues
from gbid.identify.kernel.sums import Kernel, Linked, Moved, Sweep, Traced, growth_along, joined
from gbid.identify.predictor import PredictorValues


@dataclass(frozen=True, eq=False)
class NonlinearKernel(Kernel):
    """Kernel of a nonlinear predictor; a `Kernel`.

    A block begins where the model passes by, so that windows of several blocks are exact as well.

    Attributes
    ----------
    run : SampleRunner
        Runner of the recursion.
    steps : MappedSteps
        Steps of a sample, for the predictor of small deviations.
    """

    run: SampleRunner
    steps: MappedSteps

    def trace(
        self, v: NonlinearValues, blocks: Blocks, starts: FloatArray, weights: Sequence[FloatArray]
    ) -> list[Traced]:
        """Return the sums of each block for each weight; see `Kernel`."""
        begin, passes = self.begin(v, blocks, starts), []
        for weight in weights:
            root = np.ascontiguousarray(np.linalg.cholesky(weight).T)
            by_block, start_hessian, end_start = self.run.sums(v, blocks, begin, root)
            linked = linked_along(blocks, by_block.end_theta, end_start)
            passes.append(Traced(begin, joined(blocks, by_block, start_hessian, linked), linked, by_block))
        return passes

    def begin(self, v: NonlinearValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the state at the start of each block; see `Kernel`."""
        if blocks.per_window > 1:
            return self.run.begin(v, blocks, starts)
        return at_windows(blocks, starts)

    def passed(self, v: NonlinearValues, blocks: Blocks, begin: FloatArray) -> Prediction:
        """Return states and errors from the starts of blocks; see `Kernel`."""
        return self.run.passed(v, blocks, begin)

    def products(self, v: NonlinearValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the products of the errors of each block; see `Kernel`."""
        return self.run.products(v, blocks, self.begin(v, blocks, starts))

    def gradient(
        self, v: NonlinearValues, blocks: Blocks, starts: FloatArray, ends: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the gradient by the adjoint of each step; see `Kernel`."""
        prediction = self.predict(v, blocks, starts)
        weighted = weight @ prediction.errors * blocks.used[:, :, None]
        return self.run.adjoint(v, blocks, prediction, weighted, ends)

    def left_out(
        self,
        v: NonlinearValues,
        blocks: Blocks,
        starts: FloatArray,
        ends: FloatArray,
        weight: FloatArray,
        moved: Sequence[Moved],
    ) -> tuple[FloatArray, FloatArray]:
        """Return the second-order term by differences of the gradient; see `Kernel`."""
        gauss_newton = self.sweep(v, blocks, starts, weight)
        theta, mixed = np.zeros_like(gauss_newton.hessian), np.zeros_like(gauss_newton.hessian_mixed)
        here = self.gradient(v, blocks, starts, ends, weight)
        for j, step, at in moved:
            after = self.gradient(at, blocks, starts, ends, weight)
            theta[:, j] = (after[0] - here[0]) / step - gauss_newton.hessian[:, j]
            mixed[:, j] = (after[1] - here[1]) / step - gauss_newton.hessian_mixed[:, j]
        return theta, mixed

    def growth(
        self,
        v: NonlinearValues,  # noqa: ARG002
        blocks: Blocks,
        sweep: Sweep | None,
        state_scale: FloatArray,
    ) -> float:
        """Return the largest growth along the trajectory of a segment; see `Kernel`."""
        if sweep is None:
            return np.inf
        by_start = sweep.end_start / state_scale[:, None] * state_scale
        window = blocks.length * blocks.per_window
        pieces = np.split(by_start, blocks.segment_first[1:])
        return max(growth_along(piece, window * len(piece)) for piece in pieces)

    def feedback(self, v: NonlinearValues, blocks: Blocks, prediction: Prediction) -> PredictorValues:
        """Return the predictor of small deviations from the mean of the trajectory; see `Kernel`."""
        return mean_predictor(self.steps, v, blocks, prediction)

    def sensitivities(
        self, v: NonlinearValues, blocks: Blocks, prediction: Prediction, linked: Linked, some: slice
    ) -> FloatArray:
        """Return the sensitivities of some blocks; see `Kernel`."""
        return sample_sensitivities(self.run, v, blocks, prediction, linked, some)


def linked_along(blocks: Blocks, end_theta: FloatArray, end_start: FloatArray) -> Linked:
    """Return the sensitivities of the starts of blocks, each of which has its own transition.

    Parameters
    ----------
    blocks : Blocks
        The blocks.
    end_theta : (W, n, n_p) array
        Derivatives of the end of each block by the parameters.
    end_start : (W, n, n) array
        By its start.
    """
    n, n_p = end_theta.shape[1:]
    if blocks.per_window == 1:
        own = slice(blocks.n_windows)
        by_start = np.zeros((len(end_theta), n, n))
        by_start[own] = np.eye(n)
        return Linked(np.zeros_like(end_theta), by_start, end_theta[own], end_start[own])
    both = np.zeros((len(end_theta), n, n_p + n))
    both[blocks.window_first, :, n_p:] = np.eye(n)
    ends = np.zeros((blocks.n_windows, n, n_p + n))
    for i in range(blocks.per_window):
        live = np.flatnonzero(blocks.window_size > i)
        at = blocks.window_first[live] + i
        ends[live] = end_start[at] @ both[at]
        ends[live, :, :n_p] += end_theta[at]
        more = blocks.window_size[live] > i + 1
        both[at[more] + 1] = ends[live[more]]
    return Linked(both[:, :, :n_p], both[:, :, n_p:], ends[:, :, :n_p], ends[:, :, n_p:])


# ---- Linear predictor at the mean of a trajectory, for what the feedback of errors adds to the uncertainty.

_DIFFERENCE = 1e-5  # relative step of a central difference


def mean_predictor(steps: MappedSteps, v: NonlinearValues, blocks: Blocks, prediction: Prediction) -> PredictorValues:
    """Return the predictor of small deviations from the mean state and the mean regressors.

    For a linear structure it is the predictor itself. Its regressors are the measured outputs alone.

    Parameters
    ----------
    steps : MappedSteps
        Steps of a sample.
    v : NonlinearValues
        Predictor at the estimate.
    blocks : Blocks
        Samples.
    prediction : Prediction
        States and errors.
    """
    n_y = blocks.y.shape[2]
    live = np.arange(blocks.length)[None, :, None] < blocks.size.reshape(-1, 1, blocks.lanes)
    x, z, size = (
        _mean(prediction.states, live),
        _mean(blocks.z(v.shift), live),
        np.sqrt(_mean(blocks.z(v.shift) ** 2, live)[-n_y:]),
    )
    size = np.where(size > 0, size, 1.0)

    def at(theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        at_theta = v._replace(theta=theta)
        F, C = _one_sample(steps, at_theta, x, z)[1:]
        sides = []
        for j in range(n_y):
            change = np.zeros(len(z))
            change[len(z) - n_y + j] = step = _DIFFERENCE * size[j]
            above, below = (_one_sample(steps, at_theta, x, side)[0] for side in (z + change, z - change))
            sides.append((above - below) / (2 * step))
        return F, np.stack(sides, axis=1), C

    F, G, C = at(v.theta)
    slopes = []
    for i, value in enumerate(v.theta):
        change = np.zeros(len(v.theta))
        change[i] = step = _DIFFERENCE * (abs(value) if value else 1.0)
        slopes.append([(a - b) / (2 * step) for a, b in zip(at(v.theta + change), at(v.theta - change), strict=True)])
    dF, dG, dC = (np.array([slope[i] for slope in slopes]) for i in range(3))
    none = np.zeros((n_y, n_y))
    return PredictorValues(F, G, C, none, dF, dG, dC, np.zeros((len(v.theta), n_y, n_y)), ())


def _mean(values: FloatArray, live: BoolArray) -> FloatArray:
    """Return the mean of values (n_groups, length, n, lanes) over the samples of all blocks, (n,)."""
    return np.asarray(np.where(live[:, :, None], values, 0.0).sum(axis=(0, 1, 3)) / live.sum())


def _one_sample(
    steps: MappedSteps, v: NonlinearValues, x: FloatArray, z: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the state after a sample, and the derivatives of state and outputs by the state before."""
    slopes = np.concatenate([np.zeros((len(x), v.n_parameters)), np.eye(len(x))], axis=1)
    after, slopes, _, psi = steps.with_slopes(v, x[None], z[None], slopes[None])
    return after[0], slopes[0][:, v.n_parameters :], psi[0][:, v.n_parameters :]
