"""Pass over the samples without a C compiler: all blocks at once, one sample after the other."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import casadi as ca
import numpy as np

from gbid.core.arrays import FloatArray
from gbid.identify.kernel.blocks import Blocks, BlockSums, Prediction
from gbid.identify.kernel.sample import NonlinearValues, SampleFunctions
from gbid.identify.kernel.sums import Linked
from gbid.identify.predictor import PredictorValues

# ---- Protocols: what runs all blocks, and what runs one sample of them.


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
    """Runner of the recursion over all blocks; `v` is what the ``at`` of the predictor returns."""

    def begin(self, v: Any, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the state at the start of each block, (n, W), from those of the windows, (n_windows, n)."""
        ...

    def passed(self, v: Any, blocks: Blocks, begin: FloatArray) -> Prediction:
        """Return states and errors from the starts of the blocks, (n, W)."""
        ...

    def products(self, v: Any, blocks: Blocks, begin: FloatArray) -> FloatArray:
        """Return the products ``sum e e'`` of the errors of each block, (W, n_y, n_y)."""
        ...

    def sums(self, v: Any, blocks: Blocks, begin: FloatArray, root: FloatArray) -> SampleSums:
        """Return the sums of a pass with sensitivities, for the weight ``root' root``."""
        ...

    def adjoint(
        self, v: Any, blocks: Blocks, prediction: Prediction, weighted: FloatArray, ends: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return derivatives by theta (n_p,) and by the starts of windows (n_windows, n), backwards from `ends`."""
        ...

    def sensitivities(
        self, v: Any, blocks: Blocks, prediction: Prediction, first: FloatArray, some: slice
    ) -> FloatArray:
        """Return the sensitivities of the predictions of some blocks, (length, n_y, m, n_blocks).

        `first` are those of the starts of these blocks, (n_blocks, n, m).
        """
        ...


_AT_ONCE = 64  # blocks whose sensitivities are made together


def sample_sensitivities(
    run: PortableRunner | SampleRunner, v: Any, blocks: Blocks, prediction: Prediction, linked: Linked, own: slice
) -> FloatArray:
    """Return the sensitivities of some blocks as `Kernel` does, from a runner, a few blocks at a time."""
    n_y, m = blocks.y.shape[2], linked.by_theta.shape[2] + linked.by_start.shape[2]
    every = np.empty((n_y * m, own.stop - own.start, blocks.length))
    for begin in range(own.start, own.stop, _AT_ONCE):
        some = slice(begin, min(begin + _AT_ONCE, own.stop))
        first = np.concatenate([linked.by_theta[some], linked.by_start[some]], axis=2)
        psi = run.sensitivities(v, blocks, prediction, first, some)
        used = blocks.side_by_side(blocks.used[:, :, None], some)[:, :, None]
        rows = np.where(used != 0, psi * used, 0.0).reshape(blocks.length, n_y * m, -1)
        every[:, begin - own.start : some.stop - own.start] = rows.transpose(1, 2, 0)
    return every


class SampleSteps(Protocol):
    """One sample of many blocks side by side; `v` is what the ``at`` of the predictor returns."""

    def onwards(self, v: Any, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the next states (width, n) and the outputs (width, n_y)."""
        ...

    def with_slopes(
        self, v: Any, x: FloatArray, z: FloatArray, slopes: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the next states, their derivatives (width, n, m), the outputs, and their derivatives (width, n_y, m).

        `slopes` are the derivatives of the states `x`, (width, n, m), by the parameters and then by other unknowns.
        """
        ...


# ---- Sample of a linear predictor, in numpy.


class LinearSteps:
    """One sample of a linear predictor; a `SampleSteps`."""

    def onwards(self, v: PredictorValues, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the next states and the outputs; see `SampleSteps`."""
        return x @ v.F.T + z @ v.G.T, x @ v.C.T + z @ v.H.T

    def with_slopes(
        self, v: PredictorValues, x: FloatArray, z: FloatArray, slopes: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return states and outputs with their derivatives; see `SampleSteps`."""
        after, psi = v.F @ slopes, v.C @ slopes
        after[:, :, : v.n_parameters] += _driven(v.dF, v.dG, x, z)
        psi[:, :, : v.n_parameters] += _driven(v.dC, v.dH, x, z)
        x, yhat = self.onwards(v, x, z)
        return x, after, yhat, psi


def _driven(by_state: FloatArray, by_regressor: FloatArray, x: FloatArray, z: FloatArray) -> FloatArray:
    """Return ``dF_i x + dG_i z`` for each parameter, (width, rows, n_p)."""
    onto = np.concatenate([by_state, by_regressor], axis=2)
    products = np.hstack([x, z]) @ onto.reshape(-1, onto.shape[2]).T
    return np.asarray(products.reshape(len(x), *onto.shape[:2]).transpose(0, 2, 1))


# ---- Sample of a nonlinear predictor, by CasADi's map.


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
        """Return results (width, columns, rows) for arguments of this shape, or one value for all columns."""
        for array, value in zip(self._arguments, arguments, strict=True):
            array[:] = value
        self._run()
        return self._results


class MappedSteps:
    """One sample of a nonlinear predictor by CasADi's map; a `SampleSteps`.

    Parameters
    ----------
    functions : SampleFunctions
        Functions of a sample.
    """

    def __init__(self, functions: SampleFunctions) -> None:
        self._functions = functions
        self._mapped = lru_cache(maxsize=32)(lambda name, width: Mapped(getattr(functions, name), width))

    def onwards(self, v: NonlinearValues, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the next states and the outputs; see `SampleSteps`."""
        passed, yhat, _ = self._through(v, x, z)
        return passed[-1][:, 0], yhat[:, 0]

    def _through(
        self, v: NonlinearValues, x: FloatArray, z: FloatArray
    ) -> tuple[list[FloatArray], FloatArray, FloatArray]:
        """Return the states before and after each step of the integrator, the outputs, and the errors fed back."""
        output, step = self._mapped("output", len(x)), self._mapped("step", len(x))
        at, yhat, e = (r.copy() for r in output(x[:, None], z[:, None], v.theta, v.known))
        passed = [at]
        for s in range(v.steps):
            passed.append(step(passed[-1], z[:, None], e, v.theta, v.known, s / v.steps, 1 / v.steps)[0].copy())
        return passed, yhat, e

    def with_slopes(
        self, v: NonlinearValues, x: FloatArray, z: FloatArray, slopes: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return states and outputs with their derivatives; see `SampleSteps`."""
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

    def back(
        self, v: NonlinearValues, x: FloatArray, z: FloatArray, after: FloatArray, weighted: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of a cost by the states, (width, n), and by the parameters, (width, n_p).

        `after` are those by the next states, and the errors `weighted`, (width, n_y), those by the outputs.
        """
        output_back, step_back = self._mapped("output_back", len(x)), self._mapped("step_back", len(x))
        passed, _, e = self._through(v, x, z)
        x, z, fixed = x[:, None], z[:, None], (v.theta, v.known)
        a, by_error, by_theta = after[:, None], np.zeros_like(e), np.zeros((len(x), v.n_parameters))
        for s in range(v.steps - 1, -1, -1):
            a, of_error, of_theta = step_back(passed[s], z, e, *fixed, s / v.steps, 1 / v.steps, a)
            a = a.copy()
            by_error += of_error
            by_theta += of_theta[:, 0]
        onto = -weighted[:, None] - by_error * self._functions.feeds_back
        a, of_theta = output_back(x, z, *fixed, a, onto)
        return a[:, 0].copy(), by_theta + of_theta[:, 0]


# ---- All blocks.


class PortableRunner:
    """Runner without a C compiler.

    Parameters
    ----------
    steps : SampleSteps
        One sample of the predictor.
    """

    def __init__(self, steps: SampleSteps) -> None:
        self._steps = steps

    def begin(self, v: Any, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the state at the start of each block; see `SampleRunner`."""
        z = flat(blocks.z(v.shift))
        result = np.zeros((starts.shape[1], len(blocks.size)))
        x = starts
        for i in range(blocks.per_window):
            live = blocks.window_size > i
            at = np.where(live, blocks.window_first + i, 0)
            result[:, at[live]] = x[live].T
            if i + 1 < blocks.per_window:
                for k in range(blocks.length):
                    x = self._steps.onwards(v, x, z[k, at])[0]
        return result

    def passed(self, v: Any, blocks: Blocks, begin: FloatArray) -> Prediction:
        """Return states and errors; see `SampleRunner`."""
        z, y = flat(blocks.z(v.shift)), flat(blocks.y)
        used = flat(blocks.used[:, :, None])
        states, errors = np.empty((*z.shape[:2], len(begin))), np.empty_like(y)
        x = np.ascontiguousarray(begin.T)
        for k in range(blocks.length):
            states[k] = x
            x, yhat = self._steps.onwards(v, x, z[k])
            errors[k] = _counted(used[k], (y[k] - yhat) * used[k])
        return Prediction(_grouped(states, blocks), _grouped(errors, blocks), x.T)

    def products(self, v: Any, blocks: Blocks, begin: FloatArray) -> FloatArray:
        """Return the products of the errors of each block; see `SampleRunner`."""
        return self.passed(v, blocks, begin).products

    def sums(self, v: Any, blocks: Blocks, begin: FloatArray, root: FloatArray) -> SampleSums:
        """Return the sums of a pass with sensitivities; see `SampleRunner`."""
        n, n_p, width = len(begin), v.n_parameters, len(blocks.size)
        y, used = flat(blocks.y), flat(blocks.used[:, :, None])
        n_y, m = y.shape[2], n_p + n
        first = np.concatenate([np.zeros((width, n, n_p)), np.broadcast_to(np.eye(n), (width, n, n))], axis=2)
        hessian, gradient = np.zeros((width, m, m)), np.zeros((width, m))
        products = np.zeros((n_y, n_y))
        end, slopes = np.ascontiguousarray(begin.T), first.copy()
        for k, x, S, yhat, psi in self._with_slopes(v, flat(blocks.z(v.shift)), np.ascontiguousarray(begin.T), first):
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

    def sensitivities(
        self, v: Any, blocks: Blocks, prediction: Prediction, first: FloatArray, some: slice
    ) -> FloatArray:
        """Return the sensitivities of some blocks; see `SampleRunner`."""
        z = np.ascontiguousarray(blocks.side_by_side(blocks.z(v.shift), some).transpose(0, 2, 1))
        x = np.ascontiguousarray(blocks.side_by_side(prediction.states, some)[0].T)
        return np.stack([psi for *_, psi in self._with_slopes(v, z, x, first)]).transpose(0, 2, 3, 1)

    def _with_slopes(
        self, v: Any, z: FloatArray, x: FloatArray, slopes: FloatArray
    ) -> Iterator[tuple[int, FloatArray, FloatArray, FloatArray, FloatArray]]:
        """Yield for each sample its number, the state after it, its derivatives, the outputs and their derivatives."""
        for k, now in enumerate(z):
            x, slopes, yhat, psi = self._steps.with_slopes(v, x, now, slopes)
            yield k, x, slopes, yhat, psi


class MappedRunner(PortableRunner):
    """Runner of a nonlinear predictor by CasADi's map; a `SampleRunner`.

    Parameters
    ----------
    steps : MappedSteps
        One sample of the predictor.
    """

    _steps: MappedSteps

    def adjoint(
        self, v: NonlinearValues, blocks: Blocks, prediction: Prediction, weighted: FloatArray, ends: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return derivatives backwards from the ends of windows; see `SampleRunner`."""
        z, w, states = (flat(values) for values in (blocks.z(v.shift), weighted, prediction.states))
        a, by_theta = ends, np.zeros(v.n_parameters)
        for i in range(blocks.per_window - 1, -1, -1):
            at = np.where(blocks.window_size > i, blocks.window_first + i, 0)
            for k in range(blocks.length - 1, -1, -1):
                live = ((blocks.window_size > i) & (blocks.size[at] > k))[:, None]
                before, onto = self._steps.back(v, states[k, at], z[k, at], a, w[k, at])
                a = np.where(live, before, a)
                by_theta += np.where(live, onto, 0.0).sum(axis=0)
        return by_theta, a


def _counted(used: FloatArray, values: FloatArray) -> FloatArray:
    """Return values with zeros at samples that do not count, even if the values overflow."""
    return np.where(used != 0, values, 0.0)


def flat(values: FloatArray) -> FloatArray:
    """Return groups side by side: (n_groups, length, n, lanes) to (length, n_groups * lanes, n)."""
    n_groups, length, n, lanes = values.shape
    return np.ascontiguousarray(values.transpose(1, 0, 3, 2)).reshape(length, n_groups * lanes, n)


def _grouped(values: FloatArray, blocks: Blocks) -> FloatArray:
    """Return (length, n_groups * lanes, n) values as groups of blocks, (n_groups, length, n, lanes)."""
    length, _, n = values.shape
    return np.ascontiguousarray(values.reshape(length, -1, blocks.lanes, n).transpose(1, 0, 3, 2))
