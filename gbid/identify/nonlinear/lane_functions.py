"""C of a casadi.Function for eight columns at once, written from CasADi's own list of instructions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import casadi as ca

_BINARY = {ca.OP_ADD: "+", ca.OP_SUB: "-", ca.OP_MUL: "*", ca.OP_DIV: "/"}
_COMPARED = {ca.OP_LT: "<", ca.OP_LE: "<=", ca.OP_EQ: "==", ca.OP_NE: "!="}
_UNARY = {
    ca.OP_ASSIGN: "{0}",
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0}*{0}",
    ca.OP_TWICE: "2.0*{0}",
    ca.OP_INV: "1.0/{0}",
    ca.OP_NOT: "one({0} == 0.0)",
    ca.OP_IF_ELSE_ZERO: "kept({1}, {0} != 0.0)",
    ca.OP_AND: "one(({0} != 0.0) & ({1} != 0.0))",
    ca.OP_OR: "one(({0} != 0.0) | ({1} != 0.0))",
    ca.OP_FABS: "kept({0}, {0} > 0.0) - kept({0}, {0} < 0.0)",
    ca.OP_SIGN: "one({0} > 0.0) - one({0} < 0.0)",
}
"""Expressions of vectors."""
_OF_ONE = {
    ca.OP_EXP: "exp",
    ca.OP_LOG: "log",
    ca.OP_SQRT: "sqrt",
    ca.OP_SIN: "sin",
    ca.OP_COS: "cos",
    ca.OP_TAN: "tan",
    ca.OP_ASIN: "asin",
    ca.OP_ACOS: "acos",
    ca.OP_ATAN: "atan",
    ca.OP_SINH: "sinh",
    ca.OP_COSH: "cosh",
    ca.OP_TANH: "tanh",
    ca.OP_ASINH: "asinh",
    ca.OP_ACOSH: "acosh",
    ca.OP_ATANH: "atanh",
    ca.OP_FLOOR: "floor",
    ca.OP_CEIL: "ceil",
    ca.OP_ERF: "erf",
    ca.OP_LOG1P: "log1p",
    ca.OP_EXPM1: "expm1",
}
_OF_TWO = {
    ca.OP_POW: "pow",
    ca.OP_CONSTPOW: "pow",
    ca.OP_FMIN: "fmin",
    ca.OP_FMAX: "fmax",
    ca.OP_FMOD: "fmod",
    ca.OP_REMAINDER: "remainder",
    ca.OP_ATAN2: "atan2",
    ca.OP_COPYSIGN: "copysign",
    ca.OP_HYPOT: "hypot",
}
"""Functions that are called for one lane after the other."""

LANE_TYPES = """\
typedef double v __attribute__((vector_size(64)));
typedef double u __attribute__((vector_size(64), aligned(8)));
typedef long long m8 __attribute__((vector_size(64)));
static inline v all(double a) { return (v){0} + a; }
static inline v kept(v a, m8 live) { return (v)((m8)a & live); }
static inline v one(m8 is) { return kept(all(1.0), is); }
"""


class LaneFunction(NamedTuple):
    """A casadi.Function, and how it is written.

    Attributes
    ----------
    function : casadi.Function
        The function.
    constant : tuple of int
        Arguments that are the same for all samples of a pass.
    places : dict of int to sequence of int
        Where the entries of a result go; one after the other without it.
    """

    function: ca.Function
    constant: tuple[int, ...]
    places: Mapping[int, Sequence[int]] = {}


def lane_source(functions: Mapping[str, LaneFunction]) -> str:
    """Return C functions of the same names, ``void name(const v *a0, ..., const v *c, v *r0, ...)``.

    What depends on the constant arguments alone, a fifth of a step with its derivatives, is computed once for a pass:
    ``name_once`` writes it to `c`, whose size is ``name_size``.

    Raises
    ------
    NotImplementedError
        When a function has an operation that is unknown here.
    """
    each = [own.function for own in functions.values()]
    met = {f.instruction_id(k) for f in each for k in range(f.n_instructions())}
    helpers = [
        f"static inline v {name}_(v a) {{ v r; for (int l = 0; l < 8; l++) r[l] = __builtin_{name}(a[l]); return r; }}"
        for operation, name in _OF_ONE.items()
        if operation in met
    ]
    helpers += [
        f"static inline v {name}_(v a, v b) "
        f"{{ v r; for (int l = 0; l < 8; l++) r[l] = __builtin_{name}(a[l], b[l]); return r; }}"
        for name in sorted({name for operation, name in _OF_TWO.items() if operation in met})
    ]
    return "\n".join([*helpers, *(_written(name, own) for name, own in functions.items())])


def _written(name: str, own: LaneFunction) -> str:
    """Return C of a function, and of the part of it that is constant in a pass."""
    f = own.function
    once: list[str] = []  # one statement for each constant value, all with names of their own
    lines: list[str] = []
    kept: dict[str, int] = {}  # constant values that the rest needs, and their places
    at: dict[int, str] = {}  # name of the value in each place of CasADi's memory
    declared: set[int] = set()

    def seen(value: str) -> str:
        """Return how the rest of the function names a value."""
        return f"c[{kept.setdefault(value, len(kept))}]" if value.startswith("k") else value

    for k in range(f.n_instructions()):
        operation, into, given = f.instruction_id(k), f.instruction_output(k), f.instruction_input(k)
        if operation == ca.OP_OUTPUT:
            row = own.places[into[0]][into[1]] if into[0] in own.places else into[1]
            lines.append(f"  r{into[0]}[{row}] = {seen(at[given[0]])};")
            continue
        if operation == ca.OP_INPUT:
            fixed, names = given[0] in own.constant, [f"a{given[0]}[{given[1]}]"]
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
    same = [arguments[i] for i in own.constant]
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
    if operation == ca.OP_INPUT:
        return names[0]
    if operation in _BINARY:
        return f"{names[0]} {_BINARY[operation]} {names[1]}"
    if operation in _COMPARED:
        return f"one({names[0]} {_COMPARED[operation]} {names[1]})"
    if operation in _UNARY:
        return _UNARY[operation].format(*names)
    if operation in _OF_ONE:
        return f"{_OF_ONE[operation]}_({names[0]})"
    if operation in _OF_TWO:
        return f"{_OF_TWO[operation]}_({names[0]}, {names[1]})"
    raise NotImplementedError(f"operation {operation} of casadi")
