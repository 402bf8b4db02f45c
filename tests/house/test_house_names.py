"""Names stand for one thing: classes, files, packages, and the words of the field."""

import ast
import re
from collections import Counter, defaultdict

import pytest
from places import ROOT

import gbid

PACKAGE = ROOT / "gbid"
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if "_share" not in path.parts)
STAGES = PACKAGE / "experiment" / "stages"
"""Each stage has a folder with the same files."""


def test_a_class_name_stands_for_one_class() -> None:
    places = defaultdict(list)
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                places[node.name.lstrip("_")].append(str(path.relative_to(ROOT)))
    assert {name: computed for name, computed in places.items() if len(computed) > 1} == {}


def test_no_file_name_is_used_three_times() -> None:
    names = Counter(path.name for path in MODULES if STAGES not in path.parents)
    assert {name: n for name, n in names.items() if n > 2 and name != "__init__.py"} == {}


def test_no_file_has_the_name_of_a_function_beside_it() -> None:
    """``gbid.control.tune`` is the function: a package of that name would hide it; behind a stub a file would, too.

    At the top the stub decides: ``gbid.prefilter`` is the function, and ``from gbid.prefilter import ...`` the package.
    """
    hidden = []
    for init in PACKAGE.glob("*/**/__init__.py*"):
        beside = {path.stem for path in init.parent.glob("*" if init.suffix == ".pyi" else "*/")}
        for node in ast.walk(ast.parse(init.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                hidden += [
                    f"{init.parent.name}.{a.name}" for a in node.names if a.name in beside and node.module != "gbid"
                ]
    assert hidden == []


def test_a_public_name_stands_in_one_list() -> None:
    """In the stub ``gbid/__init__.pyi``, once; what it names is defined there, and Python reads no other list."""
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    names = [alias.name for node in ast.walk(stub) if isinstance(node, ast.ImportFrom) for alias in node.names]
    assert sorted(names) == gbid.__all__
    assert "gbid." not in (PACKAGE / "__init__.py").read_text(encoding="utf-8")
    assert all(hasattr(gbid, name) for name in names)


@pytest.mark.parametrize("word", ["blow", "polish", "shake", "one-shot", "worth_"])
def test_words_that_the_field_does_not_use(word: str) -> None:
    used = re.compile(rf"\b{word}", re.IGNORECASE)
    assert [str(path.relative_to(ROOT)) for path in MODULES if used.search(path.read_text(encoding="utf-8"))] == []


def test_sections_of_docstrings_have_lines_of_their_own() -> None:
    """A line break lost in ``Notes`` or ``Raises`` breaks the page of the API, and nothing else would notice."""
    lost = re.compile(r"(Parameters|Attributes|Returns|Yields|Raises|Notes|Examples) -{3,}")
    results = [str(path.relative_to(ROOT)) for path in MODULES if lost.search(path.read_text(encoding="utf-8"))]
    assert results == []
