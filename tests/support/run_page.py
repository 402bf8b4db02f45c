"""Runs the code cells of a documentation page in order, as the build does.

Each page has a process of its own. It is a fork of one that has the libraries loaded, because loading them takes longer
than most pages. Warnings are errors. Sphinx is not needed; IPython is, from which cells take a few words for pictures
and tables.
"""

from __future__ import annotations

import linecache
import multiprocessing
import os
import re
import traceback
import warnings
from collections.abc import Mapping
from functools import cache
from multiprocessing.context import ForkServerContext
from pathlib import Path

from gbid.experiment.engines import collect_less

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


LOADED = (
    "gbid.cli.main",
    "gbid.experiment.campaign",
    "gbid.report.write",
    "gbid.export.targets",
    "IPython.display",
    "matplotlib.pyplot",
    "scipy.signal",
    "scipy.stats",
    "control",
)


@cache
def server() -> ForkServerContext:
    """Return the process that has the libraries loaded."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*LOADED])
    return context


def run_apart(path: Path, folder: Path, surroundings: Mapping[str, str]) -> tuple[int | None, str]:
    """Return exit code and output of a page that runs in a process of its own, in a folder and with variables."""
    output = folder / "output of the page.txt"
    process = server().Process(target=_run_into, args=(path, folder, surroundings, output))
    process.start()
    process.join()
    return process.exitcode, output.read_text(encoding="utf-8", errors="replace")


def _run_into(path: Path, folder: Path, surroundings: Mapping[str, str], output: Path) -> None:
    collect_less()
    os.environ.update(surroundings)
    os.chdir(folder)
    place = os.open(output, os.O_CREAT | os.O_WRONLY)
    os.dup2(place, 1)
    os.dup2(place, 2)
    try:
        run(path)
    except BaseException:
        traceback.print_exc()
        raise SystemExit(1) from None
