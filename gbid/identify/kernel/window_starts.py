"""States at the starts of shooting windows for the start values of a nonlinear structure."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import NoValueAtStartError
from gbid.identify.kernel.blocks import Blocks
from gbid.identify.kernel.nonlinear import NonlinearKernel
from gbid.identify.kernel.sample import NonlinearPredictor, NonlinearValues
from gbid.identify.kernel.sums import Sweep

_ROUNDS = 8
_DAMPED = 1e-3  # first damping, as a part of the curvature
_SETTLED = 1e-3  # relative fall of all squares at which the search ends


def window_starts(
    predictor: NonlinearPredictor,
    kernel: NonlinearKernel,
    v: NonlinearValues,
    blocks: Blocks,
    weight: FloatArray,
    first: FloatArray,
) -> tuple[FloatArray, Sweep]:
    """Return the least-squares state at the start of each window, and the sums of the pass from these states.

    Each window is a small least-squares problem of its own. Levenberg's and Marquardt's method solves all of them at
    once.

    Parameters
    ----------
    predictor, kernel, v, blocks
        Predictor of a part, its kernel, its values, and its samples.
    weight : (n_y, n_y) array
        Weight of the errors.
    first : (n_windows, n) array
        A first guess; zero and the states that fit the first outputs are tried as well.

    Raises
    ------
    NoValueAtStartError
        When dynamics or output have no finite value at the start.
    """

    def squares(starts: FloatArray) -> FloatArray:
        by_block = np.tensordot(kernel.products(v, blocks, starts), weight, 2)
        total = np.add.reduceat(by_block[: blocks.n_blocks], blocks.window_first)
        return np.where(np.isfinite(total), total, np.inf)

    guess = _from_outputs(predictor, v, blocks)
    starts, least = _best([first, guess, np.zeros_like(first)], squares)
    if not np.isfinite(least).any():
        _check_finite(predictor, v, blocks, guess)
    damping = np.full(len(starts), _DAMPED)
    for _ in range(_ROUNDS):
        sums = kernel.sweep(v, blocks, starts, weight)
        H, g = sums.hessian_start, sums.gradient_start
        usable = np.array(np.isfinite(H).all(axis=(1, 2)) & np.isfinite(g).all(axis=1), bool)
        H, g = np.where(usable[:, None, None], H, np.eye(H.shape[1])), np.where(usable[:, None], g, 0.0)
        diagonal = np.diagonal(H, axis1=1, axis2=2)
        ridge = damping[:, None] * (diagonal + 1e-9 * diagonal.sum(axis=1, keepdims=True)) + np.finfo(float).tiny
        candidates = starts - np.linalg.solve(H + ridge[:, :, None] * np.eye(H.shape[1]), g[:, :, None])[:, :, 0]
        reached = squares(candidates)
        better = np.array(reached < least, bool)
        fell = better & np.isfinite(least)
        fall = float(np.sum(least[fell] - reached[fell]))
        starts = np.where(better[:, None], candidates, starts)
        damping = np.where(better, damping / 10, damping * 10)
        least = np.minimum(least, reached)
        if fall <= _SETTLED * float(least[np.isfinite(least)].sum()) and better.mean() > 0.5:
            break
    return starts, kernel.sweep(v, blocks, starts, weight)


def _best(candidates: list[FloatArray], squares: Callable[[FloatArray], FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return for each window the candidate with the smallest squares, and these."""
    costs = np.array([squares(each) for each in candidates])
    chosen = costs.argmin(axis=0)
    every = np.arange(len(chosen))
    return np.stack(candidates)[chosen, every], costs[chosen, every]


def _from_outputs(predictor: NonlinearPredictor, v: NonlinearValues, blocks: Blocks) -> FloatArray:
    """Return the smallest states with the outputs of the first sample of each window, to first order at zero."""
    n, n_y = predictor.n_states, predictor.n_outputs
    at = blocks.window_first
    z = blocks.z(v.shift)[at // blocks.lanes, 0, :, at % blocks.lanes]
    y = blocks.y[at // blocks.lanes, 0, :, at % blocks.lanes]
    function = predictor.functions.output_jacobian.map("starts", "serial", len(at), [2, 3], [], {})
    results = function(np.zeros((n, len(at))), z.T, v.theta, v.known)
    yhat, slopes = (np.asarray(ca.densify(results[i]), float) for i in (1, 4))
    slopes = slopes.reshape(n_y, len(at), n).transpose(1, 0, 2)
    if not (np.isfinite(slopes).all() and np.isfinite(yhat).all()):
        return np.zeros((len(at), n))
    return np.asarray((np.linalg.pinv(slopes) @ (y - yhat.T)[:, :, None])[:, :, 0])


def _check_finite(predictor: NonlinearPredictor, v: NonlinearValues, blocks: Blocks, guess: FloatArray) -> None:
    """Refuse equations without a finite value at the first sample."""
    first = blocks.window_first[0]
    z = blocks.z(v.shift)[first // blocks.lanes, 0, :, first % blocks.lanes]
    for x in (guess[0], np.zeros(predictor.n_states)):
        xe, yhat, e = predictor.functions.output(x, z, v.theta, v.known)
        after = predictor.functions.step(xe, z, e, v.theta, v.known, 0.0, 1.0 / v.steps)
        values = np.concatenate([np.asarray(yhat, float).ravel(), np.asarray(after, float).ravel()])
        if np.isfinite(values).all():
            return
    names = [*(f"output {i}" for i in range(predictor.n_outputs)), *(f"state {i}" for i in range(predictor.n_states))]
    wrong = ", ".join(name for name, value in zip(names, values, strict=True) if not np.isfinite(value))
    raise NoValueAtStartError(
        f"at the start values the equations have no finite value ({wrong}, at x = {guess[0].round(6).tolist()} and the "
        "first sample); give other start values, or write the equations so that they are finite there"
    )
