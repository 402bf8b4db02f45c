"""The house keeps its rooms: no import circle between files, no crowded folder, no long module."""

import ast
from collections import defaultdict

from places import ROOT

LARGEST_FOLDER, LONGEST_MODULE = 12, 350
MANY_ALLOWED = {"gbid/cli"}
"""One file a verb."""


def modules():
    """Files of gbid by the name of their module."""
    found = {}
    for path in sorted((ROOT / "gbid").rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        found[name.removesuffix(".__init__")] = path
    return found


def imports(path, known):
    """Modules of gbid that a file imports, also inside of functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module in known:
            whole = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= (whole & known) or {node.module}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names} & known
    return found


def circle_in(graph):
    """Return one circle of a graph as the list of its nodes, empty when there is none."""
    done = set()

    def search(node, path):
        if node in path:
            return path[path.index(node) :]
        if node in done:
            return []
        for following in sorted(graph.get(node, ())):
            found = search(following, [*path, node])
            if found:
                return found
        done.add(node)
        return []

    return next((found for node in sorted(graph) if (found := search(node, []))), [])


def test_a_circle_is_found():
    assert circle_in({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c"]
    assert circle_in({"a": {"b", "c"}, "b": {"c"}}) == []


def test_no_file_imports_itself_by_way_of_others():
    known = modules()
    assert circle_in({name: imports(path, set(known)) - {name} for name, path in known.items()}) == []


def test_no_folder_is_crowded():
    folders = defaultdict(list)
    for path in modules().values():
        if path.name != "__init__.py":
            folders[path.parent.relative_to(ROOT).as_posix()].append(path.name)
    crowded = {folder: len(names) for folder, names in folders.items() if len(names) > LARGEST_FOLDER}
    assert set(crowded) - MANY_ALLOWED == set()


def test_no_module_is_long():
    lengths = {name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in modules().items()}
    assert {name: length for name, length in lengths.items() if length > LONGEST_MODULE} == {}
