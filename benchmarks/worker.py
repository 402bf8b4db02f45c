"""One method on one recording, in a process of its own: a request on stdin, an answer on stdout, both JSON.

``python -m benchmarks.worker`` is started by `benchmarks.fit_speed` with one thread in each BLAS.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

import gbid
from benchmarks.baselines import N_STATES, SAMPLE_TIME, STRUCTURE, Answer, Samples, fit_with_casadi, fit_with_scipy
from gbid.identify.data import gather
from gbid.identify.kernel.blocks import cut
from gbid.identify.kernel.linear import CompiledLinearKernel, KernelPattern
from gbid.identify.kernel.sums import powers_of
from gbid.identify.predictor import build_predictor
from gbid.identify.problem.assemble import automatic_window

# ---- The floor of a pass: its multiply-adds, and what the core delivers on a plain matrix product.


@dataclass(frozen=True)
class Floor:
    """One pass over the samples against the multiply-adds in it.

    Attributes
    ----------
    compile_s : float
        Time to compile the kernel, or to load it where it was compiled before [s].
    operations : int
        Multiply-adds that a pass needs for one sample; products with zero not counted.
    rate : float
        Multiply-adds per second in a matrix product.
    floor_s : float
        The pass's multiply-adds at this rate [s].
    kernel_s, pass_s : float
        The recursion and its sums; the same with the linking of the windows [s].
    """

    compile_s: float
    operations: int
    rate: float
    floor_s: float
    kernel_s: float
    pass_s: float


def operations_per_sample(pattern: KernelPattern) -> int:
    """Count the multiply-adds that states, sensitivities and sums need for one sample.

    Every nonzero of a matrix meets one number; a symmetric sum is needed once.
    """
    n_y, n = pattern.C.shape
    n_p = len(pattern.dF)
    triangle = n_y * (n_y + 1) // 2
    state = sum(int(matrix.sum()) for matrix in (pattern.F, pattern.G, pattern.C, pattern.H))
    shared = int(pattern.F.sum() + pattern.C.sum())
    sensitivities = n_p * shared + sum(int(m.sum()) for m in (pattern.dF, pattern.dG, pattern.dC, pattern.dH))
    weighting = (1 + n_p) * triangle
    sums = triangle + n_y * (n_p * (n_p + 1) // 2 + n_p + n_p * n + n)
    return state + sensitivities + weighting + sums


def measure_floor(samples: Samples, parameters: Mapping[str, float], repeats: int) -> Floor:
    """Time a pass at given parameter values, and a matrix product."""
    data = gather([samples.recording()], STRUCTURE.inputs, STRUCTURE.outputs, minimum=100)
    predictor = build_predictor(STRUCTURE, {}, SAMPLE_TIME, STRUCTURE.intersample, "prediction")
    theta = np.array([parameters[q.name] for q in predictor.free])
    v = predictor.at(np.where(theta == 0, 1e-3, theta))
    began = time.perf_counter()
    pattern = KernelPattern.of(v)
    kernel = CompiledLinearKernel(pattern)
    compile_s = time.perf_counter() - began
    blocks = cut(data, predictor, automatic_window(data, "prediction"))
    starts, weight = np.zeros((blocks.n_windows, N_STATES)), np.eye(2)
    begin, free = kernel.begin(v, blocks, starts), v.C @ powers_of(v.F, blocks.length)[:-1]
    kernel_s = _fastest(lambda: kernel.sums(v, blocks, begin, np.eye(2), free), repeats)
    pass_s = _fastest(lambda: kernel.sweep(v, blocks, starts, weight), repeats)
    operations, rate = operations_per_sample(pattern), product_rate(repeats)
    return Floor(compile_s, operations, rate, operations * len(samples.p) / rate, kernel_s, pass_s)


def product_rate(repeats: int, size: int = 768) -> float:
    """Multiply-adds per second of numpy's product of two square matrices, on one thread."""
    left, right = np.random.default_rng(0).standard_normal((2, size, size))
    out = np.empty((size, size))
    return size**3 / _fastest(lambda: np.matmul(left, right, out=out), repeats)


def _fastest(call: Callable[[], object], repeats: int) -> float:
    """Shortest of several runs after one that does not count [s]."""
    call()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return min(times)


# ---- The study.

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
    if method == "floor":
        return asdict(measure_floor(samples, start, repeats))
    recording = samples.recording()
    before = _start_of_peak()
    answers = []
    for i in range(repeats):
        answers.append(
            fit_with_scipy(samples, start)
            if method == "scipy"
            else fit_with_casadi(samples, start)
            if method == "casadi"
            else fit_with_gbid(recording, method)
        )
        if i == 0:
            memory = _peak_bytes() - before
    best = min(answers, key=lambda answer: answer.time_s)
    return {**asdict(best), "first_time_s": answers[0].time_s, "memory_bytes": memory}


def fit_with_gbid(recording: gbid.Recording, method: str) -> Answer:
    """All that `gbid.fit` does: start values from the data, solver, covariance, tests of the residuals."""
    if method != "compiled":  # as on a machine without a compiler
        os.environ["CC"] = "/nonexistent/cc"
    began, spent = time.perf_counter(), time.process_time()
    result = gbid.fit(STRUCTURE, recording, criterion="trace")
    wall, cpu = time.perf_counter() - began, time.process_time() - spent
    whole = all(result.std[q.name] > 0 for q in STRUCTURE.parameters)  # none of the unknowns was held
    return Answer(wall, cpu, 0.0, 0.0, result.iterations, result.loss, result.success and whole, dict(result.start))


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
