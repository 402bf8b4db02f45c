"""Small faults that a test should notice: one operator, number, argument or statement of a source file changed.

A mutant is a piece of text in its place and what stands there instead. Everything else of the file, its lines and
comments, stays as it is. Words are left alone: docstrings, messages of errors, types, imports.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

COMPARISONS: dict[type[ast.cmpop], tuple[str, ...]] = {
    ast.Lt: ("<=", ">"), ast.LtE: ("<", ">="), ast.Gt: (">=", "<"), ast.GtE: (">", "<="), ast.Eq: ("!=",),
    ast.NotEq: ("==",), ast.Is: ("is not",), ast.IsNot: ("is",), ast.In: ("not in",), ast.NotIn: ("in",),
}  # fmt: skip
ARITHMETIC: dict[type[ast.operator], str] = {
    ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.FloorDiv: "*", ast.Mod: "*", ast.Pow: "*",
}  # fmt: skip
OPPOSITES = {
    "min": "max", "minimum": "maximum", "argmin": "argmax", "any": "all", "floor": "ceil", "real": "imag",
}  # fmt: skip
OPPOSITES |= {there: here for here, there in OPPOSITES.items()}
GUARDS = {"strict", "optimize", "check_finite", "overwrite_a", "stacklevel"}
"""Named arguments that change no result while all is well."""
Faults = Iterator[tuple[ast.AST, str]]


@dataclass(frozen=True)
class Mutant:
    """One fault: `old`, at `start` of the file's text, becomes `new`."""

    file: str
    function: str
    line: int
    start: int
    old: str
    new: str

    def apply(self, text: str) -> str:
        """Return the file's text with the fault in it."""
        if not text[self.start :].startswith(self.old):
            raise ValueError(f"{self.file}:{self.line} is no longer what was mutated")
        return text[: self.start] + self.new + text[self.start + len(self.old) :]

    as_dict = asdict


def mutants(path: Path, root: Path) -> list[Mutant]:
    """Return all mutants of a source file."""
    text = path.read_text(encoding="utf-8")
    lines = [0]
    for line in text.splitlines(keepends=True):
        lines.append(lines[-1] + len(line))

    def offset(row: int, column: int) -> int:  # a syntax tree counts columns in bytes
        line = text[lines[row - 1] : lines[row]]
        return lines[row - 1] + len(line.encode()[:column].decode())

    found = []
    for function, node, new in _walk(ast.parse(text), ""):
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        start, end = offset(node.lineno, node.col_offset), offset(node.end_lineno, node.end_col_offset)
        found.append(Mutant(path.relative_to(root).as_posix(), function, node.lineno, start, text[start:end], new))
    return found


def is_another_program(mutant: Mutant, root: Path) -> bool:
    """Return whether a mutant is a program at all, and another one than the file."""
    text = (root / mutant.file).read_text(encoding="utf-8")
    try:
        return ast.dump(ast.parse(mutant.apply(text))) != ast.dump(ast.parse(text))
    except SyntaxError:
        return False


def _walk(node: ast.AST, function: str) -> Iterator[tuple[str, ast.expr | ast.stmt, str]]:
    """Faults of a node and of all below it, with the function they are in."""
    if isinstance(node, ast.Raise | ast.JoinedStr | ast.Import | ast.ImportFrom) or _is_word(node):
        return
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        function = f"{function}.{node.name}".lstrip(".")
        below: list[ast.AST] = [*node.body]
        below += (
            [d for d in node.args.defaults + node.args.kw_defaults if d] if isinstance(node, ast.FunctionDef) else []
        )
    elif isinstance(node, ast.keyword) and node.arg in GUARDS:
        return
    elif isinstance(node, ast.AnnAssign):
        below = [node.value] if node.value else []
    else:
        below = [*ast.iter_child_nodes(node)]
    if isinstance(node, ast.expr | ast.stmt):
        for at, new in _faults(node):
            assert isinstance(at, ast.expr | ast.stmt)
            yield function, at, new
    for child in below:
        yield from _walk(child, function)


def _is_word(node: ast.AST) -> bool:
    """Whether a statement is a docstring, a block for type checkers, or the list of public names."""
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Constant)
    if isinstance(node, ast.If):
        return ast.unparse(node.test) == "TYPE_CHECKING"
    return isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"


def _faults(node: ast.expr | ast.stmt) -> Faults:
    match node:
        case ast.Compare(left=left, ops=[op], comparators=[right]):
            for word in COMPARISONS[type(op)]:
                yield node, f"({ast.unparse(left)} {word} {ast.unparse(right)})"
        case ast.BinOp(op=ast.MatMult()):
            yield node, f"({ast.unparse(node.right)} @ {ast.unparse(node.left)})"
        case ast.BinOp(left=left, op=op, right=right) if type(op) in ARITHMETIC:
            if not any(isinstance(side, ast.Constant | ast.JoinedStr) and not _number(side) for side in (left, right)):
                yield node, f"(({ast.unparse(left)}) {ARITHMETIC[type(op)]} ({ast.unparse(right)}))"
        case ast.UnaryOp(op=ast.USub() | ast.Not() | ast.Invert(), operand=operand):
            yield node, f"({ast.unparse(operand)})"
        case ast.BoolOp(op=op, values=values):
            word = " or " if isinstance(op, ast.And) else " and "
            yield node, f"({word.join(f'({ast.unparse(v)})' for v in values)})"
        case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test):
            yield test, f"(not ({ast.unparse(test)}))"
        case ast.comprehension(ifs=[test, *_]):
            yield test, f"(not ({ast.unparse(test)}))"
        case ast.Constant(value=bool(value)):
            yield node, str(not value)
        case ast.Constant(value=int(value)):
            yield node, str(value + 1)
        case ast.Constant(value=float(value)):
            yield node, repr(2.0 * value if value else 1.0)
        case ast.Break():
            yield node, "continue"
        case ast.Continue():
            yield node, "break"
        case ast.AugAssign() | ast.Assign(targets=[ast.Subscript()]) | ast.Expr(value=ast.Call()):
            yield node, "pass"
        case ast.Return(value=ast.Tuple(elts=[first, second, *rest])):
            swapped = ", ".join(map(ast.unparse, (second, first, *rest)))
            yield node, f"return {swapped}"
        case ast.Call(func=func, args=args, keywords=keywords):
            yield from _faulty_calls(node, func, args, keywords)


def _number(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, int | float | complex)


def _faulty_calls(node: ast.Call, func: ast.expr, args: list[ast.expr], keywords: list[ast.keyword]) -> Faults:
    """Calls of the opposite function, with two arguments swapped, with a named argument left out."""
    name = func.attr if isinstance(func, ast.Attribute) else ast.unparse(func)
    if name in OPPOSITES:
        prefix = f"({ast.unparse(func.value)})." if isinstance(func, ast.Attribute) else ""
        yield func, prefix + OPPOSITES[name]
    if len(args) > 1 and not any(isinstance(a, ast.Starred) for a in args[:2]):
        swapped = [args[1], args[0], *args[2:]]
        yield node, f"{ast.unparse(func)}({', '.join(map(ast.unparse, [*swapped, *keywords]))})"
    for left_out in keywords:
        if left_out.arg and left_out.arg not in GUARDS:
            kept = [*args, *(k for k in keywords if k is not left_out)]
            yield node, f"{ast.unparse(func)}({', '.join(map(ast.unparse, kept))})"
