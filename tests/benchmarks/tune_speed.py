"""Time the tuner against brute force and general optimisers in one run; print a table, store the numbers.

``python -m tests.benchmarks.tune_speed [--quick] [--polish N] [--output FILE]``
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from time import process_time
from typing import Any

import numpy as np
from scipy.optimize import differential_evolution, minimize

import gbid
from gbid.control import p_controller
from gbid.core.arrays import FloatArray
from tests.benchmarks.known_loops import KnownLoop, delayed_pd, integrators, two_masses, two_masses_canonical
from tests.benchmarks.running import about, markdown, options_of, run_study, timed, under

# ---- Two P gains by brute force, with nothing of gbid's tuner: a grid of 0.01 and Nelder-Mead from its best points.

COARSE = np.concatenate([[0.0], np.geomspace(3.0, 2000.0, 60)])
FINE = np.concatenate([[0.0], np.geomspace(0.5, 5000.0, 1500)])


@dataclass(frozen=True)
class Brute:
    """Best value and gains of the grid and of the polish of its best points, and of all that was tried."""

    grid_value: float
    value: float
    gains: tuple[float, float]


class Loops:
    """Closed loops of the published model under P gains: matrices by superposition, responses by complex arithmetic."""

    def __init__(self, model: gbid.LPVModel, points: Sequence[tuple[float, float]]) -> None:
        self.plants = [model.plant_at(*point) for point in points]
        loops = [
            [gbid.close_loop(plant, p_controller(*gains)).A for gains in ((0, 0), (1, 0), (0, 1))]
            for plant in self.plants
        ]
        self.A = np.array([zero for zero, _, _ in loops])
        self.by_gain = np.array([[x - zero, y - zero] for zero, x, y in loops])
        self._responses: dict[int, tuple[FloatArray, Any]] = {}

    def damping(self, gains: FloatArray, i: int) -> FloatArray:
        """Smallest damping factor of loop i under many pairs of gains (N, 2); -1 where it is unstable."""
        values = np.linalg.eigvals(self.A[i] + np.tensordot(gains, self.by_gain[i], axes=1))
        oscillates = np.abs(values.imag) > 1e-9 * np.abs(values)
        factors = np.where(oscillates, -values.real / np.abs(values), 1.0).min(axis=1)
        return np.where((values.real >= 0).any(axis=1), -1.0, factors)

    def peak(self, gains: FloatArray, i: int, frequencies: FloatArray) -> float:
        """Largest singular value of S_o of loop i at given frequencies [Hz]."""
        G, lag = self._at(i, frequencies)
        S = np.linalg.inv(np.eye(2) - G * (gains * lag[:, None])[:, None, :])
        return float(np.linalg.svd(S, compute_uv=False)[:, 0].max())

    def _at(self, i: int, frequencies: FloatArray) -> tuple[Any, Any]:
        key = i * 10_000 + len(frequencies)
        if key not in self._responses:
            lag = 1 / (1 + 1j * frequencies / 1000.0)
            self._responses[key] = (self.plants[i].frequency_response(frequencies), lag)
        return self._responses[key]

    def value(self, gains: FloatArray, cap: float | None, frequencies: FloatArray, floor: float = -1.0) -> float:
        """Smallest damping over all loops, -1 where the cap is not kept; stops early below a floor."""
        worst = 1.0
        for i in range(len(self.plants)):
            worst = min(worst, float(self.damping(gains[None], i)[0]))
            if worst <= floor:
                return worst
        if cap is not None and any(self.peak(gains, i, frequencies) > cap for i in range(len(self.plants))):
            return -1.0
        return worst


def survivors(loops: Loops, cap: float | None, floor: float, step: float = 0.01) -> tuple[FloatArray, FloatArray]:
    """Points of the grid over [0, 3]^2 whose value lies above a floor, and their values, best first."""
    axis = np.arange(0.0, 3.0 + step / 2, step)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    values = np.ones(len(grid))
    order = np.argsort([loops.damping(np.array([[1.0, 1.0]]), i)[0] for i in range(len(loops.plants))])
    for i in order:  # the loops that damp least first: they leave little for the others
        values = np.minimum(values, loops.damping(grid, int(i)))
        keep = values > floor
        grid, values = grid[keep], values[keep]
    if cap is not None:
        kept = np.array([all(loops.peak(g, i, COARSE) <= cap for i in range(len(loops.plants))) for g in grid], bool)
        grid, values = grid[kept.astype(bool)], values[kept.astype(bool)]
    best = np.argsort(-values)
    return grid[best], values[best]


def brute_force(loops: Loops, cap: float | None, floor: float, polish: int = 20) -> Brute:
    """Best of the grid above a floor, and Nelder-Mead from its best points."""
    grid, values = survivors(loops, cap, floor)
    best, gains = (float(values[0]), grid[0]) if len(grid) else (-1.0, np.zeros(2))
    grid_value = best
    for start in grid[:polish]:
        simplex = start + np.array([[0, 0], [0.01, 0], [0, 0.01]])
        limits = {"xatol": 1e-9, "fatol": 1e-10, "maxfev": 250, "initial_simplex": simplex}
        computed = minimize(
            lambda g: -loops.value(g, cap, FINE if cap else COARSE), start, method="Nelder-Mead", options=limits
        )
        if -computed.fun > best:
            best, gains = float(-computed.fun), computed.x
    return Brute(grid_value, best, (float(gains[0]), float(gains[1])))


# ---- The tuner beside CMA-ES, differential evolution and Nelder-Mead: same loops, same evaluations, same time.

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
        ours, seconds = timed(lambda loop=loop: loop.tune(**({"evaluations": 50} if quick else {})))  # type: ignore[misc]
        evaluations = ours.history[-1].count
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
    limits = [(method, what) for method in METHODS for what in ("evaluations", "time")]
    heads = (f"{method}: {what}" if what == "evaluations" else what for method, what in limits)
    lines = []
    for row in rows:
        values = (row["gbid"], *(row[f"{method}, {what}"] for method, what in limits))
        shares = (f"{100 * max(value, 0.0) / row['best']:.2f} %" for value in values)
        lines.append((row["loop"], row["evaluations"], f"{row['cpu_s']:.1f}", *shares))
    return markdown(("loop", "evaluations", "CPU s", "gbid", *heads), lines)


# ---- The study.

_ONE = [(6.0, 0.0)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = options_of(
        __doc__,
        arguments,
        quick=(False, "one operating point and cap, P gains in place of biquads: to see that it works"),
        polish=(5, "how many grid points brute force polishes (default 5)"),
    )
    polish = 1 if options.quick else options.polish
    return run_study(lambda: measure(options.quick, polish), options.output, tune_table)


def measure(quick: bool, polish: int) -> dict[str, Any]:
    """Two P gains beside brute force, and a second-order filter per axis beside the P gains."""
    model = gbid.load_model("theisen2016")
    plans = [_ONE] if quick else [_ONE, list(model.operating_points)]

    def tuned(points: Any, cap: float | None, **more: Any) -> tuple[gbid.control.GainResult, dict[str, Any]]:
        result, spent = timed(lambda: gbid.tune(model, operating_points=points, peak_sensitivity=cap, **more))
        return result, {"n_points": len(points), "cap": cap, "damping": result.value, "cpu_s": spent}

    tuned(_ONE, None)  # imports and first calls are not counted, here of grid and random starts
    tuned(_ONE, None, starts=1)
    brute, biquad = [], []
    for points in plans:
        for cap in (None,) if quick else (None, 2.6):
            ours, row = tuned(points, cap)
            # brute force is given a floor from the answer: without it, its grid alone takes far longer
            theirs, spent = timed(partial(brute_force, Loops(model, points), cap, ours.value - 0.03, polish))
            brute.append({**row, "brute_damping": theirs.value, "brute_cpu_s": spent})
        for cap in (2.0,) if quick else (2.0, 2.6):
            _, row = tuned(points, cap, controller="P" if quick else "biquad")
            biquad.append({**row, "p_damping": tuned(points, cap)[0].value})
    return {**about(), "polished": polish, "proportional": brute, "biquad": biquad, "others": compare(quick)}


def tune_table(run: dict[str, Any]) -> str:
    """All numbers as Markdown."""
    return "\n\n".join([proportional_table(run), biquad_table(run), others_table(run["others"]), under(run)])


def proportional_table(run: dict[str, Any]) -> str:
    """Two P gains beside brute force."""
    head = ("P gains: points", "cap", "tune [CPU s]", "brute force [CPU s]", "ratio", "damping", "of brute force")
    rows = []
    for q in run["proportional"]:
        times = f"{q['cpu_s']:.2f}", f"{q['brute_cpu_s']:.1f}", f"{q['brute_cpu_s'] / q['cpu_s']:.0f}"
        rows.append((q["n_points"], _cap(q), *times, f"{q['damping']:.6f}", f"{q['brute_damping']:.6f}"))
    return markdown(head, rows)


def biquad_table(run: dict[str, Any]) -> str:
    """A second-order filter per axis beside P gains."""
    rows = []
    for q in run["biquad"]:
        values = f"{q['damping']:.4f}", f"{q['p_damping']:.4f}", f"{q['damping'] / q['p_damping']:.2f}"
        rows.append((q["n_points"], _cap(q), f"{q['cpu_s']:.1f}", *values))
    return markdown(("biquad: points", "cap", "tune [CPU s]", "damping", "of P gains", "ratio"), rows)


def _cap(row: dict[str, Any]) -> str:
    return "none" if row["cap"] is None else f"{row['cap']:g}"


if __name__ == "__main__":
    raise SystemExit(main())
