"""Kernel of nonlinear predictors in C: each lane of the vector unit runs a block."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import groupby
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from gbid.core.arrays import BoolArray, FloatArray
from gbid.core.compiled import FLAGS, load_library, run_compiled
from gbid.identify.kernel.blocks import LANES, Blocks, BlockSums, Prediction, at_windows, per_block
from gbid.identify.kernel.linear import CompiledPasses, filled, reached
from gbid.identify.kernel.nonlinear import NonlinearKernel
from gbid.identify.kernel.sample import NonlinearValues, SampleFunctions
from gbid.identify.kernel.sums import SampleSums

_BY_LANE = "exp log sqrt sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh floor ceil erf log1p expm1"
_OF_ONE = {getattr(ca, f"OP_{name.upper()}"): name for name in _BY_LANE.split()}
_PAIRS_BY_LANE = "pow constpow fmin fmax fmod remainder atan2 copysign hypot"
_OF_TWO = {getattr(ca, f"OP_{name.upper()}"): name.removeprefix("const") for name in _PAIRS_BY_LANE.split()}
"""Functions that are called for one lane after the other."""
_EXPRESSIONS = {
    ca.OP_INPUT: "{0}",
    ca.OP_ASSIGN: "{0}",
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0}*{0}",
    ca.OP_TWICE: "2.0*{0}",
    ca.OP_INV: "1.0/{0}",
    ca.OP_LT: "one({0} < {1})",
    ca.OP_LE: "one({0} <= {1})",
    ca.OP_EQ: "one({0} == {1})",
    ca.OP_NE: "one({0} != {1})",
    ca.OP_NOT: "one({0} == 0.0)",
    ca.OP_IF_ELSE_ZERO: "kept({1}, {0} != 0.0)",
    ca.OP_AND: "one(({0} != 0.0) & ({1} != 0.0))",
    ca.OP_OR: "one(({0} != 0.0) | ({1} != 0.0))",
    ca.OP_FABS: "kept({0}, {0} > 0.0) - kept({0}, {0} < 0.0)",
    ca.OP_SIGN: "one({0} > 0.0) - one({0} < 0.0)",
    **{operation: f"{name}_({{0}})" for operation, name in _OF_ONE.items()},
    **{operation: f"{name}_({{0}}, {{1}})" for operation, name in _OF_TWO.items()},
}
"""Expressions of vectors."""
_OF_OUTPUT, _OF_STEP = (2, 3), (3, 4, 6)  # arguments that are the same for all samples: parameters, length of a step


def lane_source(functions: SampleFunctions) -> str:
    """Return C code of CasADi functions, with the signature ``void name(const v *a0, ..., v *r0, ...)``.

    What depends on the constant arguments alone, a fifth of a step with its derivatives, is computed once for a pass:
    ``name_once`` writes it to `c`, whose size is ``name_size``.

    Raises
    ------
    NotImplementedError
        When a function has an operation that is unknown here.
    """
    named = {name: f for name, f in functions._asdict().items() if isinstance(f, ca.Function)}
    met = {f.instruction_id(k) for f in named.values() for k in range(f.n_instructions())}
    helpers = [
        f"static inline v {name}_(v a) "
        f"{{ v r; for (int l = 0; l < WIDTH; l++) r[l] = __builtin_{name}(a[l]); return r; }}"
        for operation, name in _OF_ONE.items()
        if operation in met
    ]
    helpers += [
        f"static inline v {name}_(v a, v b) "
        f"{{ v r; for (int l = 0; l < WIDTH; l++) r[l] = __builtin_{name}(a[l], b[l]); return r; }}"
        for name in sorted({name for operation, name in _OF_TWO.items() if operation in met})
    ]
    dense = places_of(functions.step_jacobian.sparsity_out(2))
    return "\n".join([*helpers, *(_written(name, f, dense) for name, f in named.items())])


def _written(name: str, f: ca.Function, dense: Sequence[int]) -> str:
    """Return C code of a function, split into statements that are constant in a pass and statements that vary.

    The entries of the Jacobian of a step by its inputs go to places in dense columns, all others one after the other.
    """
    constant = _OF_STEP if name.startswith("step") else _OF_OUTPUT
    once: list[str] = []  # one statement for each constant value, all with names of their own
    lines: list[str] = []
    kept: dict[str, int] = {}  # constant values that the rest needs, and their places
    at: dict[int, str] = {}  # name of the value in each place of CasADi's memory
    declared: set[int] = set()

    def seen(value: str) -> str:
        """Return the name by which C statements of the varying part refer to a value."""
        return f"c[{kept.setdefault(value, len(kept))}]" if value.startswith("k") else value

    for k in range(f.n_instructions()):
        operation, into, given = f.instruction_id(k), f.instruction_output(k), f.instruction_input(k)
        if operation == ca.OP_OUTPUT:
            row = dense[into[1]] if (name, into[0]) == ("step_jacobian", 2) else into[1]
            lines.append(f"  r{into[0]}[{row}] = {seen(at[given[0]])};")
            continue
        if operation == ca.OP_INPUT:
            fixed, names = given[0] in constant, [f"a{given[0]}[{given[1]}]"]
        else:
            fixed, names = all(at[i].startswith("k") for i in given), [at[i] for i in given]
        if fixed:
            at[into[0]] = f"k{len(once)}"
            once.append(f"  const v {at[into[0]]} = {_value(f, k, operation, names)};")
        else:
            at[into[0]] = f"w{into[0]}"
            kind = "" if into[0] in declared else "v "
            lines.append(f"  {kind}{at[into[0]]} = {_value(f, k, operation, list(map(seen, names)))};")
            declared.add(into[0])
    once += [f"  c[{place}] = {value};" for value, place in kept.items()]
    arguments = [f"const v *restrict a{i}" for i in range(f.n_in())]
    results = [f"v *restrict r{i}" for i in range(f.n_out())]
    same = [arguments[i] for i in constant]
    return "\n".join(
        [
            f"enum {{ {name}_size = {max(1, len(kept))} }};",
            f"static void {name}_once({', '.join([*same, 'v *restrict c'])}) {{",
            *once,
            "}",
            f"static void {name}({', '.join([*arguments, 'const v *restrict c', *results])}) {{",
            *lines,
            "}",
        ]
    )


def _value(f: ca.Function, k: int, operation: int, names: list[str]) -> str:
    if operation == ca.OP_CONST:
        return f"all({float(f.instruction_constant(k))!r})".replace("inf", "__builtin_inf()").replace(
            "nan", '__builtin_nan("")'
        )
    if operation not in _EXPRESSIONS:
        raise NotImplementedError(f"operation {operation} of CasADi has no C code here")
    return _EXPRESSIONS[operation].format(*names)


# Products with the Jacobians of a sample: all matrices but the Jacobian F of a step have dense columns. The rows of a
# column that can differ from zero are known: only these are multiplied, and all others stay zero from the start.

_MOST_KINDS = 4  # of columns, by their rows: more of them would make the source long
_ARGUMENTS = "const v *restrict a, const v *s, const v *restrict b, v *r"


def product_source(functions: SampleFunctions) -> str:
    """Return C code that copies Jacobians to dense columns, multiplies columns by them, and adds error feedback."""
    by_start, by_state, by_theta = (functions.output_jacobian.sparsity_out(i) for i in (3, 4, 5))
    of_step, of_input = (functions.step_jacobian.sparsity_out(i) for i in (1, 2))
    F, G, C, D, X = (_pattern(each) for each in (of_step, of_input, by_state, by_theta, by_start))
    n, n_p = X.shape
    n_e = G.shape[1] - n_p
    through = reached(F, G)
    fed = [through[:, :n_e] @ each[:n_e] for each in (C, D)]
    sample, onto = reached(F, F) | fed[0], through[:, n_e:] | fed[1]  # by the state, by theta
    M = np.hstack([sample, through[:, :n_e], onto])
    S = np.hstack([reached(sample, onto | X), reached(sample, np.eye(n, dtype=bool))])
    left = np.hstack([fed[0] & ~F, np.zeros((n, n_e), bool), fed[1] & ~G[:, n_e:]])
    to_r, entry_at = "const v *restrict a, v *restrict r", {place: k for k, place in enumerate(places_of(by_theta))}
    whole = (f"a[{entry_at[i]}]" if i in entry_at else "all(0.0)" for i in range(by_theta.size1() * (n_p + n)))
    step = [f"  r[{place}] = a[{k}];" for k, place in enumerate(places_of(of_step))]
    emptied = [f"  r[{place}] = all(0.0);" for place in _dense(left).values()]  # feedback of the last sample
    start = [f"  r[{place}] += a[{k}];" for k, place in enumerate(places_of(by_start))]
    output = [f"  r[{row}] += a[{k}]*s[{column}];" for k, row, column in _entries(by_state)]
    return "\n".join(
        [
            _inline("put_output", to_r, [f"  r[{i}] = {value};" for i, value in enumerate(whole)]),
            _inline("put_first", to_r, [*step, *emptied]),
            _inline("add_start", to_r, start),
            _inline("add_output", "const v *restrict a, const v *restrict s, v *restrict r", output),
            *_products("step", _numbered(of_step), M, slice(n)),
            *_products("sample", _dense(sample), S, slice(n_p, None)),
            _feed(by_state, by_theta, through) if functions.feeds_back else "",
        ]
    )


def places_of(sparsity: ca.Sparsity) -> list[int]:
    """Return the positions of a sparse matrix's entries in its dense columns."""
    return [column * sparsity.size1() + row for _, row, column in _entries(sparsity)]


def _pattern(sparsity: ca.Sparsity) -> BoolArray:
    return np.array(ca.DM(sparsity, 1.0).full() != 0, bool)


def _entries(sparsity: ca.Sparsity) -> list[tuple[int, int, int]]:
    return list(zip(range(sparsity.nnz()), sparsity.row(), sparsity.get_col(), strict=True))


def _numbered(sparsity: ca.Sparsity) -> dict[tuple[int, int], int]:
    return {(row, column): k for k, row, column in _entries(sparsity)}


def _dense(pattern: BoolArray) -> dict[tuple[int, int], int]:
    return {(int(row), int(column)): int(column) * len(pattern) + int(row) for column, row in np.argwhere(pattern.T)}


def _products(name: str, matrix: dict[tuple[int, int], int], columns: BoolArray, n_plain: slice) -> Iterator[str]:
    """Yield C code of ``r = A s`` for plain columns (``NAME_states``) and ``r = b + A s`` for others (``NAME_rest``).

    They are loops over neighbours of the same kind: with the same rows that can differ from zero.
    """
    rows_of = [tuple(np.flatnonzero(column).tolist()) for column in columns.T]
    if len(set(rows_of)) > _MOST_KINDS:
        rows_of = [tuple(np.flatnonzero(columns.any(axis=1)).tolist())] * len(rows_of)
    kinds = sorted(set(rows_of))
    every = range(len(rows_of))
    for what, chosen in (("states", every[n_plain]), ("rest", [c for c in every if c not in every[n_plain]])):
        calls = []
        for rows, run in groupby(chosen, key=rows_of.__getitem__):
            column, *more = run
            ends = f"int c = {column - chosen[0]}; c < {column - chosen[0] + len(more) + 1}; c++"
            calls.append(f"  for ({ends}) {name}_{what}_{kinds.index(rows)}(a, s + c*N, b + c*N, r + c*N);")
        for number, rows in enumerate(kinds):
            lines = [f"  const v s{i} = s[{i}];" for i in rows]
            for row in rows:
                terms = [f"b[{row}]"] if what == "rest" else []
                terms += [f"a[{matrix[row, i]}]*s{i}" for i in rows if (row, i) in matrix]
                lines.append(f"  const v r{row} = {' + '.join(terms) or 'all(0.0)'};")
            lines += [f"  r[{row}] = r{row};" for row in rows]
            yield _inline(f"{name}_{what}_{number}", _ARGUMENTS, lines)
        yield _inline(f"{name}_{what}", _ARGUMENTS, calls)


def _feed(by_state: ca.Sparsity, by_theta: ca.Sparsity, through: BoolArray) -> str:
    """C code that subtracts the feedback of the error from the Jacobians with respect to state and theta."""
    lines = [
        f"  {argument}[{column}*N + {i}] -= {entry}[{k}]*by_e[{row}*N + {i}];"
        for entry, argument, sparsity in (("C", "by_x", by_state), ("D", "by_theta", by_theta))
        for k, row, column in _entries(sparsity)
        for i in np.flatnonzero(through[:, row])
    ]
    arguments = ("const v *restrict C", "const v *restrict D", "const v *restrict by_e")
    return _inline("feed", ", ".join([*arguments, "v *restrict by_x", "v *restrict by_theta"]), lines)


def _inline(name: str, arguments: str, lines: list[str]) -> str:
    return "\n".join([f"static inline void {name}({arguments}) {{", *lines, "}"])


# With -O2 the sums of the pass stay in memory, and it takes 70 % longer.
# As for the linear kernels, but sums keep their order.
_FLAGS = tuple(flag for flag in FLAGS if flag not in ("-fno-signed-zeros", "-fassociative-math"))


class LanesKernel(CompiledPasses, NonlinearKernel):
    """Compiled kernel of a nonlinear predictor, with a block in each vector lane; a `Kernel`.

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
        super().__init__(functions)
        self._n, self._n_p = functions.output.size1_in(0), functions.output.size1_in(2)
        self._library = load_library(source_of(functions), _FLAGS)
        self.note = self._library.note

    def begin(self, v: NonlinearValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the state at the start of each block; see `Kernel`."""
        if blocks.per_window == 1:
            return at_windows(blocks, starts)
        return self.begins([v], blocks, starts)[0]

    def begins(self, points: Sequence[NonlinearValues], blocks: Blocks, starts: FloatArray) -> list[FloatArray]:
        """Return the states at the starts of blocks for several points, run side by side; see `SampleKernel`.

        Points with other whole samples in their delays have other regressors, and are run one by one.
        """
        v, n_blocks, n_windows = points[0], len(blocks.size), blocks.n_windows
        if blocks.per_window == 1 or any(other.shift != v.shift for other in points):
            return super().begins(points, blocks, starts)
        begin = np.zeros((len(points), n_blocks, self._n))
        thetas = np.repeat([other.theta for other in points], n_windows, axis=0)
        rows = np.repeat(np.arange(len(points)) * n_blocks, n_windows)
        windows = [np.tile(each, len(points)) for each in (blocks.window_first, blocks.window_size)]
        arrays = [blocks.z(v.shift), *windows, rows, np.tile(starts, (len(points), 1))]
        self._call("begin", v._replace(theta=thetas), blocks, len(thetas), arrays, [begin])
        return list(begin.transpose(0, 2, 1))

    def run_forwards(
        self, v: NonlinearValues, blocks: Blocks, begin: FloatArray, results: Sequence[FloatArray | None]
    ) -> None:
        """Compute states, errors, ends and products of errors, into given arrays; see `CompiledPasses`."""
        arrays = [blocks.z(v.shift), blocks.y, blocks.used, blocks.by_group(begin)]
        self._call("passed", v, blocks, len(blocks.y), arrays, results)

    def sample_sums(self, v: NonlinearValues, blocks: Blocks, begin: FloatArray, root: FloatArray) -> SampleSums:
        """Return the sums of a pass with sensitivities; see `SampleKernel`."""
        n, n_p, (n_groups, _, n_y, lanes) = self._n, self._n_p, blocks.y.shape
        hessian, products = np.empty((n_p, n_p)), np.empty((n_y, n_y))
        shapes = (n_p + n,), (n_p, n), (n, n), (n,), (n_p + n, n)
        by_group = [np.empty((n_groups, *shape, lanes)) for shape in shapes]
        arrays = [root, blocks.z(v.shift), blocks.y, blocks.used, blocks.size, blocks.by_group(begin)]
        self._call("sums", v, blocks, n_groups, arrays, [hessian, products, *by_group])
        gradient, mixed, by_start, end, slopes = map(per_block, by_group)
        by_theta, onto = gradient[:, :n_p], slopes.transpose(0, 2, 1)
        sums = BlockSums(hessian, products, by_theta, gradient[:, n_p:], mixed, end, onto[:, :, :n_p])
        return SampleSums(sums, by_start, onto[:, :, n_p:])

    def slopes(
        self, v: NonlinearValues, blocks: Blocks, prediction: Prediction, first: FloatArray, some: slice
    ) -> FloatArray:
        """Return the sensitivities of some blocks; see `SampleKernel`."""
        m, n_y, count = self._n_p + self._n, blocks.y.shape[2], some.stop - some.start
        groups = slice(some.start // LANES, -(-some.stop // LANES))
        skipped, n_groups = some.start - groups.start * LANES, groups.stop - groups.start
        starts = np.zeros((n_groups * LANES, m, self._n))
        starts[skipped : skipped + count] = first.transpose(0, 2, 1)
        slopes = np.empty((n_groups, blocks.length, m, n_y, LANES))
        of_lanes = starts.reshape(n_groups, LANES, m, self._n).transpose(0, 2, 3, 1)
        arrays = [blocks.z(v.shift)[groups], prediction.states[groups, 0], of_lanes]
        self._call("psi", v, blocks, n_groups, arrays, [slopes])
        psi = slopes.transpose(1, 3, 2, 0, 4).reshape(blocks.length, n_y, m, -1)
        return psi[..., skipped : skipped + count]

    def _call(
        self,
        name: str,
        v: NonlinearValues,
        blocks: Blocks,
        count: int,
        arrays: Sequence[npt.NDArray[Any]],
        results: Sequence[npt.NDArray[Any] | None],
    ) -> None:
        """Run a compiled function over a number of groups or windows of blocks."""
        function = getattr(self._library, f"gbid_{name}")
        run_compiled(function, (count, blocks.length, v.steps), [v.theta, v.known, *arrays], results)


@lru_cache(maxsize=32)
def source_of(functions: SampleFunctions) -> str:
    """Return the C source of the kernel of a predictor."""
    n, n_y, n_p = functions.output.size1_in(0), functions.output.size1_out(1), functions.output.size1_in(2)
    sizes = {
        "N": n,
        "NP": n_p,
        "NM": n + functions.step_jacobian.size2_out(2),
        "NZ": functions.output.size1_in(1),
        "NY": n_y,
        "NQ": functions.output.size1_in(3),
        "FEEDS": int(functions.feeds_back),
    }
    parts = {"FUNCTIONS": lane_source(functions), "PRODUCTS": product_source(functions)}
    return filled("lane_template.c", {**parts, **sizes})
