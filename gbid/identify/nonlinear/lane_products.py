"""C of the products with the Jacobians of a sample, in which entries that are always zero do not occur."""

from __future__ import annotations

import casadi as ca

from gbid.identify.nonlinear.sample_functions import SampleFunctions


def product_source(functions: SampleFunctions) -> str:
    """Return C functions that put Jacobians in place, multiply columns by them, and feed errors back."""
    n = functions.output.size1_in(0)
    by_start, by_state, by_theta = (functions.output_jacobian.sparsity_out(i) for i in (3, 4, 5))
    of_step, own = (functions.step_jacobian.sparsity_out(i) for i in (1, 2))
    return "\n".join(
        [
            _put("put_output", by_theta, functions.output.size1_in(2) + n),
            _put("put_step", of_step),
            _put("put_own", own),
            _onto("add_start", by_start),
            _onto_column("add_output", by_state),
            _product("add_step", of_step, dense=False),
            _product("add_sample", _of_sample(functions), dense=True),
            _feed(by_state, by_theta),
        ]
    )


def _of_sample(functions: SampleFunctions) -> ca.Sparsity:
    """Return where the Jacobian of a sample by its state can have entries, whatever the number of steps."""
    by_state, of_step, own = (
        ca.DM(sparsity, 1.0)
        for sparsity in (
            functions.output_jacobian.sparsity_out(4),
            functions.step_jacobian.sparsity_out(1),
            functions.step_jacobian.sparsity_out(2),
        )
    )
    n = of_step.size1()
    one = of_step + (own[:, : by_state.size1()] @ by_state if functions.feeds_back else 0)
    found = one
    for _ in range(n):  # a product of more factors has no other entries
        found = found + found @ one
        found = ca.DM(found.sparsity(), 1.0)
    return found.sparsity()


def _entries(sparsity: ca.Sparsity) -> list[tuple[int, int, int]]:
    return list(zip(range(sparsity.nnz()), sparsity.row(), sparsity.get_col(), strict=True))


def _put(name: str, sparsity: ca.Sparsity, columns: int = 0) -> str:
    """C that writes a Jacobian in dense columns, with zeros to the last of so many columns."""
    rows, columns = sparsity.size1(), columns or sparsity.size2()
    there = {column * rows + row: k for k, row, column in _entries(sparsity)}
    lines = [f"  r[{i}] = {f'a[{there[i]}]' if i in there else 'all(0.0)'};" for i in range(rows * columns)]
    return _inline(name, "const v *restrict a, v *restrict r", lines)


def _onto(name: str, sparsity: ca.Sparsity) -> str:
    """C that adds a Jacobian to dense columns."""
    lines = [f"  r[{column * sparsity.size1() + row}] += a[{k}];" for k, row, column in _entries(sparsity)]
    return _inline(name, "const v *restrict a, v *restrict r", lines)


def _onto_column(name: str, sparsity: ca.Sparsity) -> str:
    """C that adds the product of a Jacobian and a column to a column."""
    lines = [f"  r[{row}] += a[{k}]*s[{column}];" for k, row, column in _entries(sparsity)]
    return _inline(name, "const v *restrict a, const v *restrict s, v *restrict r", lines)


def _product(name: str, sparsity: ca.Sparsity, *, dense: bool) -> str:
    """C of ``r = b + A s`` for a square Jacobian, of which `dense` columns are given or the entries alone."""
    n = sparsity.size1()
    lines = [f"  v s{i} = s[{i}], r{i} = b[{i}];" for i in range(n)]
    lines += [f"  r{row} += a[{column * n + row if dense else k}]*s{column};" for k, row, column in _entries(sparsity)]
    lines += [f"  r[{i}] = r{i};" for i in range(n)]
    return _inline(name, "const v *a, const v *s, const v *b, v *r", lines)


def _feed(by_state: ca.Sparsity, by_theta: ca.Sparsity) -> str:
    """C that takes what the error, ``y - yhat``, feeds back from the Jacobians by the state and by theta."""
    lines = [
        f"  for (int i = 0; i < N; i++) {onto}[{column}*N + i] -= {entry}[{k}]*by_e[{row}*N + i];"
        for entry, onto, sparsity in (("C", "by_x", by_state), ("D", "by_theta", by_theta))
        for k, row, column in _entries(sparsity)
    ]
    arguments = ("const v *restrict C", "const v *restrict D", "const v *restrict by_e")
    return _inline("feed", ", ".join([*arguments, "v *restrict by_x", "v *restrict by_theta"]), lines)


def _inline(name: str, arguments: str, lines: list[str]) -> str:
    return "\n".join([f"static inline void {name}({arguments}) {{", *lines, "}"])
