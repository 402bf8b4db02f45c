"""Mutation study: how many of a sample of small faults do the tests notice? ``make mutants`` runs it.

First the tests run once with coverage, which tells the tests that touch each line, and how long each takes. Then each
fault of the sample goes into a copy of the source, and the tests that touch its line run, the quickest first, until one
fails or the budget is spent. What survives is judged by hand: "equivalent" in docs/mutants.json, with the reason, is a
fault that changes no behaviour. Stored judgements are kept for the faults that are met again.
"""

from __future__ import annotations

import ast
import importlib
import json
import multiprocessing
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any

from benchmarks.running import markdown, options_of, store
from benchmarks.running import stored as stored_run

if TYPE_CHECKING:
    import pytest

# ---- Small faults that a test should notice: one operator, number, argument or statement of a source file changed.

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

    results = []
    for function, node, new in _walk(ast.parse(text), ""):
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        start, end = offset(node.lineno, node.col_offset), offset(node.end_lineno, node.end_col_offset)
        results.append(Mutant(path.relative_to(root).as_posix(), function, node.lineno, start, text[start:end], new))
    return results


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


# ---- The study.

ROOT = Path(__file__).parents[1]
PACKAGES = ("structure", "lpv", "control", "prefilter", "validate", "characterise", "rig")
CITATION = re.compile(r"\bEqs?\. \d|\bTables? (?:\d|A\.5|B\.6)|\bpaper\b|\bSec\. \d")
"""What the docstring of a function says that stands for a formula of the paper."""
OTHERS = ("gbid/rig/film.py",)
"""Files that cite the paper for what they do not take from it."""
LIBRARIES = (
    *("numpy", "scipy.signal", "scipy.optimize", "scipy.stats"),
    *("casadi", "h5py", "pydantic", "matplotlib.pyplot", "pytest"),
)
"""Loaded before the forks; none of them is a plugin of pytest, which would load it itself."""
NEEDED = ("gbid", "tests", "models", "experiments", "benchmarks", "docs", "pyproject.toml", "Makefile", "README.md")


class Durations:
    """A pytest plugin: time of each test, with its set-up, by node id [s]."""

    def __init__(self) -> None:
        self.of: defaultdict[str, float] = defaultdict(float)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add what a phase of a test took; infinite for a test that fails without a mutant."""
        self.of[report.nodeid] += float("inf") if report.failed else report.duration


def measure(work: Path, jobs: int, packages: Sequence[str]) -> None:
    """Run the tests of the packages once, and store which lines each touches and how long each takes in a folder."""
    os.environ["COVERAGE_FILE"] = str(work / ".coverage")
    durations = Durations()
    options = ["--cov=gbid", "--cov-context=test", "--cov-report=", "-q", "-n", str(jobs), "--dist", "worksteal"]
    import pytest

    pytest.main([*options, *(f"tests/{package}" for package in packages)], plugins=[durations])
    for test in [test for test, took in durations.of.items() if took == float("inf")]:
        print(f"left out, because it fails without a mutant: {test}", file=sys.stderr)
        del durations.of[test]
    (work / "durations.json").write_text(json.dumps(durations.of), encoding="utf-8")


class Touching:
    """The tests that touch a line, from what `measure` stored."""

    def __init__(self, work: Path, budget: float) -> None:
        coverage = importlib.import_module("coverage")
        self.data = coverage.CoverageData(str(work / ".coverage"))
        self.data.read()
        self.files = {"gbid/" + f.rsplit("/gbid/", 1)[1]: f for f in self.data.measured_files()}
        self.durations: dict[str, float] = json.loads((work / "durations.json").read_text(encoding="utf-8"))
        self.budget = budget

    def tests(self, mutant: Mutant) -> list[str]:
        """Return the tests that touch a mutant's lines, then those that touch its file, quickest first."""
        if mutant.file not in self.files:
            return []
        contexts = self.data.contexts_by_lineno(self.files[mutant.file])
        lines = range(mutant.line, mutant.line + mutant.old.count("\n") + 1)
        at_line = self._named(context for line in lines for context in contexts.get(line, ()))
        anywhere = self._named(context for computed in contexts.values() for context in computed)
        chosen, spent = [], 0.0
        for test in (*at_line, *(test for test in anywhere if test not in set(at_line))):
            if (spent := spent + self.durations[test]) > self.budget and chosen:
                break
            chosen.append(test)
        return chosen

    def _named(self, contexts: Iterable[str]) -> list[str]:
        tests = {context.rpartition("|")[0] for context in contexts} & self.durations.keys()
        return sorted(tests, key=self.durations.__getitem__)


def nearest_tests(mutant: Mutant, packages: Sequence[str], most: int = 4) -> list[str]:
    """Return the test files of the packages that name a mutant's function and file most often, without a run before."""
    names = [name for name in mutant.function.split(".") if not name.startswith("__")]
    stem, package, scores = Path(mutant.file).stem, mutant.file.split("/")[1], dict[str, int]()
    for path in (path for folder in packages for path in sorted((ROOT / "tests" / folder).rglob("test_*.py"))):
        text = path.read_text(encoding="utf-8")
        score = sum(len(re.findall(rf"\b{re.escape(name)}\b", text)) for name in names)
        if score := score + 3 * (stem in path.stem) + (stem in text):
            scores[path.relative_to(ROOT).as_posix()] = score + 2 * (path.parent.name == package)
    return sorted(scores, key=lambda name: -scores[name])[:most]


def try_one(trees: Path, task: tuple[Mutant, list[str]]) -> dict[str, Any]:
    """Return what became of a mutant: "killed", "survived", "timeout", or "untested" where no test touches it."""
    mutant, tests = task
    results: dict[str, Any] = {**mutant.as_dict(), "tests": len(tests)}
    if not tests:
        return {**results, "outcome": "untested"}
    tree = trees / str(os.getpid())
    if not tree.exists():
        tree.mkdir(parents=True)
        for name in NEEDED:
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("results", "_build"))
            else:
                shutil.copy(ROOT / name, tree / name)
    file = tree / mutant.file
    text = file.read_text(encoding="utf-8")
    file.write_text(mutant.apply(text), encoding="utf-8")
    os.utime(file, (at := time.time_ns() // 10**9 + mutant.start, at))  # not taken for what is compiled already
    (tree / "selected.txt").write_text("\n".join(tests), encoding="utf-8")
    began = time.monotonic()
    try:
        code = _in_a_fork(tree)
    finally:
        file.write_text(text, encoding="utf-8")
    outcome = "survived" if code == 0 else "timeout" if code is None or code < 0 else "killed"
    return {**results, "outcome": outcome, "seconds": round(time.monotonic() - began, 1)}


def _in_a_fork(tree: Path, cpu_s: int = 150, wall_s: float = 900.0) -> int | None:
    """Exit code of pytest over the selected tests in a fork, which has the libraries loaded; None out of time."""
    process = multiprocessing.get_context("fork").Process(target=_run_selected, args=(tree, cpu_s))
    process.start()
    process.join(wall_s)
    ended = process.exitcode
    if process.pid is not None:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # with what the tests have started
    process.join()
    return ended


def _run_selected(tree: Path, cpu_s: int) -> None:
    os.setsid()
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s + 5))
    os.chdir(tree)
    sys.path[:0] = [str(tree)]
    for name in [name for name in sys.modules if name.split(".")[0] in ("benchmarks", "gbid")]:
        del sys.modules[name]  # else the tests would see the source without the fault
    os.environ["PYTHONPATH"] = str(tree)
    log = os.open(tree / "log.txt", os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
    os.dup2(log, 1)
    os.dup2(log, 2)
    import pytest  # the pages show stored mutants where pytest is not installed

    code = pytest.main(["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "@selected.txt"])
    os._exit(int(code))


def formulas(path: Path) -> set[str]:
    """Return the functions and classes of a file whose docstring names the paper, an equation, a table or a section."""

    def named(node: ast.AST, outer: str) -> Iterator[str]:
        for child in ast.iter_child_nodes(node):
            name = outer
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                name = f"{outer}.{child.name}".lstrip(".")
                if CITATION.search(ast.get_docstring(child) or ""):
                    yield name
            yield from named(child, name)

    return set(named(ast.parse(path.read_text(encoding="utf-8")), ""))


def sample(number: int, seed: int, packages: Sequence[str], everywhere: bool = True) -> list[Mutant]:
    """Return mutants drawn with equal chance, each another program: of all functions, or of formulas of the paper."""
    files = [path for package in packages for path in sorted((ROOT / "gbid" / package).rglob("*.py"))]
    drawn = []
    for path in files:
        cited = formulas(path)
        drawn += [m for m in mutants(path, ROOT) if everywhere or (m.function in cited and m.file not in OTHERS)]
    random.Random(seed).shuffle(drawn)
    chosen: list[Mutant] = []
    for mutant in drawn:
        if len(chosen) < number and is_another_program(mutant, ROOT):
            chosen.append(mutant)
    return chosen


def summary(run: Sequence[Mapping[str, Any]]) -> str:
    """Return the study's table as Markdown: the mutants of each package, and the share that is killed."""
    lines = []
    packages = {entry["file"].split("/")[1] for entry in run}
    for name in (*sorted(packages), None):
        counts = Counter(verdict(entry) for entry in run if name in (None, entry["file"].split("/")[1]))
        n, same, killed = counts.total(), counts["equivalent"], counts["killed"]
        share = f"{100 * killed / max(n - same, 1):.1f} %"
        label = f"`gbid/{name}`" if name else "all"
        lines.append((label, n, killed, same, n - same - killed, share))
    return markdown(("package", "mutants", "killed", "equivalent", "survived", "share killed"), lines)


def survivors(run: Sequence[Mapping[str, Any]]) -> str:
    """Return the mutants that no test noticed as Markdown, with the reason of those that change no behaviour."""
    lines = []
    for entry in run:
        if verdict(entry) != "killed":
            old, new = (
                f"`{shorten(entry[key], 70, placeholder=' ...')}`".replace("|", "\\|") for key in ("old", "new")
            )
            where = f"`{entry['file'].removeprefix('gbid/')}` {entry['line']}"
            lines.append((where, old, new, entry.get("equivalent", "no")))
    return markdown(("where", "was", "became", "equivalent"), lines)


def verdict(entry: Mapping[str, Any]) -> str:
    """Return "killed", "equivalent" (as judged by hand) or "survived"."""
    if entry["outcome"] in ("killed", "timeout"):
        return "killed"
    return "equivalent" if entry.get("equivalent") else "survived"


def _key(entry: Mapping[str, Any]) -> tuple[str, ...]:
    return entry["file"], entry["function"], entry["old"], entry["new"]


def main(arguments: Sequence[str] | None = None) -> int:
    options = options_of(
        __doc__,
        arguments,
        "mutants.json",
        number=(60, "mutants in the sample"),
        seed=(41, "of the sample"),
        packages=(PACKAGES, "packages of gbid, tested by tests/PACKAGE"),
        jobs=(2, "processes"),
        nearest=(False, "for each mutant the four test files that name it most often, without the run with coverage"),
        everywhere=(False, "faults of all functions, not only of those whose docstring cites the paper"),
        budget=(20.0, "time of the tests of one mutant [s]"),
        work=(ROOT / "build" / "mutants", "folder of what is measured first"),
    )
    options.work.mkdir(parents=True, exist_ok=True)
    if not (options.nearest or (options.work / "durations.json").is_file()):
        call = f"m.measure(m.Path({str(options.work)!r}), {options.jobs}, {list(options.packages)})"
        code = f"import benchmarks.mutants as m; {call}"
        subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
    for name in LIBRARIES:  # once, before the forks
        importlib.import_module(name)
    drawn = sample(options.number, options.seed, options.packages, options.everywhere)
    by_name = partial(nearest_tests, packages=options.packages)
    chosen = by_name if options.nearest else Touching(options.work, options.budget).tests
    tasks = [(mutant, chosen(mutant)) for mutant in drawn]
    before = stored_run(options.output, [])
    judged = {_key(entry): entry["equivalent"] for entry in before if "equivalent" in entry}
    unharmed = replace(tasks[0][0], start=0, old="", new="")
    if try_one(options.work / "trees", (unharmed, tasks[0][1]))["outcome"] != "survived":
        raise SystemExit(f"tests fail without a mutant: see log.txt in {options.work / 'trees' / str(os.getpid())}")
    run: list[dict[str, Any]] = []
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("fork")) as pool:
        for entry in pool.map(partial(try_one, options.work / "trees"), tasks):
            if entry["outcome"] == "survived" and _key(entry) in judged:
                entry["equivalent"] = judged[_key(entry)]
            run.append(entry)
            print(entry["outcome"], f"{entry['file']}:{entry['line']}", file=sys.stderr, flush=True)
            store(run, options.output)
    print(summary(run))
    return 0


if __name__ == "__main__":
    sys.exit(main())
