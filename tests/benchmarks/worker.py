"""One method on one recording, in a process of its own: a request on stdin, an answer on stdout, both JSON.

``python -m tests.benchmarks.worker`` is started by `tests.benchmarks.fit_speed` with one thread in each BLAS.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

import gbid
from tests.benchmarks.baselines import STRUCTURE, Answer, Samples, fit_with_casadi, fit_with_scipy

_STATUS = Path("/proc/self/status")
_UNIT = 1 if sys.platform == "darwin" else 1024  # unit of ru_maxrss in bytes


def main() -> None:
    """Read the request, run it, write the answer."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    request = json.load(sys.stdin)
    samples = Samples.load(Path(request["samples"]))
    with threadpool_limits(1):
        json.dump(run(request["method"], samples, request["repeats"], request["start"]), sys.stdout)


def run(method: str, samples: Samples, repeats: int, start: Mapping[str, float]) -> dict[str, Any]:
    """Run a method `repeats` times and give the fastest; the memory is that of the first run."""
    recording = samples.recording()
    before = _start_of_peak()
    baselines = {"scipy": fit_with_scipy, "casadi": fit_with_casadi}
    answers = []
    for i in range(repeats):
        answers.append(baselines[method](samples, start) if method in baselines else fit_with_gbid(recording, method))
        if i == 0:
            memory = _peak_bytes() - before
    best = min(answers, key=lambda answer: answer.time_s)
    return {**asdict(best), "first_time_s": answers[0].time_s, "memory_bytes": memory}


def fit_with_gbid(recording: gbid.Recording, method: str) -> Answer:
    """All that `gbid.fit` does: start values from the data, solver, covariance, tests of the residuals; or profiles."""
    if method == "numpy":  # as on a machine without a compiler
        os.environ["CC"] = "/nonexistent/cc"
    began, spent = time.perf_counter(), time.process_time()
    result = gbid.fit(STRUCTURE, recording, criterion="trace")
    wall, cpu = time.perf_counter() - began, time.process_time() - spent
    before = 0.0, 0.0
    if method == "profile":  # after the fit, which is what is built
        before = wall, cpu
        began, spent = time.perf_counter(), time.process_time()
        gbid.profile(result)
        wall, cpu = time.perf_counter() - began, time.process_time() - spent
    complete = all(result.std[q.name] > 0 for q in STRUCTURE.parameters)  # none of the unknowns was held
    return Answer(wall, cpu, *before, result.iterations, result.loss, result.success and complete, dict(result.start))


def _start_of_peak() -> int:
    """Begin a new peak of resident memory where the system can; return what is resident now [bytes].

    Linux hands the peak of the parent on to `getrusage` of its children, so it is read from /proc there.
    """
    if _STATUS.is_file():
        _STATUS.with_name("clear_refs").write_text("5")
        return _status("VmRSS")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _UNIT


def _peak_bytes() -> int:
    """Largest resident memory of this process [bytes]."""
    if _STATUS.is_file():
        return _status("VmHWM")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _UNIT


def _status(field: str) -> int:
    lines = _STATUS.read_text(encoding="utf-8").splitlines()
    return int(next(line for line in lines if line.startswith(f"{field}:")).split()[1]) * 1024


if __name__ == "__main__":
    main()
