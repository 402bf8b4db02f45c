"""What the benchmarks share: options, date and machine of a run, processor times, tables, and where figures go."""

from __future__ import annotations

import argparse
import datetime
import json
import platform
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import gbid
from gbid.core.arrays import one_blas_thread
from gbid.core.compiled import CompilerMissingError, find_compiler

DOCS = Path(__file__).resolve().parents[2] / "docs"
_INSTRUCTION_SETS = {"__AVX512F__": "AVX-512", "__AVX2__": "AVX2", "__AVX__": "AVX", "__ARM_NEON": "NEON"}
T = TypeVar("T")


def options_of(
    words: str | None, arguments: Sequence[str] | None = None, output: str = "", **options: tuple[Any, str]
) -> argparse.Namespace:
    """Return the options of a command line: of each its default and its words.

    A default that is False makes a switch, a tuple takes several values, a type has no default. ``--output`` names the
    file of the figures: `output` in the folder of the docs, or none.
    """
    parser = argparse.ArgumentParser(description=words, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, (default, text) in options.items():
        kind = default if isinstance(default, type) else type(default)
        how: dict[str, Any] = {"type": kind, "default": None if isinstance(default, type) else default}
        if default is False:
            how = {"action": "store_true"}
        elif isinstance(default, tuple):
            how = {"nargs": "+", "type": type(default[0]), "default": default}
        parser.add_argument(f"--{name.replace('_', '-')}", help=text, **how)
    stored_in = DOCS / output if output else None
    parser.add_argument("--output", type=Path, default=stored_in, help="JSON file for the numbers (replaced if there)")
    return parser.parse_args(arguments)


def run_study(measured: Callable[[], Any], path: Path | None, table: Callable[[Any], str]) -> int:
    """Measure with one BLAS thread, store the figures, print their table, and return the exit code."""
    with one_blas_thread():
        run = measured()
    store(run, path)
    print(table(run))
    return 0


def timed(call: Callable[[], T]) -> tuple[T, float]:
    """Return what a call returns, and its processor time [s], which holds beside other programs."""
    began = time.process_time()
    value = call()
    return value, time.process_time() - began


def about() -> dict[str, Any]:
    """Return date, processor and version of gbid, which stand under each table."""
    return {"date": datetime.date.today().isoformat(), "processor": processor(), "gbid": gbid.__version__}


def processor() -> str:
    """Return the model of the processor, the instruction set of the compiled kernels, and their compiler."""
    return ", ".join([_model(), *_target()])


def _target() -> list[str]:
    """Return instruction set and compiler of the kernels; without a compiler numpy takes their place."""
    try:
        compiler = find_compiler()
    except CompilerMissingError:
        return ["no C compiler"]
    asked = [*compiler.command, "-march=native", "-dM", "-E", "-x", "c", "-"]
    macros = subprocess.run(asked, input="", stdout=subprocess.PIPE, text=True, check=True).stdout
    known = (name for macro, name in _INSTRUCTION_SETS.items() if f"#define {macro} " in macros)
    return [next(known, platform.machine()), compiler.version.splitlines()[0]]


def dgemm_s() -> float:
    """Return the processor time of a product of two 512 by 512 matrices, the shortest of ten [s]."""
    A = np.random.default_rng(0).normal(size=(512, 512))
    return min(timed(lambda: A @ A)[1] for _ in range(10))


def _model() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def markdown(head: Sequence[str], rows: Sequence[Sequence[object]], *notes: str) -> str:
    """Return a table as Markdown, with notes below it."""
    lines = [head, ["---"] * len(head), *rows]
    table = "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)
    return "\n\n".join([table, *notes])


def under(run: dict[str, Any], *words: str) -> str:
    """Return the line under a table: some words, then machine, date and version of the run."""
    machine = [run["processor"]] if "processor" in run else []
    return ", ".join([*words, *machine, run["date"], f"gbid {run['gbid']}."])


def stored(path: Path, empty: Any) -> Any:
    """Return the figures of an earlier run; `empty` without one."""
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else empty


def store(run: Any, path: Path | None) -> None:
    """Write the figures of a run to a JSON file, when one is named."""
    if path is not None:
        path.write_text(json.dumps(run, indent=2) + "\n", encoding="utf-8")
