"""Tuning and fitting in several threads at once: the same bits as in turn.

``python -m benchmarks.threads [--threads N] [--rounds M]``

In each round all threads start together, each with a task of its own: designs with different limits and fits of
different recordings, linear and nonlinear. All numbers of each result are compared with those of the same task alone.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from scipy.signal import cont2discrete, lfilter

import gbid
from benchmarks.running import options_of


def springs_fit(seed: int) -> bytes:
    """Return the bytes of estimates and covariance of a mass on a spring, made by scipy."""
    random = np.random.default_rng(seed)
    numerator, denominator, _ = cont2discrete(([1e6], [1.0, 20.0, 6e4 + 500 * seed]), 1e-3, "zoh")
    drive = np.repeat(random.choice([-1.0, 1.0], 60), 10)
    position = lfilter(numerator[0], denominator, drive) + 0.1 * random.standard_normal(600)
    recording = gbid.Recording({"u": drive, "y": position}, 1e-3)

    def matrices(p):
        return {"A": [[0, 1], [-p.k, -p.d]], "B": [[0], [p.b]], "C": [[1, 0]]}

    parameters = [gbid.Parameter("k", 5e4), gbid.Parameter("d", 15.0), gbid.Parameter("b", 8e5)]
    result = gbid.fit(gbid.LinearStructure("spring", parameters, matrices), recording, focus="simulation")
    return np.array([*result.parameters.values(), result.loss, *np.ravel(result.covariance)]).tobytes()


def design(number: int) -> bytes:
    """Return the bytes of the gains of a design at an operating point."""
    points, limit = [(4.0 + 0.25 * number, 3000.0)], 1.8 + 0.1 * number
    result = gbid.tune(gbid.load_model("theisen2016"), operating_points=points, peak_sensitivity=limit, starts=2)
    return np.array([*result.gains.values(), result.objective]).tobytes()


def tasks_of(count: int) -> list[Callable[[], bytes]]:
    """Return tasks: designs and fits in turn, each with numbers of its own."""
    return [partial(design if i % 2 else springs_fit, i // 2) for i in range(count)]


def at_once(tasks: list[Callable[[], bytes]]) -> list[bytes]:
    """Return the results of tasks that start at the same instant, a thread for each."""
    gate = threading.Barrier(len(tasks))

    def run(task: Callable[[], bytes]) -> bytes:
        gate.wait()
        return task()

    with ThreadPoolExecutor(len(tasks)) as pool:
        return list(pool.map(run, tasks))


def main() -> None:
    """Run the rounds; end with 1 when a result differs from that of its task alone."""
    given = options_of(__doc__, threads=(12, "at once"), rounds=(20, "how many"))
    tasks = tasks_of(given.threads)
    alone = [task() for task in tasks]
    differ = 0
    for number in range(1, given.rounds + 1):
        differ += sum(a != b for a, b in zip(at_once(tasks), alone, strict=True))
        print(f"round {number}: {differ} of {number * len(tasks)} results differ", flush=True)
    raise SystemExit(bool(differ))


if __name__ == "__main__":
    main()
