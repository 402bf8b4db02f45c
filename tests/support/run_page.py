"""Runs the code cells of a documentation page in order, as the build does: ``python run_page.py PAGE``.

Warnings are errors. Sphinx is not needed; IPython is, from which cells take a few words for pictures and tables.
"""

from __future__ import annotations

import linecache
import re
import sys
import warnings
from pathlib import Path

FENCE = re.compile(r"^(`{3,}|~{3,})([^\n]*)\n(.*?)^\1[ ]*$", re.MULTILINE | re.DOTALL)


def fences(path: Path) -> list[tuple[str, str]]:
    """Info string and body of each fenced block."""
    return [(info.strip(), body) for _, info, body in FENCE.findall(path.read_text(encoding="utf-8"))]


def cells(path: Path) -> list[str]:
    """Executed code of a page, without the cells' options."""
    return [re.sub(r"\A(:[^\n]*\n)+", "", body) for info, body in fences(path) if info.startswith("{code-cell}")]


def run(path: Path) -> None:
    """Execute all cells of a page in one namespace; an error is reported with its line of the cell."""
    warnings.simplefilter("error")
    names = {"__name__": "__main__"}
    for number, body in enumerate(cells(path), start=1):
        place = f"{path.name}, cell {number}"
        linecache.cache[place] = (len(body), None, body.splitlines(keepends=True), place)
        exec(compile(body, place, "exec"), names)


if __name__ == "__main__":
    run(Path(sys.argv[1]))
