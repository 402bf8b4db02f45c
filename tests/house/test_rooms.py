"""The house keeps its rooms: no import circle between files, folders and files of a size that a reader can survey."""

import ast
import re
from collections import Counter
from functools import cache

from places import ROOT

DEEPEST, LARGEST_FOLDER = 2, 17
"""Folders below gbid on the way to a file; modules in a folder."""
LONGEST_MODULE, SHORT, SHORT_MODULES = 1000, 40, 20
"""Lines of a module; lines below which a module is short; number of short modules."""
IMPORTS = 0.10
"""Part of the lines of code that are imports."""


def modules():
    """Files of gbid by the name of their module."""
    paths = {}
    for path in sorted((ROOT / "gbid").rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        paths[name.removesuffix(".__init__")] = path
    return paths


MODULES = modules()


@cache
def trees():
    """Syntax trees of all files of gbid; each process that collects this file would parse them in vain."""
    return {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in MODULES.items()}


def imports(tree, known):
    """Modules of gbid that a file imports, also inside of functions."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module in known:
            submodules = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= (submodules & known) or {node.module}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names} & known
    return names


def circle_in(graph):
    """Return one circle of a graph as the list of its nodes, empty when there is none."""
    done = set()

    def search(node, path):
        if node in path:
            return path[path.index(node) :]
        if node in done:
            return []
        for following in sorted(graph.get(node, ())):
            circle = search(following, [*path, node])
            if circle:
                return circle
        done.add(node)
        return []

    return next((circle for node in sorted(graph) if (circle := search(node, []))), [])


def lines_of(nodes):
    """Lines that nodes of a tree occupy."""
    return {line for node in nodes for line in range(node.lineno, node.end_lineno + 1)}


def code_lines(path, tree):
    """Lines of a file that are code: no comments, docstrings, blank lines."""
    written = enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
    lines = {n for n, line in written if line.strip() and not line.lstrip().startswith("#")}
    texts = [n for n in ast.walk(tree) if isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant)]
    return lines - lines_of(n for n in texts if isinstance(n.value.value, str))


def test_a_circle_is_found():
    assert circle_in({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c"]
    assert circle_in({"a": {"b", "c"}, "b": {"c"}}) == []


def test_no_file_imports_itself_by_way_of_others():
    known = set(MODULES)
    assert circle_in({name: imports(tree, known) - {name} for name, tree in trees().items()}) == []


def test_no_folder_is_crowded_or_deep():
    folders = Counter(path.parent.relative_to(ROOT / "gbid") for path in MODULES.values() if path.name != "__init__.py")
    assert {str(folder): n for folder, n in folders.items() if n > LARGEST_FOLDER} == {}
    assert [str(folder) for folder in folders if len(folder.parts) > DEEPEST] == []


def test_modules_are_neither_long_nor_crumbs():
    lengths = {name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in MODULES.items()}
    assert {name: length for name, length in lengths.items() if length > LONGEST_MODULE} == {}
    packages = {name for name, path in MODULES.items() if path.name == "__init__.py"}
    short = [name for name, length in lengths.items() if length < SHORT and name not in packages]
    assert len(short) <= SHORT_MODULES, short


def test_a_tenth_of_the_code_at_most_are_imports():
    code = sum(len(code_lines(path, trees()[name])) for name, path in MODULES.items())
    imported = sum(
        len(lines_of(n for n in ast.walk(tree) if isinstance(n, ast.Import | ast.ImportFrom)))
        for tree in trees().values()
    )
    assert imported <= IMPORTS * code


KINDS = {"LinearStructure", "NonlinearStructure", "ScheduledStructure", "ClosedLoop", "NonlinearModel"}


def test_only_the_room_of_structures_asks_for_their_kind():
    """Elsewhere `gbid.structure.kinds.kind_of` answers; a new kind is one class there."""
    asking = [
        f"{name}:{call.lineno}"
        for name, tree in trees().items()
        if not name.startswith("gbid.structure")
        for call in ast.walk(tree)
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "isinstance"
        if KINDS & {node.id for node in ast.walk(call.args[1]) if isinstance(node, ast.Name)}
    ]
    assert not asking


def test_the_lowest_room_names_no_other_for_an_import_at_run_time():
    named = re.compile(r"gbid\.(?!core\b)[a-z_]+(\.\w+)*")
    found = [
        f"{name}: {node.value}"
        for name, tree in trees().items()
        if name.startswith("gbid.core")
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and named.fullmatch(node.value)
    ]
    assert found == []
