"""C of a casadi.Function for eight columns at once, written from CasADi's own list of instructions."""

from __future__ import annotations

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


def lane_source(functions: dict[str, ca.Function]) -> str:
    """Return C functions of the same names, ``void name(const v *a0, ..., v *r0, ...)``, with dense columns.

    Raises
    ------
    NotImplementedError
        When a function has an operation that is unknown here.
    """
    met = {f.instruction_id(k) for f in functions.values() for k in range(f.n_instructions())}
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
    return "\n".join([*helpers, *(_function(name, f) for name, f in functions.items())])


def _function(name: str, f: ca.Function) -> str:
    given = [f"const v *restrict a{i}" for i in range(f.n_in())] + [f"v *restrict r{i}" for i in range(f.n_out())]
    lines = [f"static void {name}({', '.join(given)}) {{"]
    declared: set[int] = set()
    for k in range(f.n_instructions()):
        operation, into = f.instruction_id(k), f.instruction_output(k)
        if operation == ca.OP_OUTPUT:
            lines.append(f"  r{into[0]}[{into[1]}] = w{f.instruction_input(k)[0]};")
            continue
        at = into[0]
        kind = "" if at in declared else "v "
        declared.add(at)
        lines.append(f"  {kind}w{at} = {_value(f, k, operation)};")
    return "\n".join([*lines, "}"])


def _value(f: ca.Function, k: int, operation: int) -> str:
    if operation == ca.OP_CONST:
        return f"all({float(f.instruction_constant(k))!r})".replace("inf", "__builtin_inf()").replace(
            "nan", '__builtin_nan("")'
        )
    given = f.instruction_input(k)
    if operation == ca.OP_INPUT:
        return f"a{given[0]}[{given[1]}]"
    names = [f"w{i}" for i in given]
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
