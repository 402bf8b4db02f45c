"""Table of the packages of gbid: first line of each docstring, files and folders, in the order of the import rules."""

import ast
import tomllib
from pathlib import Path

import gbid


def rooms_table():
    package = Path(gbid.__file__).parent
    project = tomllib.loads((package.parent / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = project["tool"]["importlinter"]["contracts"]
    layers = next(c for c in contracts if c["type"] == "layers")["layers"]
    rows = ["| package | what it is for | files and folders |", "|---|---|---|"]
    for layer in layers:
        folder = package / layer.removeprefix("gbid.")
        first = (ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))) or "").splitlines()
        inside = sorted(p.stem for p in folder.iterdir() if p.suffix == ".py" and p.stem != "__init__")
        inside += sorted(f"**{p.name}**" for p in folder.iterdir() if (p / "__init__.py").is_file())
        rows.append(f"| `{layer}` | {first[0]} | {', '.join(inside).replace('_', ' ')} |")
    return "\n".join(rows)
