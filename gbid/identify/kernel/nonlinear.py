"""Kernels of nonlinear predictors: blocks run side by side, linked by their separate transitions."""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from gbid.core.arrays import BoolArray, FloatArray
from gbid.core.errors import NoValueAtStartError
from gbid.identify.kernel.blocks import Blocks, Prediction
from gbid.identify.kernel.portable import PortablePasses
from gbid.identify.kernel.sample import NonlinearValues, SampleFunctions
from gbid.identify.kernel.sums import SampleKernel, Sweep, growth_along
from gbid.identify.predictor import PredictorValues

# Search of the states at the starts of windows.
_ROUNDS = 8
_DAMPED = 1e-3  # first damping, as a part of the curvature
_SETTLED = 1e-3  # relative fall of all squares at which the search ends

_DIFFERENCE = 1e-5  # relative step of a central difference, for the predictor of small deviations


class NonlinearKernel(SampleKernel):
    """Base of the kernels of nonlinear predictors; a `Kernel`.

    A block begins where the model passes by, so that windows of several blocks are exact as well. One sample is that
    of CasADi's map; passes over the blocks are abstract.

    Parameters
    ----------
    functions : SampleFunctions
        Functions of a sample.
    """

    def __init__(self, functions: SampleFunctions) -> None:
        self._functions = functions
        self._mapped = lru_cache(maxsize=32)(lambda name, width: Mapped(getattr(functions, name), width))

    def growth(
        self,
        v: NonlinearValues,  # noqa: ARG002
        blocks: Blocks,
        sweep: Sweep | None,
        state_scale: FloatArray,
    ) -> float:
        """Return the largest growth of a small deviation along a segment's trajectory; see `Kernel`."""
        if sweep is None:
            return np.nan
        by_start = sweep.end_start / state_scale[:, None] * state_scale
        window = blocks.length * blocks.per_window
        pieces = np.split(by_start, blocks.segment_first[1:])
        return max(growth_along(piece, window * len(piece)) for piece in pieces)

    def feedback(self, v: NonlinearValues, blocks: Blocks, prediction: Prediction) -> PredictorValues:
        """Return the predictor linearised at the mean state and the mean regressors; see `Kernel`.

        For a linear structure it is the predictor itself. Its regressors are the measured outputs alone.
        """
        n_y = blocks.y.shape[2]
        live = np.arange(blocks.length)[None, :, None] < blocks.size.reshape(-1, 1, blocks.lanes)
        every = blocks.z(v.shift)
        x, z, size = _mean(prediction.states, live), _mean(every, live), np.sqrt(_mean(every**2, live)[-n_y:])
        size = np.where(size > 0, size, 1.0)

        def one_sample(at: NonlinearValues, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            """Return the state after a sample, and derivatives of state and outputs with respect to the state."""
            slopes = np.concatenate([np.zeros((len(x), v.n_parameters)), np.eye(len(x))], axis=1)
            after, slopes, _, psi = self.with_slopes(at, x[None], z[None], slopes[None])
            return after[0], slopes[0][:, v.n_parameters :], psi[0][:, v.n_parameters :]

        def matrices(theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            at, sides = v._replace(theta=theta), []
            for j in range(n_y):
                change = np.zeros(len(z))
                change[len(z) - n_y + j] = step = _DIFFERENCE * size[j]
                sides.append((one_sample(at, z + change)[0] - one_sample(at, z - change)[0]) / (2 * step))
            F, C = one_sample(at, z)[1:]
            return F, np.stack(sides, axis=1), C

        slopes = []
        for i, value in enumerate(v.theta):
            change = np.zeros(len(v.theta))
            change[i] = step = _DIFFERENCE * (abs(value) if value else 1.0)
            sides = zip(matrices(v.theta + change), matrices(v.theta - change), strict=True)
            slopes.append([(above - below) / (2 * step) for above, below in sides])
        dF, dG, dC = (np.array(each) for each in zip(*slopes, strict=True))
        none = np.zeros((n_y, n_y))
        return PredictorValues(*matrices(v.theta), none, dF, dG, dC, np.zeros((len(v.theta), n_y, n_y)), ())

    def onwards(self, v: NonlinearValues, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the next states and the outputs; see `SampleKernel`."""
        passed, yhat, _ = self._through(v, x, z)
        return passed[-1][:, 0], yhat[:, 0]

    def _through(
        self, v: NonlinearValues, x: FloatArray, z: FloatArray
    ) -> tuple[list[FloatArray], FloatArray, FloatArray]:
        """Return states before and after each integrator step, the outputs, and the prediction errors."""
        output, step = self._mapped("output", len(x)), self._mapped("step", len(x))
        at, yhat, e = (r.copy() for r in output(x[:, None], z[:, None], v.theta, v.known))
        passed = [at]
        for s in range(v.steps):
            passed.append(step(passed[-1], z[:, None], e, v.theta, v.known, s / v.steps, 1 / v.steps)[0].copy())
        return passed, yhat, e

    def with_slopes(
        self, v: NonlinearValues, x: FloatArray, z: FloatArray, slopes: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return states and outputs with their derivatives; see `SampleKernel`."""
        n_p, z, fixed = v.n_parameters, z[:, None], (v.theta, v.known)
        output, step = self._mapped("output_jacobian", len(x)), self._mapped("step_jacobian", len(x))
        at, yhat, e, *jacobians = (r.copy() for r in output(x[:, None], z, *fixed))
        by_start, by_state, by_theta = (each.transpose(0, 2, 1) for each in jacobians)
        S = slopes.copy()
        S[:, :, :n_p] += by_start
        psi = by_state @ S
        psi[:, :, :n_p] += by_theta
        for s in range(v.steps):
            at, *jacobians = (r.copy() for r in step(at, z, e, *fixed, s / v.steps, 1 / v.steps))
            F, G = (each.transpose(0, 2, 1) for each in jacobians)
            by_e, onto = np.split(G, [G.shape[2] - n_p], axis=2)
            S = F @ S - by_e @ psi if by_e.shape[2] else F @ S
            S[:, :, :n_p] += onto
        return at[:, 0], S, yhat[:, 0], psi

    def window_starts(self, v: NonlinearValues, blocks: Blocks, weight: FloatArray, first: FloatArray) -> FloatArray:
        """Return the least-squares estimate of the state at the start of each window, (n_windows, n).

        Each window is a small least-squares problem of its own. Levenberg's and Marquardt's method solves all of them
        at once.

        Parameters
        ----------
        v : NonlinearValues
            Predictor.
        blocks : Blocks
            Samples.
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
            by_block = np.tensordot(self.products(v, blocks, starts), weight, 2)
            total = np.add.reduceat(by_block[: blocks.n_blocks], blocks.window_first)
            return np.where(np.isfinite(total), total, np.inf)

        guess = self._from_outputs(v, blocks)
        candidates = np.stack([first, guess, np.zeros_like(first)])
        costs, every = np.array([squares(each) for each in candidates]), np.arange(len(first))
        nearest = costs.argmin(axis=0)
        starts, least = candidates[nearest, every], costs[nearest, every]
        if not np.isfinite(least).any():
            self._check_finite(v, blocks, guess)
        damping = np.full(len(starts), _DAMPED)
        for _ in range(_ROUNDS):
            sums = self.sweep(v, blocks, starts, weight)
            H, g = sums.hessian_start, sums.gradient_start
            usable = np.array(np.isfinite(H).all(axis=(1, 2)) & np.isfinite(g).all(axis=1), bool)
            H, g = np.where(usable[:, None, None], H, np.eye(H.shape[1])), np.where(usable[:, None], g, 0.0)
            diagonal = np.diagonal(H, axis1=1, axis2=2)
            ridge = damping[:, None] * (diagonal + 1e-9 * diagonal.sum(axis=1, keepdims=True)) + np.finfo(float).tiny
            updated = starts - np.linalg.solve(H + ridge[:, :, None] * np.eye(H.shape[1]), g[:, :, None])[:, :, 0]
            reached = squares(updated)
            better = np.array(reached < least, bool)
            fell = better & np.isfinite(least)
            fall = float(np.sum(least[fell] - reached[fell]))
            starts = np.where(better[:, None], updated, starts)
            damping = np.where(better, damping / 10, damping * 10)
            least = np.minimum(least, reached)
            if fall <= _SETTLED * float(least[np.isfinite(least)].sum()) and better.mean() > 0.5:
                break
        return np.asarray(starts)

    def _from_outputs(self, v: NonlinearValues, blocks: Blocks) -> FloatArray:
        """Return minimum-norm states that give the first outputs of each window, linearised at zero."""
        n, n_y = blocks.predictor.n_states, blocks.predictor.n_outputs
        group, lane = np.divmod(blocks.window_first, blocks.lanes)
        z, y = blocks.z(v.shift)[group, 0, :, lane], blocks.y[group, 0, :, lane]
        function = self._functions.output_jacobian.map("starts", "serial", len(z), [2, 3], [], {})
        results = function(np.zeros((n, len(z))), z.T, v.theta, v.known)
        yhat, slopes = (np.asarray(ca.densify(results[i]), float) for i in (1, 4))
        slopes = slopes.reshape(n_y, len(z), n).transpose(1, 0, 2)
        if not (np.isfinite(slopes).all() and np.isfinite(yhat).all()):
            return np.zeros((len(z), n))
        return np.asarray((np.linalg.pinv(slopes) @ (y - yhat.T)[:, :, None])[:, :, 0])

    def _check_finite(self, v: NonlinearValues, blocks: Blocks, guess: FloatArray) -> None:
        """Refuse equations without a finite value at the first sample."""
        group, lane = divmod(int(blocks.window_first[0]), blocks.lanes)
        z, n_y = blocks.z(v.shift)[group, 0, :, lane], blocks.predictor.n_outputs
        for x in (guess[0], np.zeros_like(guess[0])):
            xe, yhat, e = self._functions.output(x, z, v.theta, v.known)
            after = self._functions.step(xe, z, e, v.theta, v.known, 0.0, 1.0 / v.steps)
            values = np.concatenate([np.asarray(yhat, float).ravel(), np.asarray(after, float).ravel()])
            if np.isfinite(values).all():
                return
        wrong = (f"output {i}" if i < n_y else f"state {i - n_y}" for i in np.flatnonzero(~np.isfinite(values)))
        raise NoValueAtStartError(
            f"at the start values the equations have no finite value ({', '.join(wrong)}, at x = "
            f"{guess[0].round(6).tolist()} and the first sample); give other start values, or write the equations so "
            "that they are finite there"
        )


class MappedKernel(NonlinearKernel, PortablePasses):
    """Kernel of a nonlinear predictor by CasADi's map, for machines without a C compiler; a `Kernel`."""


class Mapped:
    """CasADi function evaluated for many columns at once, without copies.

    Parameters
    ----------
    function : casadi.Function
        Function with dense arguments.
    width : int
        Number of columns.
    """

    def __init__(self, function: ca.Function, width: int) -> None:
        given = function.sx_in()
        dense = ca.Function(function.name(), given, [ca.densify(each) for each in function.call(given)])
        mapped = dense.map(width, "serial")
        self._arguments = [np.zeros((width, *reversed(function.size_in(i)))) for i in range(function.n_in())]
        self._results = [np.zeros((width, *reversed(function.size_out(i)))) for i in range(function.n_out())]
        self._buffer, self._run = mapped.buffer()
        for i, array in enumerate(self._arguments):
            self._buffer.set_arg(i, memoryview(array))  # type: ignore[call-arg, arg-type]  # its stubs are those of C++
        for i, array in enumerate(self._results):
            self._buffer.set_res(i, memoryview(array))  # type: ignore[call-arg, arg-type]  # as above

    def __call__(self, *arguments: FloatArray | float) -> list[FloatArray]:
        """Return results (width, columns, rows) for arguments of this layout, or of one value for all columns."""
        for array, value in zip(self._arguments, arguments, strict=True):
            array[:] = value
        self._run()
        return self._results


def _mean(values: FloatArray, live: BoolArray) -> FloatArray:
    """Return the mean over the samples of all blocks of values (n_groups, length, n, lanes), (n,)."""
    return np.asarray(np.where(live[:, :, None], values, 0.0).sum(axis=(0, 1, 3)) / live.sum())
