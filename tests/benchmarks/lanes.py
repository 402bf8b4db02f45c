"""Time the compiled passes of fits with each compiler and each width of vectors in turn, as ratios to dgemm.

``python -m tests.benchmarks.lanes [--output FILE]``

The calls are those of a linear fit, one with coloured errors and a nonlinear one, 25 000 samples each. A compiler takes
part if this machine has it. The default is what a user's fit runs; the others force the width by ``-DWIDTH``.
"""

from __future__ import annotations

import ctypes
import re
import shutil
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

import gbid
from gbid.core.compiled import FLAGS, Compiler, compile_source, find_compiler, load_library, run_compiled
from gbid.identify import predictor
from gbid.identify.kernel import lanes, linear
from tests.benchmarks.baselines import STRUCTURE, make_samples
from tests.benchmarks.nonlinear_speed import film, film_recording, linear_start
from tests.benchmarks.running import about, dgemm_s, markdown, options_of, run_study, timed, under

WIDTHS = (2, 4, 8)
_REPEATS = 20
_SAMPLES = 25_000
_WORDS = {
    "gbid_predictor": "matrices of a predictor with derivatives",
    "gbid_pass": "linear pass with sensitivities",
    "gbid_adjoint": "adjoint",
    "gbid_second": "second-order pass",
    "gbid_sensitivities": "sensitivities, sample by sample",
    "gbid_sums": "nonlinear pass with sensitivities",
}


class CompiledCall(NamedTuple):
    """Call of a compiled function, with its source and flags."""

    source: str
    flags: tuple[str, ...]
    sizes: Sequence[int]
    arrays: Sequence[np.ndarray[Any, Any]]
    results: Sequence[np.ndarray[Any, Any] | None]


def calls() -> dict[str, CompiledCall]:
    """Return the last call of each function of `_WORDS` in three fits."""
    sources: dict[int, tuple[str, tuple[str, ...]]] = {}
    last: dict[str, CompiledCall] = {}

    def loaded(source: str, flags: tuple[str, ...] = FLAGS) -> Any:
        library = load_library(source, flags)
        for name in re.findall(r"\nvoid (gbid_\w+)\(", source):
            sources[id(getattr(library, name))] = source, flags
        return library

    def run(function: Any, sizes: Sequence[int], arrays: Sequence[Any], results: Sequence[Any]) -> None:
        if (name := function.__name__) in _WORDS:
            last[name] = CompiledCall(*sources[id(function)], sizes, arrays, results)
        run_compiled(function, sizes, arrays, results)

    recording, nonlinear = make_samples(_SAMPLES).recording(), film_recording(_SAMPLES)
    with mock.patch("gbid.discretise.exact.load_library", loaded), mock.patch.object(predictor, "run_compiled", run):
        with mock.patch.multiple(linear, load_library=loaded, run_compiled=run):
            start = linear_start(nonlinear)  # its Hessian is exact
            gbid.fit(STRUCTURE, recording, focus="simulation", errors="ar")
            gbid.fit(STRUCTURE, recording, criterion="trace")
        with mock.patch.multiple(lanes, load_library=loaded, run_compiled=run):
            gbid.fit(film(start), nonlinear)
    return last


def compilers() -> dict[str, Compiler]:
    """Return the compilers of this machine by name."""
    known = {"gcc": ["gcc"], "clang": ["clang"], "zig": [sys.executable, "-P", "-m", "ziglang", "cc"]}
    found = {}
    for name, command in known.items():
        with mock.patch.dict("os.environ", CC=" ".join(command)):
            find_compiler.cache_clear()
            if shutil.which(command[0]):
                found[name] = find_compiler()
    find_compiler.cache_clear()
    return found


def times(name: str, call: CompiledCall, folder: Path) -> dict[str, float]:
    """Return the shortest processor time of a function by variant [s]; all run in turn."""
    functions = {}
    for compiler_name, compiler in compilers().items():
        for width in (0, *WIDTHS):
            variant = f"{compiler_name}, {width}" if width else compiler_name
            library = folder / f"{name}-{variant}.so"
            compile_source(compiler, [*call.flags, *([f"-DWIDTH={width}"] if width else [])], call.source, library)
            functions[variant] = getattr(ctypes.CDLL(str(library)), name)
    rounds = [
        {variant: timed(lambda f=f: run_compiled(f, *call[2:]))[1] for variant, f in functions.items()}
        for _ in range(_REPEATS)
    ]
    return {variant: min(each[variant] for each in rounds) for variant in functions}


def measure() -> dict[str, Any]:
    """Return the times of all functions, and of dgemm in the same run [s]."""
    with tempfile.TemporaryDirectory() as folder:
        taken = {name: times(name, call, Path(folder)) for name, call in calls().items()}
    return {**about(), "dgemm_s": dgemm_s(), "times_s": {name: taken[name] for name in _WORDS if name in taken}}


def lanes_table(run: Mapping[str, Any]) -> str:
    """Return the times as Markdown: of each function in units of dgemm, and the default over the best of all."""
    variants = list(next(iter(run["times_s"].values())))
    rows = []
    for name, taken in run["times_s"].items():
        best = min(taken.values())
        ratios = [f"{taken[v] / run['dgemm_s']:.2g}" + (f" ({taken[v] / best:.2f})" * ("," not in v)) for v in variants]
        rows.append((_WORDS[name], *ratios))
    text = f"One unit is a product of two 512 by 512 matrices on the same core, {run['dgemm_s'] * 1e3:.1f} ms"
    return markdown(("pass", *variants), rows, under(dict(run), text))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    options = options_of(__doc__, arguments, output="lanes.json")
    return run_study(measure, options.output, lanes_table)


if __name__ == "__main__":
    raise SystemExit(main())
