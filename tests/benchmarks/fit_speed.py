"""Time a fit with 24 unknowns by gbid and by what engineers write themselves; print a table, store the numbers.

``python -m tests.benchmarks.fit_speed [--quick] [--output FILE]``
"""

from __future__ import annotations

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
from tests.benchmarks.baselines import N_UNKNOWNS, make_samples
from tests.benchmarks.running import about, markdown, options_of, run_study

# ---- The table of a stored run, as Markdown.

NAMES = {
    "compiled": "gbid, compiled",
    "profile": "gbid, profile likelihoods of all 18 parameters",
    "numpy": "gbid, numpy",
    "scipy": "(a) scipy least_squares",
    "casadi": "(b) CasADi mapaccum, IPOPT",
}
TARGETS = {  # what the project has promised, by name of the figure: (at most or at least, number)
    "fit_s": ("at most", 0.3),
    "numpy_s": ("at most", 8.0),
    "scipy_ratio": ("at least", 140.0),
    "casadi_ratio": ("at least", 60.0),
    "growth": ("at most", 45.0),
    "profile_ratio": ("at most", 15.0),  # 20 for 24 parameters
}
_TITLES = {
    "fit_s": "a fit, N = 25 000 [s]",
    "numpy_s": "the same without a compiler [s]",
    "scipy_ratio": "times faster than (a)",
    "casadi_ratio": "times faster than (b), build not counted",
    "growth": "time at N = 1 000 000 over 25 000",
    "profile_ratio": "time of all profile likelihoods over that of the fit",
}
_REFERENCE = 25_000
_LARGEST = 1_000_000


def speed_table(run: Mapping[str, Any]) -> str:
    """One row per method and recording."""
    head = ("N", "method", "time [s]", "build [s]", "iterations", "memory [MB]", "loss / gbid's - 1")
    rows = []
    for fit in run["fits"]:
        compiled = _find(run, fit["n_samples"], "compiled")
        fit_s = (
            fit["build_cpu_s"] if fit["method"] == "profile" else compiled["cpu_s"]
        )  # of the fit in the same process
        rows.append(
            (
                _grouped(fit["n_samples"]),
                NAMES[fit["method"]],
                f"{fit['time_s']:.3g}",
                f"{fit['build_s']:.2g}" if fit["build_s"] else "",
                f"{fit['iterations']}" + ("" if fit["success"] else " (not converged)"),
                f"{fit['memory_bytes'] / 1e6:.0f}",
                f"{fit['loss'] / compiled['loss'] - 1:+.0e}" if fit is not compiled else "",
                f"{fit['cpu_s'] / fit_s:.3g}" if fit is not compiled else "",
                f"{(fit['cpu_s'] + fit['build_cpu_s']) / fit_s:.3g}" if fit["build_s"] else "",
            )
        )
    return markdown((*head, "ratio to gbid", "with build"), rows)


def target_table(run: Mapping[str, Any]) -> str:
    """Promised and measured; empty for a quick run, which measures none of it."""
    computed = figures(run)
    head = ("", "promised", "measured", "")
    rows = []
    for name, value in computed.items():
        bound, limit = TARGETS[name]
        kept = value <= limit if bound == "at most" else value >= limit
        rows.append((_TITLES[name], f"{bound} {limit:g}", f"{value:.3g}", "kept" if kept else "missed"))
    return markdown(head, rows) if rows else ""


def figures(run: Mapping[str, Any]) -> dict[str, float]:
    """The figures that were promised, as far as the run has them."""
    fits = {m: f for m in NAMES if (f := _find(run, _REFERENCE, m))}
    compiled, largest = fits.get("compiled"), _find(run, _LARGEST, "compiled")
    results = {}
    if compiled:
        results["fit_s"] = compiled["time_s"]
        for name, method in (("scipy_ratio", "scipy"), ("casadi_ratio", "casadi")):
            if method in fits:
                results[name] = fits[method]["cpu_s"] / compiled["cpu_s"]
        if "profile" in fits:  # of the fit before it, in the same process
            results["profile_ratio"] = fits["profile"]["cpu_s"] / fits["profile"]["build_cpu_s"]
        if largest:
            results["growth"] = largest["cpu_s"] / compiled["cpu_s"]
    if "numpy" in fits:
        results["numpy_s"] = fits["numpy"]["time_s"]
    return {name: results[name] for name in TARGETS if name in results}


def notes(run: Mapping[str, Any]) -> str:
    """The compiler and the machine in a few lines."""
    lines = [f"- Compiling the kernel takes {run['compile_s']:.1f} s, once per machine and model size."]
    for n_samples in (_LARGEST, 10 * _LARGEST):
        if large := _find(run, n_samples, "compiled"):
            per_sample = large["memory_bytes"] / n_samples
            lines.append(f"- At {_grouped(n_samples)} samples a fit needs {per_sample:.0f} bytes per sample.")
    first = _find(run, _REFERENCE, "compiled")
    if first:
        lines.append(
            f"- Times of gbid are the shortest of several fits in one process; the first, which loads the kernel, "
            f"takes {first['first_time_s']:.2g} s at {_grouped(_REFERENCE)} samples."
        )
    busy = [f for f in run["fits"] if f["cpu_s"] < 0.9 * f["time_s"]]
    if busy:
        names = ", ".join(f"{NAMES[f['method']]} at {_grouped(f['n_samples'])} ({f['cpu_s']:.3g} s)" for f in busy)
        lines.append(
            f"- The core was shared with other work. Processor time where it is far below the wall time: {names}."
        )
    versions = ", ".join(f"{name} {version}" for name, version in run["versions"].items())
    lines.append(f"- {run['date']}, {run['processor']}, one core; {versions}.")
    return "\n".join(lines)


def whole(run: Mapping[str, Any]) -> str:
    """All of it."""
    return "\n\n".join(part for part in (speed_table(run), target_table(run), notes(run)) if part)


def _find(run: Mapping[str, Any], n_samples: int, method: str) -> Any:
    return next((f for f in run["fits"] if (f["n_samples"], f["method"]) == (n_samples, method)), None)


def _grouped(number: int) -> str:
    return f"{number:,}".replace(",", " ")


# ---- The study.

_ROOT = Path(__file__).resolve().parents[2]
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


class _Job(NamedTuple):
    n_samples: int
    method: str
    repeats: int


_REPEATS = {"compiled": 10, "profile": 3, "numpy": 3, "scipy": 1, "casadi": 1}
_FULL = (
    *(_Job(n, method, repeats) for n in (5_000, _REFERENCE) for method, repeats in _REPEATS.items()),
    *(_Job(_LARGEST, "compiled", 3), _Job(10 * _LARGEST, "compiled", 1)),
)
_QUICK = tuple(_Job(2_000, method, 1) for method in _REPEATS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = options_of(__doc__, arguments, quick=(False, "2 000 samples only, to see that it works"))
    return run_study(lambda: measure(_QUICK if options.quick else _FULL), options.output, whole)


def measure(jobs: Sequence[_Job]) -> dict[str, Any]:
    """Run the jobs one after the other, each in a process of its own."""
    fits: list[dict[str, Any]] = []
    results: dict[int, Mapping[str, float]] = {}  # gbid's start values, which the baselines are given
    with tempfile.TemporaryDirectory() as folder:
        paths = {job.n_samples: Path(folder) / f"{job.n_samples}.npz" for job in jobs}
        for n_samples, path in paths.items():
            make_samples(n_samples).save(path)
        for job in jobs:
            _say(f"{job.method}, {job.n_samples} samples")
            request = {"method": job.method, "samples": str(paths[job.n_samples]), "repeats": job.repeats}
            answer = _ask({**request, "start": results.get(job.n_samples, {})})
            start = answer.pop("start")
            if job.method == "compiled":
                results[job.n_samples] = start
            fits.append({"n_samples": job.n_samples, "method": job.method, **answer})
        _say("compiler")
        request = {"method": "compiled", "samples": str(paths[jobs[0].n_samples]), "repeats": 2, "start": {}}
        fresh = _ask(request, GBID_CACHE_DIR=str(Path(folder) / "new"))
    return {
        **about(),
        "versions": {
            "gbid": gbid.__version__,
            "Python": platform.python_version(),
            "casadi": casadi.__version__,
            "numpy": np.__version__,
            "scipy": scipy.__version__,
        },
        "n_unknowns": N_UNKNOWNS,
        "compile_s": fresh["first_time_s"] - fresh["time_s"],  # gcc is another process, so wall time
        "fits": fits,
    }


def _ask(request: Mapping[str, Any], **variables: str) -> dict[str, Any]:
    """Run a worker with one thread in each BLAS."""
    path = os.pathsep.join(filter(None, [str(_ROOT), os.environ.get("PYTHONPATH", "")]))
    environment = {**os.environ, **dict.fromkeys(_THREADS, "1"), "PYTHONPATH": path, **variables}
    done = subprocess.run(
        [sys.executable, "-m", "tests.benchmarks.worker"],
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
