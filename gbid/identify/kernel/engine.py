"""Choice of the engine that runs the pass: the compiled kernel, or numpy without a compiler."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import lru_cache
from importlib.resources import files
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray, IntArray
from gbid.compiling import CompilerMissingError, load_library
from gbid.errors import UsageError
from gbid.identify.kernel.block_sums import Adjoint, BlockSums, PassEngine, Prediction, Second
from gbid.identify.kernel.blocks import LANES, Blocks
from gbid.identify.kernel.kernel_pattern import KernelPattern
from gbid.identify.kernel.numpy_pass import run_with_numpy
from gbid.identify.kernel.second_source import second_source
from gbid.identify.kernel.source import TILE, kernel_source
from gbid.identify.predictor import PredictorValues

EngineName = Literal["auto", "compiled", "numpy"]
RunEngine = Literal["compiled", "numpy"]
_CHUNK = 8  # samples that sensitivities.c holds before it writes them
LONGEST_SOURCE = 200_000
"""Longest kernel that is compiled, in characters: 55 000 (12 states) take seconds, 480 000 (28 states) minutes."""


class ChosenEngine(NamedTuple):
    """Engine with its name and a note.

    Attributes
    ----------
    run : PassEngine
        The engine.
    name : {"compiled", "numpy"}
        Its name.
    note : str
        Reason why it is not the compiled one, if that was wanted, or is not taken from the cache; else empty.
    """

    run: PassEngine
    name: RunEngine
    note: str


def choose_engine(wanted: EngineName, samples: list[PredictorValues]) -> ChosenEngine:
    """Return the engine for predictors of one size.

    Parameters
    ----------
    wanted : {"auto", "compiled", "numpy"}
        ``"auto"`` is the compiled kernel if there is a C compiler and the predictor is not too large to be compiled in
        seconds; otherwise the note says why it is numpy.
    samples : list of PredictorValues
        The predictor at some parameter values, which show the entries that are always zero.

    Returns
    -------
    ChosenEngine
        Engine with its name and a note.

    Raises
    ------
    UsageError
        When the compiled kernel is required and there is no compiler.
    """
    if wanted not in ("auto", "compiled", "numpy"):
        raise UsageError(f"engine = {wanted!r}; choose 'auto', 'compiled' or 'numpy'")
    if wanted == "numpy":
        return ChosenEngine(run_with_numpy, "numpy", "")
    if wanted == "auto" and len(_source(_arrays(_pattern(samples)))) > LONGEST_SOURCE:
        told = f"a compiled pass for {len(samples[0].F)} states would take minutes to build: the numpy pass was used"
        return ChosenEngine(run_with_numpy, "numpy", told)
    try:
        engine = CompiledEngine(samples)
        return ChosenEngine(engine, "compiled", engine.note)
    except CompilerMissingError as missing:
        if wanted == "compiled":
            raise UsageError(f"engine = 'compiled': {missing}") from None
        return ChosenEngine(run_with_numpy, "numpy", f"{missing}: the slower numpy pass was used")


class CompiledEngine:
    """The pass as compiled C, built for the nonzeros that it has met; an `PassEngine`.

    Parameters
    ----------
    samples : list of PredictorValues
    """

    def __init__(self, samples: list[PredictorValues]) -> None:
        self._known: PredictorValues | None = None
        self._build(_pattern(samples))

    def _build(self, pattern: KernelPattern) -> None:
        self._pattern = pattern
        arrays = _arrays(pattern)
        library = load_library(_source(arrays))
        self._pass, self._predict, self._adjoint = library.gbid_pass, library.gbid_predict, library.gbid_adjoint
        self.note = library.note
        self._pass.restype = self._predict.restype = self._adjoint.restype = None
        self._second: Any = None  # compiled when it is needed first

    def _fit_for(self, v: PredictorValues, blocks: Blocks) -> FloatArray:
        """Rebuild the kernel if the predictor has new nonzeros; return the regressors."""
        if v is not self._known:  # a gradient runs four passes of one predictor
            met = pattern_of(v)
            if not self._pattern.covers(met):
                self._build(self._pattern.union(met))
            self._known = v
        if blocks.lanes != LANES:
            raise UsageError(f"the compiled pass needs {LANES} blocks in a group, not {blocks.lanes}")
        return blocks.z(v.shift)

    def __call__(
        self, v: PredictorValues, blocks: Blocks, starts: FloatArray, root: FloatArray, free: FloatArray
    ) -> BlockSums:
        """Run the pass; see `PassEngine`."""
        z = self._fit_for(v, blocks)
        n, n_p, n_y = len(v.F), len(v.dF), len(v.C)
        n_groups, length, _, lanes = z.shape
        by_group = np.ascontiguousarray(starts.reshape(n_groups, lanes, n).transpose(0, 2, 1))
        hessian, products = np.empty((n_p, n_p)), np.empty((n_y, n_y))
        gradient = np.empty((n_groups, n_p, lanes))
        gradient_start, end = np.empty((n_groups, n, lanes)), np.empty((n_groups, n, lanes))
        mixed, end_theta = np.empty((n_groups, n_p, n, lanes)), np.zeros((n_groups, n_p, n, lanes))
        size = np.ascontiguousarray(blocks.size, np.int64)
        response = np.zeros((length, n_y, -(-n // TILE) * TILE))
        response[:, :, :n] = free
        arrays = [*(np.ascontiguousarray(a) for a in v[:8]), root, response, z, blocks.y, blocks.used, size, by_group]
        results = [hessian, products, gradient, gradient_start, mixed, end, end_theta]
        self._pass(ctypes.c_long(n_groups), ctypes.c_long(length), *(pointer_of(a) for a in arrays + results))
        return BlockSums(
            hessian,
            products,
            _per_block(gradient),
            _per_block(gradient_start),
            _per_block(mixed),
            _per_block(end),
            _per_block(end_theta).transpose(0, 2, 1),
        )

    def predict(self, v: PredictorValues, blocks: Blocks, starts: FloatArray) -> Prediction:
        """Run the state alone; see `PassEngine`."""
        n_groups, length, _, lanes = blocks.y.shape
        n = len(v.F)
        states, errors = np.empty((n_groups, length, n, lanes)), np.empty_like(blocks.y)
        end = np.empty((n_groups, n, lanes))
        self._errors(v, blocks, starts, [states, errors, end])
        return Prediction(states, errors, end.transpose(1, 0, 2).reshape(n, -1))

    def products(self, v: PredictorValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the products of the errors of each block; see `PassEngine`."""
        return self._errors(v, blocks, starts, [])

    def _errors(
        self, v: PredictorValues, blocks: Blocks, starts: FloatArray, results: Sequence[FloatArray]
    ) -> FloatArray:
        """Run the state alone, for the products of errors and further results."""
        z, (n_groups, length, n_y, lanes) = self._fit_for(v, blocks), blocks.y.shape
        products = np.empty((n_groups, n_y, n_y, lanes))
        arrays = [*(np.ascontiguousarray(a) for a in v[:4]), z, blocks.y, blocks.used, _by_group(starts)]
        pointers = [*map(pointer_of, [*arrays, *results]), *[None] * (3 - len(results)), pointer_of(products)]
        self._predict(ctypes.c_long(n_groups), ctypes.c_long(length), *pointers)
        return _per_block(products)

    def adjoint(
        self, v: PredictorValues, blocks: Blocks, weighted: FloatArray, states: FloatArray, last: FloatArray
    ) -> Adjoint:
        """Run the adjoint backwards; see `PassEngine`."""
        z = self._fit_for(v, blocks)
        n_groups, length, n_z, lanes = z.shape
        n, n_y = len(v.F), len(v.C)
        first, sums = np.empty((n_groups, n, lanes)), np.empty((n + n_y, n + n_z))
        factors = np.empty((n_groups, length, n + n_y, lanes))
        size = np.ascontiguousarray(blocks.size, np.int64)
        arrays = [np.ascontiguousarray(a) for a in (v.F, v.C, weighted, states)] + [z, size, _by_group(last)]
        pointers = (pointer_of(a) for a in [*arrays, first, factors, sums])
        self._adjoint(ctypes.c_long(n_groups), ctypes.c_long(length), *pointers)
        return Adjoint(first.transpose(1, 0, 2).reshape(n, -1), sums, factors)

    def second(self, v: PredictorValues, blocks: Blocks, states: FloatArray, factors: FloatArray) -> Second:
        """Run the sensitivities of the states; see `PassEngine`."""
        z = self._fit_for(v, blocks)
        if self._second is None:
            self._second = load_library(_second_source(_arrays(self._pattern))).gbid_second
            self._second.restype = None
        n_groups, length, _, lanes = z.shape
        n_p, n, _ = v.dF.shape
        products, end_theta = np.empty((factors.shape[2], n_p, n)), np.empty((n_groups, n_p, n, lanes))
        arrays = [*(np.ascontiguousarray(a) for a in (v.F, v.dF, v.dG, states)), z, np.ascontiguousarray(factors)]
        pointers = (pointer_of(a) for a in [*arrays, products, end_theta])
        self._second(ctypes.c_long(n_groups), ctypes.c_long(length), *pointers)
        return Second(products, _per_block(end_theta).transpose(0, 2, 1))

    def sensitivities(
        self, v: PredictorValues, blocks: Blocks, prediction: Prediction, first: FloatArray, own: slice
    ) -> FloatArray:
        """Return the sensitivities of some blocks; see `PassEngine`."""
        z = self._fit_for(v, blocks)
        n_z, (n_p, n, _), n_y, length = z.shape[2], v.dF.shape, len(v.C), blocks.length
        m, count = n_p + n, own.stop - own.start
        onto_state = np.concatenate([v.dF, v.dG], axis=2).reshape(n_p * n, -1)
        onto_output = np.concatenate([v.dC, v.dH], axis=2).reshape(n_p * n_y, -1)
        entries = [array for matrix in (v.F, v.C, onto_state, onto_output) for array in _by_rows(matrix)]
        states, starts = np.ascontiguousarray(prediction.states), np.ascontiguousarray(first.transpose(0, 2, 1))
        sides = _aligned((2 * m * n + n + n_z + m * n_y * _CHUNK) * LANES)
        psi = np.empty((n_y * m, count, length))
        run = load_library(_sensitivity_source()).gbid_sensitivities
        run.restype = None
        sizes = (ctypes.c_long(size) for size in (n, n_p, n_y, n_z, length, own.start, own.stop))
        run(*sizes, *map(pointer_of, [*entries, states, z, blocks.used, starts, sides, psi]))
        return psi


def _by_rows(matrix: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Return where the rows of a matrix without its zeros begin and end, and the columns and values of its entries."""
    rows, columns = np.nonzero(matrix)
    ends = np.searchsorted(rows, np.arange(len(matrix) + 1)).astype(np.int64)
    return ends, columns.astype(np.int64), np.ascontiguousarray(matrix[rows, columns])


def _aligned(size: int) -> FloatArray:
    """Return an array of so many numbers at an address of a vector."""
    room = np.empty(size + LANES)
    return room[-(room.__array_interface__["data"][0] // 8) % LANES :][:size]


@lru_cache(maxsize=1)
def _sensitivity_source() -> str:
    return files("gbid.identify.kernel").joinpath("sensitivities.c").read_text(encoding="utf-8")


@lru_cache(maxsize=32)
def _source(arrays: tuple[tuple[tuple[int, ...], bytes], ...]) -> str:
    """Source for a pattern given as shapes and bytes: written once in a process."""
    return kernel_source(_kernel_pattern(arrays))


@lru_cache(maxsize=32)
def _second_source(arrays: tuple[tuple[tuple[int, ...], bytes], ...]) -> str:
    """Source of the second pass: written once in a process."""
    return second_source(_kernel_pattern(arrays))


def _kernel_pattern(arrays: tuple[tuple[tuple[int, ...], bytes], ...]) -> KernelPattern:
    return KernelPattern(*(np.frombuffer(data, np.bool_).reshape(shape) for shape, data in arrays))


def pattern_of(v: PredictorValues) -> KernelPattern:
    """Entries that differ from zero at one parameter value."""
    return KernelPattern(*(array != 0 for array in v[:8]))


def _pattern(samples: list[PredictorValues]) -> KernelPattern:
    """Return the entries that differ from zero at one of several parameter values."""
    pattern = pattern_of(samples[0])
    for sample in samples[1:]:
        pattern = pattern.union(pattern_of(sample))
    return pattern


def _arrays(pattern: KernelPattern) -> tuple[tuple[tuple[int, ...], bytes], ...]:
    return tuple((array.shape, array.tobytes()) for array in pattern.arrays())


def _by_group(values: FloatArray) -> FloatArray:
    """(n, W) to (n_groups, n, lanes)."""
    return np.ascontiguousarray(values.reshape(len(values), -1, LANES).transpose(1, 0, 2))


def _per_block(values: FloatArray) -> FloatArray:
    """(n_groups, ..., lanes) to (W, ...)."""
    return np.ascontiguousarray(np.moveaxis(values, -1, 1)).reshape(-1, *values.shape[1:-1])


def pointer_of(array: npt.NDArray[np.generic]) -> ctypes.c_void_p:
    """Return the address of an array for C."""
    return ctypes.c_void_p(array.__array_interface__["data"][0])  # half the time of array.ctypes
