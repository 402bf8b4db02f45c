"""The tuner beside CMA-ES, differential evolution and Nelder-Mead: same loops, same evaluations, same time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from time import process_time
from typing import Any

import numpy as np
from scipy.optimize import differential_evolution, minimize

from benchmarks.known_loops import KnownLoop, delayed_pd, integrators, two_masses, two_masses_canonical
from gbid.core.arrays import FloatArray

METHODS = ("CMA-ES", "differential evolution", "Nelder-Mead")


class SpentError(Exception):
    """The evaluations or the time of a method are used up."""


@dataclass
class Limited:
    """Slowest decay of a loop as a function of the gains, which counts evaluations and time and keeps the best."""

    loop: KnownLoop
    evaluations: int
    seconds: float
    best: float = -np.inf
    count: int = 0
    _began: float = field(default_factory=process_time)

    def __call__(self, gains: FloatArray) -> float:
        if self.count >= self.evaluations or process_time() - self._began > self.seconds:
            raise SpentError
        self.count += 1
        x = np.clip(gains, self.loop.lower, self.loop.upper)
        value = -float(np.linalg.eigvals(self.loop.function(x).full()).real.max())
        self.best = max(self.best, value)
        return -value


def compare(quick: bool) -> list[dict[str, Any]]:
    """Run every method on every loop, once with the evaluations and once with the time that gbid took."""
    loops = [delayed_pd()] if quick else [two_masses(), two_masses_canonical(), delayed_pd(), integrators(5)]
    rows = []
    for loop in loops:
        began = process_time()
        ours = loop.tune(evaluations=50) if quick else loop.tune()
        seconds, evaluations = process_time() - began, ours.history[-1].count
        row: dict[str, Any] = {"loop": loop.name, "best": loop.best, "gbid": ours.value, "status": str(ours.status)}
        row |= {"evaluations": evaluations, "cpu_s": seconds}
        for method in METHODS:
            row[f"{method}, evaluations"] = reached(method, Limited(loop, evaluations, np.inf))
            row[f"{method}, time"] = reached(method, Limited(loop, 50 if quick else 10**9, seconds))
        rows.append(row)
    return rows


def reached(method: str, function: Limited) -> float:
    """Best decay that a method finds before its evaluations or its time are used up."""
    low, high = np.array(function.loop.lower), np.array(function.loop.upper)
    runs: dict[str, Callable[[int], object]] = {
        "CMA-ES": lambda seed: _evolution_strategy(function, low, high, seed),
        "differential evolution": lambda seed: differential_evolution(
            function, list(zip(low, high, strict=True)), maxiter=10**6, tol=0, polish=False, seed=seed
        ),
        "Nelder-Mead": lambda seed: minimize(
            function, _middle(low, high, seed), method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-12}
        ),
    }
    try:
        for seed in range(10**6):
            runs[method](seed)
    except SpentError:
        pass
    return function.best


def _middle(low: FloatArray, high: FloatArray, seed: int) -> FloatArray:
    return low + np.random.default_rng(seed).random(len(low)) * (high - low)


def _evolution_strategy(function: Limited, low: FloatArray, high: FloatArray, seed: int) -> None:
    import cma  # here, so that the stored figures are shown where it is not installed

    options = {"bounds": [list(low), list(high)], "verbose": -9, "seed": seed + 1, "CMA_stds": list(high - low)}
    strategy = cma.CMAEvolutionStrategy(_middle(low, high, seed), 0.2, options)
    while not strategy.stop():
        tried = strategy.ask()
        strategy.tell(tried, [function(np.asarray(x)) for x in tried])


def others_table(rows: list[dict[str, Any]]) -> str:
    """Share of the exact best decay that each method reaches, as Markdown."""
    head = "| loop | evaluations | CPU s | gbid | " + " | ".join(f"{m}: evaluations | time" for m in METHODS) + " |"
    lines = [head, "|" + "---|" * (4 + 2 * len(METHODS))]
    for row in rows:
        found = [row["gbid"], *(row[f"{m}, {what}"] for m in METHODS for what in ("evaluations", "time"))]
        shares = " | ".join(f"{100 * max(value, 0.0) / row['best']:.2f} %" for value in found)
        lines.append(f"| {row['loop']} | {row['evaluations']} | {row['cpu_s']:.1f} | {shares} |")
    return "\n".join(lines)
