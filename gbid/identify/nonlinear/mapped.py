"""Runner of the functions of a sample by CasADi's own map: portable, and the reference for the compiled one."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.kernel.block_sums import BlockSums, Prediction
from gbid.identify.kernel.blocks import Blocks
from gbid.identify.nonlinear.nonlinear_kernel import SampleSums
from gbid.identify.nonlinear.nonlinear_predictor import NonlinearValues
from gbid.identify.nonlinear.sample_functions import SampleFunctions


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
