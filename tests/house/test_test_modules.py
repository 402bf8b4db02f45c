"""Test modules stand alone; what they share lies in tests/support."""

import ast

from places import ROOT


def test_no_test_module_imports_another() -> None:
    results = [
        f"{path.relative_to(ROOT)} imports {node.module}"
        for path in sorted((ROOT / "tests").glob("*/*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0].startswith("test_")
    ]
    assert not results
