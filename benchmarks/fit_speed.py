"""Time a fit with 24 unknowns by gbid and by what engineers write themselves; print a table, store the numbers.

``python -m benchmarks.fit_speed [--quick] [--output FILE]``
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import casadi
import numpy as np
import scipy

import gbid
from benchmarks.case import N_UNKNOWNS, make_samples
from benchmarks.table import whole

_ROOT = Path(__file__).resolve().parents[1]
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


class _Job(NamedTuple):
    n_samples: int
    method: str
    repeats: int


_FULL = (
    _Job(5_000, "compiled", 10),
    _Job(5_000, "numpy", 3),
    _Job(5_000, "scipy", 1),
    _Job(5_000, "casadi", 1),
    _Job(25_000, "compiled", 10),
    _Job(25_000, "numpy", 3),
    _Job(25_000, "scipy", 1),
    _Job(25_000, "casadi", 1),
    _Job(1_000_000, "compiled", 3),
    _Job(10_000_000, "compiled", 1),
)
_QUICK = tuple(_Job(2_000, method, 1) for method in ("compiled", "numpy", "scipy", "casadi"))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(prog="benchmarks.fit_speed", description="Time a fit with 24 unknowns.")
    parser.add_argument("--quick", action="store_true", help="2 000 samples only, to see that it works")
    parser.add_argument("--output", type=Path, help="write the numbers to this JSON file (replaced if there)")
    options = parser.parse_args(arguments)
    run = measure(_QUICK if options.quick else _FULL, repeats=3 if options.quick else 30)
    if options.output:
        options.output.write_text(json.dumps(run, indent=2) + "\n", encoding="utf-8")
    print(whole(run))
    return 0


def measure(jobs: Sequence[_Job], repeats: int) -> dict[str, Any]:
    """Run the jobs one after the other, each in a process of its own."""
    fits: list[dict[str, Any]] = []
    found: dict[int, Mapping[str, float]] = {}  # gbid's start values, which the baselines are given
    with tempfile.TemporaryDirectory() as folder:
        paths = {job.n_samples: Path(folder) / f"{job.n_samples}.npz" for job in jobs}
        for n_samples, path in paths.items():
            make_samples(n_samples).save(path)
        floor_samples = sorted(paths)[(len(paths) - 1) // 2]
        for job in jobs:
            _say(f"{job.method}, {job.n_samples} samples")
            request = {"method": job.method, "samples": str(paths[job.n_samples]), "repeats": job.repeats}
            answer = _ask({**request, "start": found.get(job.n_samples, {})})
            start = answer.pop("start")
            if job.method == "compiled":
                found[job.n_samples] = start
            fits.append({"n_samples": job.n_samples, "method": job.method, **answer})
        _say("floor")
        request = {"method": "floor", "samples": str(paths[floor_samples]), "repeats": repeats}
        floor = _ask({**request, "start": found[floor_samples]})
        _say("compiler")
        fresh = _ask({**request, "repeats": 1, "start": found[floor_samples]}, GBID_CACHE_DIR=str(Path(folder) / "new"))
    floor.pop("compile_s")
    return {
        "date": datetime.date.today().isoformat(),
        "processor": processor(),
        "versions": {
            "gbid": gbid.__version__,
            "Python": platform.python_version(),
            "casadi": casadi.__version__,
            "numpy": np.__version__,
            "scipy": scipy.__version__,
        },
        "n_unknowns": N_UNKNOWNS,
        "compile_s": fresh["compile_s"],
        "floor": {"n_samples": floor_samples, **floor},
        "fits": fits,
    }


def processor() -> str:
    """Model of the processor, without the name of the machine."""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _ask(request: Mapping[str, Any], **variables: str) -> dict[str, Any]:
    """Run a worker with one thread in each BLAS."""
    path = os.pathsep.join(filter(None, [str(_ROOT), os.environ.get("PYTHONPATH", "")]))
    environment = {**os.environ, **dict.fromkeys(_THREADS, "1"), "PYTHONPATH": path, **variables}
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.worker"],
        input=json.dumps(request),
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer


def _say(what: str) -> None:
    print(f"... {what}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
