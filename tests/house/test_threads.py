"""Designs and fits in several threads at once have the bits of those in turn."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from scipy.signal import cont2discrete, lfilter

import gbid


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


def test_designs_and_fits_at_once_have_the_bits_of_those_in_turn() -> None:
    tasks = tasks_of(4)
    assert at_once(tasks) == [task() for task in tasks]
