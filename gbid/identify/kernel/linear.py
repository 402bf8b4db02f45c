"""Kernels of linear predictors, in C and in numpy: blocks side by side, linked by powers of the transition matrix."""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from gbid.core.arrays import BoolArray, FloatArray, IntArray
from gbid.core.compiled import CompilerMissingError, c_source, load_library, run_compiled
from gbid.identify.kernel.blocks import LANES, Blocks, BlockSums, Prediction, at_windows, per_block
from gbid.identify.kernel.portable import PortablePasses, flat
from gbid.identify.kernel.sums import (
    Kernel,
    KernelOfLinear,
    Lagrangian,
    Linked,
    Moved,
    Traced,
    along_windows,
    joined,
    link,
    powers_of,
    scan,
    start_hessians,
)
from gbid.identify.predictor import PredictorValues


class Backwards(NamedTuple):
    """Results of a forward pass of the model and a backward pass of its adjoint.

    Attributes
    ----------
    states : (n_groups, length, n, lanes) array
        States of the model.
    start : (n, W) array
        The adjoint at the start of each block.
    sums : (n + n_y, n + n_z) array
        Derivative of the cost by the entries of ``[F G; C H]``.
    factors : (n_groups, length, n + n_y, lanes) array
        For each sample ``a[k+1]`` and then ``-w[k]``: `sums` are their products with states and regressors.
    """

    states: FloatArray
    start: FloatArray
    sums: FloatArray
    factors: FloatArray


class LinearKernel(KernelOfLinear):
    """Base of the kernels of linear predictors, which have one transition matrix for all samples."""

    def trace(
        self, v: PredictorValues, blocks: Blocks, starts: FloatArray, weights: Sequence[FloatArray]
    ) -> list[Traced]:
        """Return the sums by window and by block for each weight; see `Kernel`."""
        powers = powers_of(v.F, blocks.length)
        begin = self.begin(v, blocks, starts, powers[-1])
        passes = []
        for weight in weights:
            root = np.ascontiguousarray(np.linalg.cholesky(weight).T)  # W = root' root
            free = root @ v.C @ powers[:-1]
            sums = self.sums(v, blocks, begin, root, free)
            linked = link(blocks, sums.end_theta, powers)
            passes.append(Traced(begin, joined(blocks, sums, start_hessians(blocks, free), linked), linked, sums))
        return passes

    def begin(
        self, v: PredictorValues, blocks: Blocks, starts: FloatArray, transition: FloatArray | None = None
    ) -> FloatArray:
        """Return the state at the start of each block, optionally from a known block transition; see `Kernel`."""
        if blocks.per_window == 1:
            return at_windows(blocks, starts)
        transition = np.linalg.matrix_power(v.F, blocks.length) if transition is None else transition
        kept = blocks.ends_from_zero
        if not (kept and kept[0][0] is v):
            kept[:] = [(v, self.ends(v, blocks, np.zeros((len(v.F), len(blocks.size)))))]
        return along_windows(blocks, starts.T[:, :, None], kept[0][1][:, :, None], transition)[:, :, 0]

    def gradient(self, v: PredictorValues, blocks: Blocks, at: Lagrangian) -> tuple[FloatArray, FloatArray]:
        """Return the gradient by the adjoint method, cheaper than a pass with sensitivities.

        ``w`` are the weighted errors, and ``a[k]`` is the derivative of the cost by the state at sample k. The adjoint
        runs backwards, ``a[k] = F' a[k+1] - C' w[k]``, from the multipliers at the end of a window. Derivatives by the
        entries of F and G are sums of products of ``a`` with states and regressors. Those by C and H use ``w``.
        """
        back = self._backwards(v, blocks, at, np.linalg.matrix_power(v.F, blocks.length))
        return _by_parameters(v, back.sums), back.start[:, blocks.window_first].T

    def left_out(
        self, v: PredictorValues, blocks: Blocks, at: Lagrangian, moved: Sequence[Moved]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the second-order term of the Hessian, in two passes for all columns; see `Kernel`.

        With the adjoint a, the weighted errors w and the sensitivities ``s_j`` of the state, it is the sum over k of

            a[k+1]' (dF_i s_j + dF_j s_i + d2F_ij x + d2G_ij z) - w' (dC_i s_j + dC_j s_i + d2C_ij x + d2H_ij z).

        The sums of products of a and w with states and sensitivities come from the passes. Second derivatives of the
        matrices are differences of the first ones, which need no pass. The state is linear in the start of its window.
        So by a parameter and a start, ``dF_j F^k`` is all that is left.
        """
        powers, n, n_p = powers_of(v.F, blocks.length), len(v.F), len(v.dF)
        back = self._backwards(v, blocks, at, powers[-1])
        products, end_theta = self.second_pass(v, blocks, back)
        linked = link(blocks, end_theta, powers)
        live, m = slice(0, blocks.n_blocks), back.factors.shape[2]
        # Of the start of each block: products of the factors with the free response, (n_blocks, m * n, n).
        by_block = np.moveaxis(back.factors, -1, 1).transpose(0, 1, 3, 2).reshape(-1, blocks.length)
        free = (by_block @ powers[:-1].reshape(blocks.length, -1)).reshape(-1, m * n, n)[live]
        products = products.transpose(1, 0, 2).reshape(n_p, m * n)
        products = products + np.tensordot(linked.by_theta[live], free, ([0, 1], [0, 2]))
        slopes = np.concatenate([v.dF, v.dC], axis=1).reshape(n_p, m * n)
        across = slopes @ products.T
        full, columns = across + across.T, [each.column for each in moved]
        theta, mixed = np.zeros((n_p, n_p)), np.zeros((blocks.n_windows, n_p, n))
        adjoint = _by_parameters(v, back.sums)
        for each in moved:
            change = (_by_parameters(each.v, back.sums) - adjoint) / each.step
            theta[:, each.column] = full[:, each.column] + change
        by_start = np.add.reduceat((slopes @ free) @ linked.by_start[live], blocks.window_first)
        mixed[:, columns] = by_start[:, columns]
        return theta, mixed

    def _backwards(self, v: PredictorValues, blocks: Blocks, at: Lagrangian, transition: FloatArray) -> Backwards:
        """Run the model forwards and its adjoint backwards through the blocks of each window."""
        prediction = self.passed(v, blocks, self.begin(v, blocks, at.starts, transition))
        weighted = at.weight @ prediction.errors * blocks.used[:, :, None]
        at_end = np.zeros((len(v.F), len(blocks.size)))
        at_end[:, blocks.window_first + blocks.window_size - 1] = at.ends.T
        back = self.adjoint_pass(v, blocks, weighted, prediction.states, at_end)
        if blocks.per_window > 1:
            at_start = _back_along_windows(blocks, back.start, transition)
            at_end[:, blocks.followed] = at_start[:, blocks.followed + 1]
            back = self.adjoint_pass(v, blocks, weighted, prediction.states, at_end)
        return back

    @abstractmethod
    def sums(
        self, v: PredictorValues, blocks: Blocks, begin: FloatArray, root: FloatArray, free: FloatArray
    ) -> BlockSums:
        """Return the sums of a pass with sensitivities; abstract.

        Parameters
        ----------
        v : PredictorValues
            Predictor.
        blocks : Blocks
            Samples.
        begin : (n, W) array
            State at the start of each block, padding included.
        root : (n_y, n_y) array
            Upper triangular, ``root' root`` the weight.
        free : (length, n_y, n) array
            Weighted response to the start, ``root C F^k``.
        """

    @abstractmethod
    def adjoint_pass(
        self, v: PredictorValues, blocks: Blocks, weighted: FloatArray, states: FloatArray, last: FloatArray
    ) -> Backwards:
        """Run the adjoint ``a[k] = F' a[k+1] - C' w[k]`` backwards in each block.

        Parameters
        ----------
        v : PredictorValues
            Predictor.
        blocks : Blocks
            Samples.
        weighted : (n_groups, length, n_y, lanes) array
            Weighted errors ``w``.
        states : (n_groups, length, n, lanes) array
            States of the model.
        last : (n, W) array
            The adjoint at the end of each block.
        """

    @abstractmethod
    def second_pass(self, v: PredictorValues, blocks: Blocks, back: Backwards) -> tuple[FloatArray, FloatArray]:
        """Return sums of the adjoint times state sensitivities; the start of each block does not depend on parameters.

        Returns
        -------
        (n + n_y, n_p, n) array
            Sums over all samples of the factors of the adjoint times these sensitivities.
        (W, n, n_p) array
            The sensitivities after the whole length of each block, padding included.
        """


def _back_along_windows(blocks: Blocks, single: FloatArray, transition: FloatArray) -> FloatArray:
    """Return the adjoint at the start of every block, (n, W), from the adjoints of separate blocks."""
    backwards = blocks.window_size[:, None] - 1 - np.arange(blocks.per_window)
    inside = backwards >= 0
    blocks_of = blocks.window_first[:, None] + np.maximum(backwards, 0)
    result = np.zeros_like(single)
    result[:, blocks_of[inside]] = scan(transition.T, single[:, blocks_of][..., None])[:, inside, 0]
    return result


def _by_parameters(v: PredictorValues, sums: FloatArray) -> FloatArray:
    """Return derivatives with respect to parameters from derivatives with respect to matrix entries."""
    n, n_p = len(v.F), len(v.dF)
    pairs = ((v.dF, sums[:n, :n]), (v.dG, sums[:n, n:]), (v.dC, sums[n:, :n]), (v.dH, sums[n:, n:]))
    return np.asarray(sum(slopes.reshape(n_p, -1) @ products.ravel() for slopes, products in pairs))


# ---- Kernel in numpy, for machines without a C compiler.


class PortableLinearKernel(LinearKernel, PortablePasses):
    """Kernel of a linear predictor in numpy, for machines without a C compiler; a `Kernel`."""

    def onwards(self, v: PredictorValues, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the next states and the outputs; see `SampleKernel`."""
        return x @ v.F.T + z @ v.G.T, x @ v.C.T + z @ v.H.T

    def with_slopes(
        self, v: PredictorValues, x: FloatArray, z: FloatArray, slopes: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return states and outputs with their derivatives; see `SampleKernel`."""
        after, psi, driving = v.F @ slopes, v.C @ slopes, np.hstack([x, z])
        for rows, by_state, by_regressor in ((after, v.dF, v.dG), (psi, v.dC, v.dH)):
            onto = np.concatenate([by_state, by_regressor], axis=2)
            driven = (driving @ onto.reshape(-1, onto.shape[2]).T).reshape(len(x), *onto.shape[:2])
            rows[:, :, : v.n_parameters] += driven.transpose(0, 2, 1)
        x, yhat = self.onwards(v, x, z)
        return x, after, yhat, psi

    def sums(
        self,
        v: PredictorValues,
        blocks: Blocks,
        begin: FloatArray,
        root: FloatArray,
        free: FloatArray,  # noqa: ARG002
    ) -> BlockSums:
        """Return the sums of the pass with sensitivities; see `LinearKernel`."""
        return self.sample_sums(v, blocks, begin, root).by_block

    def adjoint_pass(
        self, v: PredictorValues, blocks: Blocks, weighted: FloatArray, states: FloatArray, last: FloatArray
    ) -> Backwards:
        """Run the adjoint backwards in each block; see `LinearKernel`."""
        n_groups, length, n, lanes = states.shape
        size, given = blocks.size.reshape(n_groups, 1, lanes), blocks.by_group(last)
        drive = v.C.T @ weighted
        after = np.empty_like(states)
        a = np.zeros_like(given)
        for k in range(length - 1, -1, -1):
            after[:, k] = np.where(size == k + 1, given, a)
            a = v.F.T @ after[:, k] - drive[:, k]
        factors, driving = np.concatenate([after, -weighted], axis=2), _driving(v, blocks, states)
        sums = np.einsum("gkal,gkbl->ab", factors, driving, optimize=True)
        return Backwards(states, a.transpose(1, 0, 2).reshape(n, -1), sums, factors)

    def second_pass(self, v: PredictorValues, blocks: Blocks, back: Backwards) -> tuple[FloatArray, FloatArray]:
        """Return the products of the adjoint and the sensitivities of the states; see `LinearKernel`."""
        return second_sums(v, blocks, back)


def second_sums(v: PredictorValues, blocks: Blocks, back: Backwards) -> tuple[FloatArray, FloatArray]:
    """Return the result of `LinearKernel.second_pass`, sample by sample in numpy."""
    n_p, n, _ = v.dF.shape
    factors, driving = flat(back.factors), flat(_driving(v, blocks, back.states))
    onto = np.concatenate([v.dF, v.dG], axis=2).reshape(n_p * n, -1).T
    products, s = np.zeros((factors.shape[2], n_p * n)), np.zeros((len(blocks.size), n_p * n))
    for now, at in zip(factors, driving, strict=True):
        products += now.T @ s
        s = (s.reshape(-1, n) @ v.F.T).reshape(s.shape) + at @ onto
    return products.reshape(-1, n_p, n), s.reshape(-1, n_p, n).transpose(0, 2, 1)


def _driving(v: PredictorValues, blocks: Blocks, states: FloatArray) -> FloatArray:
    """Return states and regressors of all samples, joined: (n_groups, length, n + n_z, lanes)."""
    return np.concatenate([states, blocks.z(v.shift)], axis=2)


# ---- Kernel in C: pattern of nonzeros, generated source, compiled passes.


class KernelPattern(NamedTuple):
    """Pattern of nonzeros of the predictor's matrices; equal by content.

    Attributes
    ----------
    F : (n, n), G : (n, n_z), C : (n_y, n), H : (n_y, n_z) boolean arrays
        Patterns of the matrices.
    dF, dG, dC, dH : boolean arrays
        Patterns of the derivatives, with a first axis of parameters.
    """

    F: BoolArray
    G: BoolArray
    C: BoolArray
    H: BoolArray
    dF: BoolArray
    dG: BoolArray
    dC: BoolArray
    dH: BoolArray

    @classmethod
    def of(cls, v: PredictorValues) -> KernelPattern:
        """Return the pattern of nonzeros at one parameter value."""
        return cls(*(array != 0 for array in v[:8]))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, KernelPattern) and self._content() == other._content()

    def __hash__(self) -> int:
        return hash(self._content())

    def _content(self) -> tuple[tuple[tuple[int, ...], bytes], ...]:
        return tuple((array.shape, array.tobytes()) for array in self)

    def union(self, other: KernelPattern) -> KernelPattern:
        """Union of two patterns."""
        return KernelPattern(*(first | second for first, second in zip(self, other, strict=True)))

    def live(self, i: int) -> BoolArray:
        """Return which states can depend on parameter `i`, for a start that does not, (n,)."""
        return reached(self.F, self.dF[i].any(axis=1) | self.dG[i].any(axis=1))


def reached(F: BoolArray, first: BoolArray) -> BoolArray:
    """Return the nonzero pattern of ``F^k first`` for all k, as of a recursion that starts with `first`."""
    for _ in F:  # a product of more than n factors has no other entries
        first = first | (F @ first)
    return first


# Blocks run side by side in the lanes of a vector type. The recursion of states and sensitivities is written out
# entry by entry, zeros left out; the sums over the samples are small matrix products on a buffer of a few steps, so
# that their accumulators stay in registers. The second pass, products of the adjoint and the
# sensitivities of the states, is a library of its own, because only fits with coloured errors need it.


@lru_cache(maxsize=32)
def kernel_source(pattern: KernelPattern) -> str:
    """Return C source of ``gbid_pass``, ``gbid_predict`` and ``gbid_adjoint``: one unit without includes."""
    n_p = len(pattern.dF)
    return _source(
        "linear_pass.c",
        pattern,
        NT=_padded(len(pattern.F)),
        STEP=[*_outputs(pattern), *_state(pattern), *(line for i in range(n_p) for line in _sensitivity(pattern, i))],
        PREDICT=[*_errors(pattern), *_state(pattern)],
        BACK=_adjoint(pattern),
    )


@lru_cache(maxsize=32)
def second_source(pattern: KernelPattern) -> str:
    """Return C source of ``gbid_second``: one unit without includes."""
    n, n_p = len(pattern.F), len(pattern.dF)
    step = []
    for i in range(n_p):
        after = _state_sensitivity(pattern, i)
        step += ["{", f"const v *restrict s = before + {i * n};"]
        step += [*(f"next[{i * n + r}] = {value};" for r, value in after.items()), "}"]
    return _source("second_pass.c", pattern, STEP=step)


def _source(name: str, pattern: KernelPattern, **parts: int | list[str]) -> str:
    """Return a C template of this folder, filled with sizes and statements for a pattern."""
    (n, n_z), n_y, n_p = pattern.G.shape, len(pattern.C), len(pattern.dF)
    lines = {
        key: part if isinstance(part, int) else "\n".join("      " + s for s in part) for key, part in parts.items()
    }
    return filled(name, {"N": n, "NZ": n_z, "NY": n_y, "NP": n_p, **lines})


def filled(name: str, parts: Mapping[str, object]) -> str:
    """Return a C template of this folder with ``@NAME@`` replaced by parts, and with the shared workspace header."""
    text = c_source("gbid.identify.kernel", name)
    for key, part in {"WORKSPACE": c_source("gbid.identify.kernel", "workspace.h").rstrip(), **parts}.items():
        text = text.replace(f"@{key}@", str(part))
    return text


def _padded(n: int) -> int:
    """Return the number of columns of responses in memory: n rounded up to a multiple of four."""
    return -(-n // 4) * 4


def _terms(row: BoolArray, coefficient: str, offset: int, vector: str) -> list[str]:
    """Return C terms of a matrix row times a vector: ``coefficient[offset + j] * vector[j]`` for nonzeros."""
    return [f"{coefficient}[{offset + j}]*{vector}[{j}]" for j in np.flatnonzero(row)]


def _sum(terms: list[str]) -> str:
    """Return the C expression of a sum; zero for no terms."""
    return " + ".join(terms) if terms else "zero"


def _errors(p: KernelPattern) -> list[str]:
    """C statements for the error of every output."""
    n, n_z = p.G.shape
    sums = [_sum(_terms(p.C[j], "C", j * n, "x") + _terms(p.H[j], "H", j * n_z, "z")) for j in range(len(p.C))]
    return [f"e[{j}] = (y[{j}] - ({yhat})) * m;" for j, yhat in enumerate(sums)]


def _outputs(p: KernelPattern) -> list[str]:
    """C statements for the error and the weighted value of every output."""
    n_y = len(p.C)
    lines = _errors(p)
    for a in range(n_y):
        lines.append(f"E[t*NY + {a}] = {_sum([f'R[{a * n_y + j}]*e[{j}]' for j in range(a, n_y)])};")
    lines += [f"ee[{a * n_y + b}] += e[{a}]*e[{b}];" for a in range(n_y) for b in range(a, n_y)]
    return lines


def _state(p: KernelPattern) -> list[str]:
    n, n_z = p.G.shape
    return [f"nx[{r}] = {_sum(_terms(p.F[r], 'F', r * n, 'x') + _terms(p.G[r], 'G', r * n_z, 'z'))};" for r in range(n)]


def _adjoint(p: KernelPattern) -> list[str]:
    """C statements for one backward step of the adjoint."""
    n = len(p.F)
    lines = []
    for c in range(n):
        back = [f"F[{r * n + c}]*a[{r}]" for r in np.flatnonzero(p.F[:, c])]
        out = [f"C[{j * n + c}]*w[{j}]" for j in np.flatnonzero(p.C[:, c])]
        lines.append(f"na[{c}] = {_sum(back)} - ({_sum(out)});")
    return lines


def _sensitivity(p: KernelPattern, i: int) -> list[str]:
    """C statements for one parameter's sensitivity: outputs to the buffer, then the next state."""
    n, n_z = p.G.shape
    n_y, live = len(p.C), p.live(i)
    lines = ["{", f"v *restrict s = S + {i * n};"]
    for j in range(n_y):
        terms = _terms(p.C[j] & live, "C", j * n, "s")
        terms += _terms(p.dC[i, j], "dC", (i * n_y + j) * n, "x") + _terms(p.dH[i, j], "dH", (i * n_y + j) * n_z, "z")
        lines.append(f"v q{j} = ({_sum(terms)}) * m;")
    for a in range(n_y):
        lines.append(f"P[{i}*BUF + t*NY + {a}] = {_sum([f'R[{a * n_y + j}]*q{j}' for j in range(a, n_y)])};")
    after = _state_sensitivity(p, i)
    lines += [f"v s{r} = {value};" for r, value in after.items()]
    lines += [f"s[{r}] = s{r};" for r in after]
    lines.append("}")
    return lines


def _state_sensitivity(p: KernelPattern, i: int) -> dict[int, str]:
    """Return for each sensitive state the C expression of its sensitivity after a sample, from `s`."""
    (n, n_z), live = p.G.shape, p.live(i)
    return {
        int(r): _sum(
            _terms(p.F[r] & live, "F", r * n, "s")
            + _terms(p.dF[i, r], "dF", (i * n + r) * n, "x")
            + _terms(p.dG[i, r], "dG", (i * n + r) * n_z, "z")
        )
        for r in np.flatnonzero(live)
    }


_CHUNK = 8  # samples that sensitivities.c holds before it writes them
LONGEST_SOURCE = 200_000
"""Longest kernel that is compiled, in characters: 55 000 (12 states) take seconds, 480 000 (28 states) minutes."""


class CompiledPasses(Kernel):
    """Passes of a compiled kernel, which write states and errors to arrays; in part a `Kernel`.

    Attributes
    ----------
    note : str
        Why its library is not taken from the cache; empty when it is.
    """

    engine = "compiled"
    note: str

    @abstractmethod
    def run_forwards(self, v: Any, blocks: Blocks, begin: FloatArray, results: Sequence[FloatArray | None]) -> None:
        """Compute states, errors, ends and products of errors, into given arrays (None to skip)."""

    def passed(self, v: Any, blocks: Blocks, begin: FloatArray) -> Prediction:
        """Return states and errors from the starts of blocks; see `Kernel`."""
        (n_groups, length, n_y, lanes), n = blocks.y.shape, len(begin)
        states, errors = np.empty((n_groups, length, n, lanes)), np.empty_like(blocks.y)
        end = np.empty((n_groups, n, lanes))
        self.run_forwards(v, blocks, begin, [states, errors, end, np.empty((n_groups, n_y, n_y, lanes))])
        return Prediction(states, errors, end.transpose(1, 0, 2).reshape(n, -1))

    def errors(self, v: Any, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the errors without storing states; see `Kernel`."""
        (n_groups, _, n_y, lanes), errors = blocks.y.shape, np.empty_like(blocks.y)
        results = [None, errors, None, np.empty((n_groups, n_y, n_y, lanes))]
        self.run_forwards(v, blocks, self.begin(v, blocks, starts), results)
        return errors

    def ends(self, v: Any, blocks: Blocks, begin: FloatArray) -> FloatArray:
        """Return the states at the ends of blocks; see `Kernel`."""
        (n_groups, _, n_y, lanes), n = blocks.y.shape, len(begin)
        end = np.empty((n_groups, n, lanes))
        self.run_forwards(v, blocks, begin, [None, None, end, np.empty((n_groups, n_y, n_y, lanes))])
        return end.transpose(1, 0, 2).reshape(n, -1)

    def products(self, v: Any, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the products of the errors of each block; see `Kernel`."""
        n_groups, _, n_y, lanes = blocks.y.shape
        products = np.empty((n_groups, n_y, n_y, lanes))
        self.run_forwards(v, blocks, self.begin(v, blocks, starts), [None, None, None, products])
        return per_block(products)


class CompiledLinearKernel(CompiledPasses, LinearKernel):
    """Kernel of a linear predictor in C, compiled for its pattern of nonzeros; a `Kernel`.

    Parameters
    ----------
    pattern : KernelPattern
        Entries of the predictor's matrices that may differ from zero. The kernel is built anew when others are met.

    Raises
    ------
    CompilerMissingError
        When there is no compiler, or when it fails.
    """

    def __init__(self, pattern: KernelPattern) -> None:
        self._known: PredictorValues | None = None
        self._build(pattern)

    def _build(self, pattern: KernelPattern) -> None:
        self._pattern, self._zeros = pattern, np.flatnonzero(~np.concatenate([part.ravel() for part in pattern]))
        library = load_library(kernel_source(pattern))
        self.note = library.note
        self._pass, self._predict, self._adjoint = library.gbid_pass, library.gbid_predict, library.gbid_adjoint
        self._second: Any = None  # compiled when it is needed first

    def _regressors(self, v: PredictorValues, blocks: Blocks) -> FloatArray:
        """Return the regressors; recompile the kernel if the predictor has new nonzeros."""
        if v is not self._known:  # a gradient runs four passes of one predictor
            if np.concatenate([array.ravel() for array in v[:8]])[self._zeros].any():
                self._build(self._pattern.union(KernelPattern.of(v)))
            self._known = v
        return blocks.z(v.shift)

    def sums(
        self, v: PredictorValues, blocks: Blocks, begin: FloatArray, root: FloatArray, free: FloatArray
    ) -> BlockSums:
        """Return the sums of the pass with sensitivities; see `LinearKernel`."""
        z = self._regressors(v, blocks)
        n, n_p, n_y = len(v.F), len(v.dF), len(v.C)
        n_groups, length, _, lanes = z.shape
        hessian, products = np.empty((n_p, n_p)), np.empty((n_y, n_y))
        by_group = [np.empty((n_groups, *shape, lanes)) for shape in ((n_p,), (n,), (n_p, n), (n,))]
        by_group.append(np.zeros((n_groups, n_p, n, lanes)))  # stays zero for padding
        response = np.zeros((length, n_y, _padded(n)))
        response[:, :, :n] = free
        arrays = [*v[:8], root, response, z, blocks.y, blocks.used, blocks.size, blocks.by_group(begin)]
        run_compiled(self._pass, (n_groups, length), arrays, [hessian, products, *by_group])
        gradient, gradient_start, mixed, end, end_theta = map(per_block, by_group)
        return BlockSums(hessian, products, gradient, gradient_start, mixed, end, end_theta.transpose(0, 2, 1))

    def run_forwards(
        self, v: PredictorValues, blocks: Blocks, begin: FloatArray, results: Sequence[FloatArray | None]
    ) -> None:
        """Compute states, errors, ends and products of errors, into given arrays; see `CompiledPasses`."""
        arrays = [*v[:4], self._regressors(v, blocks), blocks.y, blocks.used, blocks.by_group(begin)]
        run_compiled(self._predict, blocks.y.shape[:2], arrays, results)

    def adjoint_pass(
        self, v: PredictorValues, blocks: Blocks, weighted: FloatArray, states: FloatArray, last: FloatArray
    ) -> Backwards:
        """Run the adjoint backwards in each block; see `LinearKernel`."""
        z = self._regressors(v, blocks)
        n_groups, length, n_z, lanes = z.shape
        n, n_y = len(v.F), len(v.C)
        first, sums = np.empty((n_groups, n, lanes)), np.empty((n + n_y, n + n_z))
        factors = np.empty((n_groups, length, n + n_y, lanes))
        arrays = [v.F, v.C, weighted, states, z, blocks.size, blocks.by_group(last)]
        run_compiled(self._adjoint, (n_groups, length), arrays, [first, factors, sums])
        return Backwards(states, first.transpose(1, 0, 2).reshape(n, -1), sums, factors)

    def second_pass(self, v: PredictorValues, blocks: Blocks, back: Backwards) -> tuple[FloatArray, FloatArray]:
        """Return the products of the adjoint and the sensitivities of the states; see `LinearKernel`.

        By numpy where the C compiler fails on this pass, whose source is longest.
        """
        z = self._regressors(v, blocks)
        if self._second is None:
            try:
                self._second = load_library(second_source(self._pattern)).gbid_second
            except CompilerMissingError as error:
                text = "%s: second derivatives come from the slower portable pass"
                logging.getLogger("gbid.core.compiled").warning(text, error)
                self._second = False
        if self._second is False:
            return second_sums(v, blocks, back)
        n_groups, length, _, lanes = z.shape
        n_p, n, _ = v.dF.shape
        products, end_theta = np.empty((back.factors.shape[2], n_p, n)), np.empty((n_groups, n_p, n, lanes))
        arrays = [v.F, v.dF, v.dG, back.states, z, back.factors]
        run_compiled(self._second, (n_groups, length), arrays, [products, end_theta])
        return products, per_block(end_theta).transpose(0, 2, 1)

    def sensitivities(
        self, v: PredictorValues, blocks: Blocks, prediction: Prediction, linked: Linked, some: slice
    ) -> FloatArray:
        """Return the sensitivities of some blocks; see `Kernel`."""
        z = self._regressors(v, blocks)
        n_z, (n_p, n, _), n_y, length = z.shape[2], v.dF.shape, len(v.C), blocks.length
        m, count = n_p + n, some.stop - some.start
        onto_state = np.concatenate([v.dF, v.dG], axis=2).reshape(n_p * n, -1)
        onto_output = np.concatenate([v.dC, v.dH], axis=2).reshape(n_p * n_y, -1)
        entries = [array for matrix in (v.F, v.C, onto_state, onto_output) for array in _by_rows(matrix)]
        starts = np.concatenate([linked.by_theta[some], linked.by_start[some]], axis=2).transpose(0, 2, 1)
        sides = _aligned((2 * m * n + n + n_z + m * n_y * _CHUNK) * LANES)
        psi = np.empty((n_y * m, count, length))
        run = load_library(c_source("gbid.identify.kernel", "sensitivities.c")).gbid_sensitivities
        sizes = (n, n_p, n_y, n_z, length, some.start, some.stop)
        run_compiled(run, sizes, [*entries, prediction.states, z, blocks.used, starts], [sides, psi])
        return psi


def _by_rows(matrix: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Return a sparse matrix by rows (CSR): limits of the rows, columns and values of the entries."""
    rows, columns = np.nonzero(matrix)
    ends = np.searchsorted(rows, np.arange(len(matrix) + 1)).astype(np.int64)
    return ends, columns.astype(np.int64), matrix[rows, columns]


def _aligned(size: int) -> FloatArray:
    """Return an array of given size at an address aligned for vectors."""
    room = np.empty(size + LANES)
    return room[-(room.__array_interface__["data"][0] // 8) % LANES :][:size]
