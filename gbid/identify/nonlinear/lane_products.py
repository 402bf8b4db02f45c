"""C of the products with the Jacobians of a sample, in which entries that are always zero do not occur.

All matrices but the Jacobian F of a step have dense columns. What can differ from zero in a column is known: with
those rows a column is multiplied, and all others are left as they are, zero from the start.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby

import casadi as ca
import numpy as np

from gbid.arrays import BoolArray
from gbid.identify.kernel.kernel_pattern import reached
from gbid.identify.nonlinear.sample_functions import SampleFunctions

_MOST_KINDS = 4  # of columns, by their rows: more of them would make the source long
_ARGUMENTS = "const v *restrict a, const v *s, const v *restrict b, v *r"


def product_source(functions: SampleFunctions) -> str:
    """Return C functions that put Jacobians in place, multiply columns by them, and feed errors back."""
    by_start, by_state, by_theta = (functions.output_jacobian.sparsity_out(i) for i in (3, 4, 5))
    of_step, own = (functions.step_jacobian.sparsity_out(i) for i in (1, 2))
    F, G, C, D, X = (_pattern(each) for each in (of_step, own, by_state, by_theta, by_start))
    n, n_p = X.shape
    n_e = G.shape[1] - n_p
    through = reached(F, G)
    fed = [through[:, :n_e] @ each[:n_e] for each in (C, D)]
    sample, onto = reached(F, F) | fed[0], through[:, n_e:] | fed[1]  # by the state, by theta
    M = np.hstack([sample, through[:, :n_e], onto])
    S = np.hstack([reached(sample, onto | X), reached(sample, np.eye(n, dtype=bool))])
    left = np.hstack([fed[0] & ~F, np.zeros((n, n_e), bool), fed[1] & ~G[:, n_e:]])
    return "\n".join(
        [
            _put("put_output", by_theta, n_p + n),
            _put_first(of_step, left),
            _onto("add_start", by_start),
            _onto_column("add_output", by_state),
            *_products("step", _numbered(of_step), M, slice(n)),
            *_products("sample", _dense(sample), S, slice(n_p, None)),
            _feed(by_state, by_theta, through) if functions.feeds_back else "",
        ]
    )


def places_of(sparsity: ca.Sparsity) -> list[int]:
    """Return where the entries of a matrix are in its dense columns."""
    return [column * sparsity.size1() + row for _, row, column in _entries(sparsity)]


def _pattern(sparsity: ca.Sparsity) -> BoolArray:
    return np.array(ca.DM(sparsity, 1.0).full() != 0, bool)


def _entries(sparsity: ca.Sparsity) -> list[tuple[int, int, int]]:
    return list(zip(range(sparsity.nnz()), sparsity.row(), sparsity.get_col(), strict=True))


def _numbered(sparsity: ca.Sparsity) -> dict[tuple[int, int], int]:
    return {(row, column): k for k, row, column in _entries(sparsity)}


def _dense(pattern: BoolArray) -> dict[tuple[int, int], int]:
    return {(int(row), int(column)): int(column) * len(pattern) + int(row) for column, row in np.argwhere(pattern.T)}


def _put(name: str, sparsity: ca.Sparsity, columns: int) -> str:
    """C that writes a Jacobian in dense columns, with zeros to the last of so many columns."""
    there = {place: k for k, place in enumerate(places_of(sparsity))}
    every = range(sparsity.size1() * columns)
    lines = [f"  r[{i}] = {f'a[{there[i]}]' if i in there else 'all(0.0)'};" for i in every]
    return _inline(name, "const v *restrict a, v *restrict r", lines)


def _put_first(of_step: ca.Sparsity, left: BoolArray) -> str:
    """C that writes the Jacobian of the first step, and zeros where the feedback of the last sample has been."""
    lines = [f"  r[{place}] = a[{k}];" for k, place in enumerate(places_of(of_step))]
    lines += [f"  r[{place}] = all(0.0);" for place in _dense(left).values()]
    return _inline("put_first", "const v *restrict a, v *restrict r", lines)


def _onto(name: str, sparsity: ca.Sparsity) -> str:
    """C that adds a Jacobian to dense columns."""
    lines = [f"  r[{place}] += a[{k}];" for k, place in enumerate(places_of(sparsity))]
    return _inline(name, "const v *restrict a, v *restrict r", lines)


def _onto_column(name: str, sparsity: ca.Sparsity) -> str:
    """C that adds the product of a Jacobian and a column to a column."""
    lines = [f"  r[{row}] += a[{k}]*s[{column}];" for k, row, column in _entries(sparsity)]
    return _inline(name, "const v *restrict a, const v *restrict s, v *restrict r", lines)


def _products(name: str, matrix: dict[tuple[int, int], int], columns: BoolArray, n_plain: slice) -> Iterator[str]:
    """Yield C of ``r = A s`` over the plain columns, ``NAME_states``, and ``r = b + A s`` over the rest, ``NAME_rest``.

    They are loops over neighbours of the same kind: with the same rows that can differ from zero.
    """
    own = [tuple(np.flatnonzero(column).tolist()) for column in columns.T]
    if len(set(own)) > _MOST_KINDS:
        own = [tuple(np.flatnonzero(columns.any(axis=1)).tolist())] * len(own)
    kinds = sorted(set(own))
    every = range(len(own))
    for what, chosen in (("states", every[n_plain]), ("rest", [c for c in every if c not in every[n_plain]])):
        calls = []
        for rows, run in groupby(chosen, key=own.__getitem__):
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
    """C that takes what the error, ``y - yhat``, feeds back from the Jacobians by the state and by theta."""
    lines = [
        f"  {onto}[{column}*N + {i}] -= {entry}[{k}]*by_e[{row}*N + {i}];"
        for entry, onto, sparsity in (("C", "by_x", by_state), ("D", "by_theta", by_theta))
        for k, row, column in _entries(sparsity)
        for i in np.flatnonzero(through[:, row])
    ]
    arguments = ("const v *restrict C", "const v *restrict D", "const v *restrict by_e")
    return _inline("feed", ", ".join([*arguments, "v *restrict by_x", "v *restrict by_theta"]), lines)


def _inline(name: str, arguments: str, lines: list[str]) -> str:
    return "\n".join([f"static inline void {name}({arguments}) {{", *lines, "}"])
