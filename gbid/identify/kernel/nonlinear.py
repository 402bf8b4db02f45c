"""Kernel of nonlinear predictors: blocks run side by side, and are linked by their own transitions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Protocol

import casadi as ca
import numpy as np

from gbid.core.arrays import BoolArray, FloatArray
from gbid.identify.kernel.blocks import Blocks, BlockSums, Prediction
from gbid.identify.kernel.sample import NonlinearValues, SampleFunctions
from gbid.identify.kernel.sums import Linked, Moved, Sweep, Traced, growth_along, joined
from gbid.identify.predictor import PredictorValues

_AT_ONCE = 64  # blocks whose sensitivities are made together


class SampleSums(NamedTuple):
    """Results of a pass with sensitivities.

    Attributes
    ----------
    by_block : BlockSums
        Sums over all blocks and values of each block.
    start_hessian : (W, n, n) array
        Gauss-Newton Hessian by the start of each block.
    end_start : (W, n, n) array
        Derivative of the end of each block by its start.
    """

    by_block: BlockSums
    start_hessian: FloatArray
    end_start: FloatArray


class SampleRunner(Protocol):
    """Runner of the functions of a sample over all blocks."""

    def begin(self, v: NonlinearValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the state at the start of each block, (n, W), from those of the windows, (n_windows, n)."""
        ...

    def passed(self, v: NonlinearValues, blocks: Blocks, begin: FloatArray) -> Prediction:
        """Return states and errors from the starts of the blocks, (n, W)."""
        ...

    def products(self, v: NonlinearValues, blocks: Blocks, begin: FloatArray) -> FloatArray:
        """Return the products ``sum e e'`` of the errors of each block, (W, n_y, n_y)."""
        ...

    def sums(self, v: NonlinearValues, blocks: Blocks, begin: FloatArray, root: FloatArray) -> SampleSums:
        """Return the sums of a pass with sensitivities, for the weight ``root' root``."""
        ...

    def adjoint(
        self, v: NonlinearValues, blocks: Blocks, prediction: Prediction, weighted: FloatArray, ends: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return derivatives by theta (n_p,) and by the starts of windows (n_windows, n), backwards from `ends`."""
        ...

    def sensitivities(
        self, v: NonlinearValues, blocks: Blocks, prediction: Prediction, first: FloatArray, own: slice
    ) -> FloatArray:
        """Return those of some blocks, (length, n_y, m, n_blocks), from those of their starts, (n_blocks, n, m)."""
        ...


@dataclass(frozen=True, eq=False)
class NonlinearKernel:
    """Kernel of a nonlinear predictor; a `Kernel`.

    A block begins where the model passes by, so that windows of several blocks are exact as well.

    Attributes
    ----------
    run : SampleRunner
        Runner of the functions of a sample.
    linear : callable
        Predictor of small deviations from the mean of a trajectory, for `feedback`.
    """

    run: SampleRunner
    linear: Callable[[NonlinearValues, Blocks, Prediction], PredictorValues]

    def sweep(self, v: NonlinearValues, blocks: Blocks, starts: FloatArray, weight: FloatArray) -> Sweep:
        """Return the sums over the samples; see `Kernel`."""
        return self.trace(v, blocks, starts, [weight])[0].sums

    def trace(
        self, v: NonlinearValues, blocks: Blocks, starts: FloatArray, weights: Sequence[FloatArray]
    ) -> list[Traced]:
        """Return the sums of each block for each weight; see `Kernel`."""
        begin, found = self.begin(v, blocks, starts), []
        for weight in weights:
            root = np.ascontiguousarray(np.linalg.cholesky(weight).T)
            by_block, start_hessian, end_start = self.run.sums(v, blocks, begin, root)
            linked = linked_along(blocks, by_block.end_theta, end_start)
            found.append(Traced(begin, joined(blocks, by_block, start_hessian, linked), linked, by_block))
        return found

    def begin(self, v: NonlinearValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the state at the start of each block; see `Kernel`."""
        if blocks.per_window > 1:
            return self.run.begin(v, blocks, starts)
        begin = np.zeros((starts.shape[1], len(blocks.size)))
        begin[:, : blocks.n_windows] = starts.T
        return begin

    def predict(self, v: NonlinearValues, blocks: Blocks, starts: FloatArray) -> Prediction:
        """Return states and errors; see `Kernel`."""
        return self.passed(v, blocks, self.begin(v, blocks, starts))

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
        """Return what Gauss-Newton omits, by differences of the gradient; see `Kernel`."""
        kept = self.sweep(v, blocks, starts, weight)
        theta, mixed = np.zeros_like(kept.hessian), np.zeros_like(kept.hessian_mixed)
        here = self.gradient(v, blocks, starts, ends, weight)
        for j, step, at in moved:
            there = self.gradient(at, blocks, starts, ends, weight)
            theta[:, j] = (there[0] - here[0]) / step - kept.hessian[:, j]
            mixed[:, j] = (there[1] - here[1]) / step - kept.hessian_mixed[:, j]
        return theta, mixed

    def growth(
        self,
        v: NonlinearValues,  # noqa: ARG002
        blocks: Blocks,
        sweep: Sweep | None,
        state_scale: FloatArray,
    ) -> float:
        """Return the growth along the trajectory of the segment with the largest one; see `Kernel`."""
        if sweep is None:
            return np.inf
        by_start = sweep.end_start / state_scale[:, None] * state_scale
        window = blocks.length * blocks.per_window
        pieces = np.split(by_start, blocks.segment_first[1:])
        return max(growth_along(piece, window * len(piece)) for piece in pieces)

    def feedback(self, v: NonlinearValues, blocks: Blocks, prediction: Prediction) -> PredictorValues:
        """Return the predictor of small deviations from the mean of the trajectory; see `Kernel`."""
        return self.linear(v, blocks, prediction)

    def sensitivities(
        self, v: NonlinearValues, blocks: Blocks, prediction: Prediction, linked: Linked, own: slice
    ) -> FloatArray:
        """Return the sensitivities of some blocks; see `Kernel`."""
        n_y, m = blocks.y.shape[2], linked.by_theta.shape[2] + linked.by_start.shape[2]
        every = np.empty((n_y * m, own.stop - own.start, blocks.length))
        for begin in range(own.start, own.stop, _AT_ONCE):
            some = slice(begin, min(begin + _AT_ONCE, own.stop))
            first = np.concatenate([linked.by_theta[some], linked.by_start[some]], axis=2)
            psi = self.run.sensitivities(v, blocks, prediction, first, some)
            used = blocks.side_by_side(blocks.used[:, :, None], some)[:, :, None]
            rows = np.where(used != 0, psi * used, 0.0).reshape(blocks.length, n_y * m, -1)
            every[:, begin - own.start : some.stop - own.start] = rows.transpose(1, 2, 0)
        return every


def linked_along(blocks: Blocks, end_theta: FloatArray, end_start: FloatArray) -> Linked:
    """Follow each window through its blocks, of which each has its own transition.

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


# ---- Runner of the functions of a sample by CasADi's own map: portable, and the reference for the compiled one.


class Mapped:
    """Function for many columns at once, evaluated without copies.

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
        self._shapes = [function.size_in(i) for i in range(function.n_in())]
        self._arguments = [np.zeros((width, columns, rows)) for rows, columns in self._shapes]
        outs = [function.size_out(i) for i in range(function.n_out())]
        self._results = [np.zeros((width, columns, rows)) for rows, columns in outs]
        self._buffer, self._run = mapped.buffer()
        for i, array in enumerate(self._arguments):
            self._buffer.set_arg(i, memoryview(array))  # type: ignore[call-arg, arg-type]  # its stubs are those of C++
        for i, array in enumerate(self._results):
            self._buffer.set_res(i, memoryview(array))  # type: ignore[call-arg, arg-type]  # as above

    def __call__(self, *arguments: FloatArray | float) -> list[FloatArray]:
        """Return results (width, columns, rows) for arguments of that shape, or that are the same for all columns."""
        for own, value in zip(self._arguments, arguments, strict=True):
            own[:] = value
        self._run()
        return self._results


class MappedRunner:
    """Runner by CasADi's map; a `SampleRunner`.

    Parameters
    ----------
    functions : SampleFunctions
        Functions of a sample.
    """

    def __init__(self, functions: SampleFunctions) -> None:
        self._functions = functions
        self._mapped = lru_cache(maxsize=32)(lambda name, width: Mapped(getattr(functions, name), width))
        self._n, self._n_p = functions.output.size1_in(0), functions.output.size1_in(2)

    def begin(self, v: NonlinearValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the state at the start of each block; see `SampleRunner`."""
        z = _flat(blocks.z(v.shift))
        result = np.zeros((self._n, len(blocks.size)))
        x = starts[:, None, :].copy()
        for i in range(blocks.per_window):
            live = blocks.window_size > i
            at = np.where(live, blocks.window_first + i, 0)
            result[:, at[live]] = x[live, 0].T
            if i + 1 < blocks.per_window:
                for k in range(blocks.length):
                    x = self._onwards(v, x, z[k, at])[0]
        return result

    def passed(self, v: NonlinearValues, blocks: Blocks, begin: FloatArray) -> Prediction:
        """Return states and errors; see `SampleRunner`."""
        z, y = _flat(blocks.z(v.shift)), _flat(blocks.y)
        used = _flat(blocks.used[:, :, None])
        states, errors = np.empty((*z.shape[:2], self._n)), np.empty_like(y)
        x = np.ascontiguousarray(begin.T)[:, None, :]
        for k in range(blocks.length):
            states[k] = x[:, 0]
            x, yhat = self._onwards(v, x, z[k])
            errors[k] = _counted(used[k], (y[k] - yhat) * used[k])
        return Prediction(_grouped(states, blocks), _grouped(errors, blocks), x[:, 0].T)

    def products(self, v: NonlinearValues, blocks: Blocks, begin: FloatArray) -> FloatArray:
        """Return the products of the errors of each block; see `SampleRunner`."""
        return self.passed(v, blocks, begin).products

    def sums(self, v: NonlinearValues, blocks: Blocks, begin: FloatArray, root: FloatArray) -> SampleSums:
        """Return the sums of a pass with sensitivities; see `SampleRunner`."""
        n, n_p, width = self._n, self._n_p, len(blocks.size)
        y, used = _flat(blocks.y), _flat(blocks.used[:, :, None])
        n_y, m = y.shape[2], n_p + n
        first = np.concatenate([np.zeros((width, n, n_p)), np.broadcast_to(np.eye(n), (width, n, n))], axis=2)
        hessian, gradient = np.zeros((width, m, m)), np.zeros((width, m))
        products = np.zeros((n_y, n_y))
        end, slopes = np.ascontiguousarray(begin.T), first.copy()
        for k, x, S, yhat, psi in self._with_slopes(v, _flat(blocks.z(v.shift)), begin.T, first):
            error = _counted(used[k], (y[k] - yhat) * used[k])
            weighted = error @ root.T
            rows = root @ _counted(used[k][:, None], psi * used[k][:, None])
            hessian += rows.transpose(0, 2, 1) @ rows
            gradient -= np.einsum("wyi,wy->wi", rows, weighted)
            products += error.T @ error
            ended = blocks.size == k + 1
            end[ended], slopes[ended] = x[ended], S[ended]
        live = (blocks.size > 0)[:, None, None]
        hessian = np.where(live, hessian, 0.0)
        return SampleSums(
            BlockSums(
                hessian[:, :n_p, :n_p].sum(axis=0),
                products,
                gradient[:, :n_p],
                gradient[:, n_p:],
                hessian[:, :n_p, n_p:],
                end,
                slopes[:, :, :n_p],
            ),
            hessian[:, n_p:, n_p:],
            slopes[:, :, n_p:],
        )

    def adjoint(
        self, v: NonlinearValues, blocks: Blocks, prediction: Prediction, weighted: FloatArray, ends: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return derivatives backwards from the ends of windows; see `SampleRunner`."""
        z, w, states = (_flat(values) for values in (blocks.z(v.shift), weighted, prediction.states))
        width, part = blocks.n_windows, 1 / v.steps
        output, step, output_back, step_back = (
            self._mapped(name, width) for name in ("output", "step", "output_back", "step_back")
        )
        a, by_theta = ends[:, None, :].copy(), np.zeros((width, self._n_p))
        fixed = v.theta, v.known
        for i in range(blocks.per_window - 1, -1, -1):
            at = np.where(blocks.window_size > i, blocks.window_first + i, 0)
            for k in range(blocks.length - 1, -1, -1):
                live = (blocks.window_size > i) & (blocks.size[at] > k)
                own = states[k, at][:, None], z[k, at][:, None]
                xe, _, e = (r.copy() for r in output(*own, *fixed))
                passed = [xe]
                for s in range(v.steps - 1):
                    passed.append(step(passed[-1], own[1], e, *fixed, s * part, part)[0].copy())
                back, by_error, by_own = a, np.zeros_like(e), np.zeros((width, self._n_p))
                for s in range(v.steps - 1, -1, -1):
                    found = step_back(passed[s], own[1], e, *fixed, s * part, part, back)
                    back = found[0].copy()
                    by_error += found[1]
                    by_own += found[2][:, 0]
                onto = -w[k, at][:, None] - by_error * self._functions.feeds_back
                found = output_back(*own, *fixed, back, onto)
                a = np.where(live[:, None, None], found[0], a)
                by_theta += np.where(live[:, None], by_own + found[1][:, 0], 0.0)
        return by_theta.sum(axis=0), a[:, 0]

    def sensitivities(
        self, v: NonlinearValues, blocks: Blocks, prediction: Prediction, first: FloatArray, own: slice
    ) -> FloatArray:
        """Return the sensitivities of some blocks; see `SampleRunner`."""
        z = np.ascontiguousarray(blocks.side_by_side(blocks.z(v.shift), own).transpose(0, 2, 1))
        x = blocks.side_by_side(prediction.states, own)[0].T
        psi = [slopes.copy() for *_, slopes in self._with_slopes(v, z, x, first)]
        return np.stack(psi).transpose(0, 2, 3, 1)

    def one_sample(self, v: NonlinearValues, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the state after one sample, its derivative by the state, and that of the outputs."""
        first = np.concatenate([np.zeros((self._n, self._n_p)), np.eye(self._n)], axis=1)
        _, after, S, _, psi = next(self._with_slopes(v, z[None, None], x[None], first[None]))
        return after[0].copy(), S[0][:, self._n_p :].copy(), psi[0][:, self._n_p :].copy()

    def _onwards(self, v: NonlinearValues, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the next states (width, 1, n) and the outputs (width, n_y)."""
        output, step = self._mapped("output", len(x)), self._mapped("step", len(x))
        at, yhat, e = (r.copy() for r in output(x, z[:, None], v.theta, v.known))
        for s in range(v.steps):
            at = step(at, z[:, None], e, v.theta, v.known, s / v.steps, 1 / v.steps)[0].copy()
        return at, yhat[:, 0]

    def _with_slopes(
        self, v: NonlinearValues, z: FloatArray, x: FloatArray, first: FloatArray
    ) -> Iterator[tuple[int, FloatArray, FloatArray, FloatArray, FloatArray]]:
        """Yield for each sample its number, the state after it, its derivatives, the outputs and their derivatives."""
        width, n_p = z.shape[1], self._n_p
        output, step = self._mapped("output_jacobian", width), self._mapped("step_jacobian", width)
        at, S = np.ascontiguousarray(x)[:, None, :], first.copy()
        fixed = v.theta, v.known
        for k in range(len(z)):
            own = z[k][:, None]
            at, yhat, e, *jacobians = (r.copy() for r in output(at, own, *fixed))
            by_start, by_state, by_theta = (each.transpose(0, 2, 1) for each in jacobians)
            S[:, :, :n_p] += by_start
            psi = by_state @ S
            psi[:, :, :n_p] += by_theta
            for s in range(v.steps):
                at, *jacobians = (r.copy() for r in step(at, own, e, *fixed, s / v.steps, 1 / v.steps))
                F, G = (each.transpose(0, 2, 1) for each in jacobians)
                by_e, by_own = np.split(G, [G.shape[2] - n_p], axis=2)
                S = F @ S - by_e @ psi if by_e.shape[2] else F @ S
                S[:, :, :n_p] += by_own
            yield k, at[:, 0], S.copy(), yhat[:, 0], psi


def _counted(used: FloatArray, values: FloatArray) -> FloatArray:
    """Return values with zeros where samples do not count, also where they overflow there."""
    return np.where(used != 0, values, 0.0)


def _flat(values: FloatArray) -> FloatArray:
    """Return groups side by side: (n_groups, length, n, lanes) to (length, n_groups * lanes, n)."""
    n_groups, length, n, lanes = values.shape
    return np.ascontiguousarray(values.transpose(1, 0, 3, 2)).reshape(length, n_groups * lanes, n)


def _grouped(values: FloatArray, blocks: Blocks) -> FloatArray:
    """Return the opposite of `_flat`."""
    length, _, n = values.shape
    return np.ascontiguousarray(values.reshape(length, -1, blocks.lanes, n).transpose(1, 0, 3, 2))


# ---- Linear predictor at the mean of a trajectory, for what the feedback of errors adds to the uncertainty.

_DIFFERENCE = 1e-5  # relative step of a central difference


def mean_predictor(run: MappedRunner, v: NonlinearValues, blocks: Blocks, prediction: Prediction) -> PredictorValues:
    """Return the predictor of small deviations from the mean state and the mean regressors.

    For a linear structure it is the predictor itself. Its regressors are the measured outputs alone.

    Parameters
    ----------
    run : MappedRunner
        Runner of the functions of a sample.
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
        own = v._replace(theta=theta)
        F, C = run.one_sample(own, x, z)[1:]
        sides = []
        for j in range(n_y):
            moved = np.zeros(len(z))
            moved[len(z) - n_y + j] = step = _DIFFERENCE * size[j]
            sides.append((run.one_sample(own, x, z + moved)[0] - run.one_sample(own, x, z - moved)[0]) / (2 * step))
        return F, np.stack(sides, axis=1), C

    F, G, C = at(v.theta)
    slopes = []
    for i, value in enumerate(v.theta):
        moved = np.zeros(len(v.theta))
        moved[i] = step = _DIFFERENCE * (abs(value) if value else 1.0)
        slopes.append([(a - b) / (2 * step) for a, b in zip(at(v.theta + moved), at(v.theta - moved), strict=True)])
    dF, dG, dC = (np.array([slope[i] for slope in slopes]) for i in range(3))
    none = np.zeros((n_y, n_y))
    return PredictorValues(F, G, C, none, dF, dG, dC, np.zeros((len(v.theta), n_y, n_y)), ())


def _mean(values: FloatArray, live: BoolArray) -> FloatArray:
    """Return the mean of values (n_groups, length, n, lanes) over the samples of all blocks, (n,)."""
    return np.asarray(np.where(live[:, :, None], values, 0.0).sum(axis=(0, 1, 3)) / live.sum())
