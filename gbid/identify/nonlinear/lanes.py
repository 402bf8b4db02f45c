"""Runner of the functions of a sample as compiled C, a block in each of the eight lanes of the vector unit."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import lru_cache
from importlib.resources import files
from typing import Any

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.compiling import load_library
from gbid.errors import UsageError
from gbid.identify.kernel.block_sums import BlockSums, Prediction
from gbid.identify.kernel.blocks import LANES, Blocks
from gbid.identify.kernel.engine import pointer_of
from gbid.identify.nonlinear.lane_functions import LANE_TYPES, LaneFunction, lane_source
from gbid.identify.nonlinear.lane_products import places_of, product_source
from gbid.identify.nonlinear.nonlinear_kernel import SampleSums
from gbid.identify.nonlinear.nonlinear_predictor import NonlinearValues
from gbid.identify.nonlinear.sample_functions import SampleFunctions

_BUFFER_BYTES = 32 * 1024  # sensitivities of the outputs held between sums: stays in the first-level cache
_FLAGS = (
    "-O3",
    "-march=native",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-ffp-contract=fast",
    "-fPIC",
    "-shared",
    "-w",
)  # with -O2 the sums of the pass stay in memory, and it takes 70 % longer
_OF_OUTPUT, _OF_STEP = (2, 3), (3, 4, 6)  # arguments that are the same for all samples: parameters, length of a step


class LanesRunner:
    """Compiled runner; a `SampleRunner`.

    Parameters
    ----------
    functions : SampleFunctions
        Functions of a sample.

    Raises
    ------
    CompilerMissingError
        When there is no compiler, or when it fails.
    """

    def __init__(self, functions: SampleFunctions) -> None:
        self._n, self._n_p = functions.output.size1_in(0), functions.output.size1_in(2)
        library = load_library(source_of(functions), _FLAGS)
        self.note = library.note
        self._library = library
        for name in ("sums", "passed", "psi", "begin", "adjoint"):
            getattr(library, f"gbid_{name}").restype = None

    def begin(self, v: NonlinearValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the state at the start of each block; see `SampleRunner`."""
        begin = np.zeros((len(blocks.size), self._n))
        arrays = [self._z(v, blocks), *_windows(blocks), np.ascontiguousarray(starts), begin]
        self._call("begin", v, blocks.n_windows, blocks.length, arrays)
        return begin.T

    def passed(self, v: NonlinearValues, blocks: Blocks, begin: FloatArray) -> Prediction:
        """Return states and errors; see `SampleRunner`."""
        n_groups, length, _, lanes = blocks.y.shape
        states, errors = np.empty((n_groups, length, self._n, lanes)), np.empty_like(blocks.y)
        end = np.empty((n_groups, self._n, lanes))
        self._passed(v, blocks, begin, [states, errors, end])
        return Prediction(states, errors, end.transpose(1, 0, 2).reshape(self._n, -1))

    def products(self, v: NonlinearValues, blocks: Blocks, begin: FloatArray) -> FloatArray:
        """Return the products of the errors of each block; see `SampleRunner`."""
        return self._passed(v, blocks, begin, [])

    def _passed(
        self, v: NonlinearValues, blocks: Blocks, begin: FloatArray, results: Sequence[FloatArray]
    ) -> FloatArray:
        n_groups, length, n_y, lanes = blocks.y.shape
        products = np.empty((n_groups, n_y, n_y, lanes))
        arrays = [self._z(v, blocks), blocks.y, blocks.used, _by_group(begin)]
        self._call("passed", v, n_groups, length, [*arrays, *results, *[None] * (3 - len(results)), products])
        return _per_block(products)

    def sums(self, v: NonlinearValues, blocks: Blocks, begin: FloatArray, root: FloatArray) -> SampleSums:
        """Return the sums of a pass with sensitivities; see `SampleRunner`."""
        z, n, n_p, n_y = self._z(v, blocks), self._n, self._n_p, blocks.y.shape[2]
        n_groups, length, _, lanes = z.shape
        hessian, products = np.empty((n_p, n_p)), np.empty((n_y, n_y))
        gradient, mixed = np.empty((n_groups, n_p + n, lanes)), np.empty((n_groups, n_p, n, lanes))
        start, end = np.empty((n_groups, n, n, lanes)), np.empty((n_groups, n, lanes))
        slopes = np.empty((n_groups, n_p + n, n, lanes))
        size = np.ascontiguousarray(blocks.size, np.int64)
        arrays = [root, z, blocks.y, blocks.used, size, _by_group(begin)]
        self._call("sums", v, n_groups, length, [*arrays, hessian, products, gradient, mixed, start, end, slopes])
        by_block, onto = _per_block(gradient), _per_block(slopes).transpose(0, 2, 1)
        sums = BlockSums(
            hessian,
            products,
            by_block[:, :n_p],
            by_block[:, n_p:],
            _per_block(mixed),
            _per_block(end),
            onto[:, :, :n_p],
        )
        return SampleSums(sums, _per_block(start), onto[:, :, n_p:])

    def adjoint(
        self, v: NonlinearValues, blocks: Blocks, prediction: Prediction, weighted: FloatArray, ends: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return derivatives backwards from the ends of windows; see `SampleRunner`."""
        by_theta, starts = np.empty(self._n_p), np.empty((blocks.n_windows, self._n))
        size = np.ascontiguousarray(blocks.size, np.int64)
        given = [np.ascontiguousarray(prediction.states), np.ascontiguousarray(weighted), size, *_windows(blocks)]
        arrays = [self._z(v, blocks), *given, np.ascontiguousarray(ends), by_theta, starts]
        self._call("adjoint", v, blocks.n_windows, blocks.length, arrays)
        return by_theta, starts

    def sensitivities(
        self, v: NonlinearValues, blocks: Blocks, prediction: Prediction, first: FloatArray, own: slice
    ) -> FloatArray:
        """Return the sensitivities of some blocks; see `SampleRunner`."""
        m, n_y, count = self._n_p + self._n, blocks.y.shape[2], own.stop - own.start
        groups = slice(own.start // LANES, -(-own.stop // LANES))
        skipped, n_groups = own.start - groups.start * LANES, groups.stop - groups.start
        whole = np.zeros((n_groups * LANES, m, self._n))
        whole[skipped : skipped + count] = first.transpose(0, 2, 1)
        slopes = np.empty((n_groups, blocks.length, m, n_y, LANES))
        arrays = [
            np.ascontiguousarray(self._z(v, blocks)[groups]),
            np.ascontiguousarray(prediction.states[groups, 0]),
            np.ascontiguousarray(whole.reshape(n_groups, LANES, m, self._n).transpose(0, 2, 3, 1)),
            slopes,
        ]
        self._call("psi", v, n_groups, blocks.length, arrays)
        psi = slopes.transpose(1, 3, 2, 0, 4).reshape(blocks.length, n_y, m, -1)
        return psi[..., skipped : skipped + count]

    def _z(self, v: NonlinearValues, blocks: Blocks) -> FloatArray:
        if blocks.lanes != LANES:
            raise UsageError(f"the compiled pass needs {LANES} blocks in a group, not {blocks.lanes}")
        return blocks.z(v.shift)

    def _call(
        self, name: str, v: NonlinearValues, count: int, length: int, arrays: Sequence[npt.NDArray[Any] | None]
    ) -> None:
        given = [np.ascontiguousarray(v.theta), np.ascontiguousarray(v.known), *arrays]
        numbers = (ctypes.c_long(number) for number in (count, length, v.steps))
        getattr(self._library, f"gbid_{name}")(*numbers, *(None if a is None else pointer_of(a) for a in given))


@lru_cache(maxsize=32)
def source_of(functions: SampleFunctions) -> str:
    """Return the C source of the runner of a predictor."""
    n, n_y, n_p = functions.output.size1_in(0), functions.output.size1_out(1), functions.output.size1_in(2)
    n_c = n_p + n
    sizes = {
        "N": n,
        "NP": n_p,
        "NM": n + functions.step_jacobian.size2_out(2),
        "NZ": functions.output.size1_in(1),
        "NY": n_y,
        "NQ": functions.output.size1_in(3),
        "FEEDS": int(functions.feeds_back),
        "ROWS": max(4, _BUFFER_BYTES // ((n_c + 3) * n_y * 64)),
    }
    dense = {2: places_of(functions.step_jacobian.sparsity_out(2))}
    written = {
        "output": LaneFunction(functions.output, _OF_OUTPUT),
        "step": LaneFunction(functions.step, _OF_STEP),
        "output_jacobian": LaneFunction(functions.output_jacobian, _OF_OUTPUT),
        "step_jacobian": LaneFunction(functions.step_jacobian, _OF_STEP, dense),
        "output_back": LaneFunction(functions.output_back, _OF_OUTPUT),
        "step_back": LaneFunction(functions.step_back, _OF_STEP),
    }
    text = _template().replace("@TYPES@", LANE_TYPES).replace("@FUNCTIONS@", lane_source(written))
    text = text.replace("@PRODUCTS@", product_source(functions))
    for name, size in sizes.items():
        text = text.replace(f"@{name}@", str(size))
    return text


@lru_cache(maxsize=1)
def _template() -> str:
    return files("gbid.identify.nonlinear").joinpath("lane_template.c").read_text(encoding="utf-8")


def _windows(blocks: Blocks) -> list[npt.NDArray[np.int64]]:
    return [np.ascontiguousarray(values, np.int64) for values in (blocks.window_first, blocks.window_size)]


def _by_group(values: FloatArray) -> FloatArray:
    """(n, W) to (n_groups, n, lanes)."""
    return np.ascontiguousarray(values.reshape(len(values), -1, LANES).transpose(1, 0, 2))


def _per_block(values: FloatArray) -> FloatArray:
    """(n_groups, ..., lanes) to (W, ...)."""
    return np.ascontiguousarray(np.moveaxis(values, -1, 1)).reshape(-1, *values.shape[1:-1])
