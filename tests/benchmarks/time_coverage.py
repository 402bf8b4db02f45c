"""Coverage of 95 % intervals at irregular times and with missing samples, on data of a generator by scipy's expm.

An oscillator of 10 rad/s with 8 % damping goes exactly from each time to the next. The times are those of an even
clock, of one whose steps vary by up to 70 %, of two loggers with 20 and 13 Hz whose samples lie between one another, or
of a clock with a jitter of 10 % that loses a tenth of its samples. Of each kind many recordings are fitted.
Disturbances are white errors of the output, errors that the model feeds back, or Wiener noise on the acceleration.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np
import scipy

import gbid
from gbid import LinearStructure, Parameter, Recording
from gbid.core.arrays import FloatArray
from tests.benchmarks.running import about, markdown, options_of, run_study

TRUTH = {"w": 10.0, "z": 0.08, "g": 100.0, "k1": 3.0, "k2": 8.0}
"""Frequency [rad/s], damping, gain, and disturbance gains [1/s] of the oscillator."""
MEAN_STEP = 0.03
"""Mean time between samples of one logger [s]."""
_ERROR, _WIENER = 0.02, 0.3  # errors of the output; intensity of the acceleration
Clock = Literal["even", "jitter", "two loggers", "lost and jitter"]
Errors = Literal["white", "fed back", "Wiener"]


class Case(NamedTuple):
    """Kind of recording and fit: clock, share of outputs that are missing, hold of the input, errors."""

    clock: Clock
    missing: float
    hold: Literal["zoh", "foh"]
    errors: Errors


CASES = (
    Case("even", 0.0, "zoh", "fed back"),
    Case("even", 0.1, "zoh", "fed back"),
    Case("even", 0.0, "zoh", "white"),
    Case("even", 0.1, "zoh", "white"),
    Case("jitter", 0.0, "zoh", "white"),
    Case("jitter", 0.0, "foh", "white"),
    Case("two loggers", 0.0, "zoh", "white"),
    Case("two loggers", 0.0, "foh", "white"),
    Case("lost and jitter", 0.0, "foh", "white"),
    Case("jitter", 0.1, "foh", "white"),
    Case("jitter", 0.0, "zoh", "fed back"),
    Case("jitter", 0.1, "zoh", "fed back"),
    Case("even", 0.0, "zoh", "Wiener"),
    Case("jitter", 0.0, "zoh", "Wiener"),
    Case("two loggers", 0.0, "zoh", "Wiener"),
)


def structure() -> LinearStructure:
    """Return the oscillator, with a disturbance gain."""

    def matrices(p: Any) -> dict[str, Any]:
        A = ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-(p.w**2), -2 * p.z * p.w))
        return {"A": A, "B": ca.vertcat(0, p.g), "C": ca.DM([[1.0, 0.0]]), "K": ca.vertcat(p.k1, p.k2)}

    start = {"w": 9.0, "z": 0.1, "g": 80.0, "k1": 1.0, "k2": 1.0}
    return LinearStructure("oscillator", [Parameter(*each) for each in start.items()], matrices, ["u"], ["y"])


def step_matrix(p: dict[str, float], step: float) -> FloatArray:
    """Return the exact step of ``[x, u, slope of u, e]``, (5, 5); u is on a line, and e is held."""
    M = np.zeros((5, 5))
    M[:2, :2] = [[0, 1], [-(p["w"] ** 2), -2 * p["z"] * p["w"]]]
    M[1, 2], M[2, 3], M[:2, 4] = p["g"], 1.0, [p["k1"], p["k2"]]
    return np.asarray(scipy.linalg.expm(M * step))


def wiener_covariance(p: dict[str, float], step: float) -> FloatArray:
    """Return the covariance that noise on the acceleration adds to the state in a step, (2, 2) (Van Loan, 1978)."""
    A, M = np.array([[0, 1], [-(p["w"] ** 2), -2 * p["z"] * p["w"]]]), np.zeros((4, 4))
    M[:2, :2], M[2:, 2:], M[1, 3] = -A, A.T, _WIENER**2
    M = scipy.linalg.expm(M * step)
    return np.asarray(M[2:, 2:].T @ M[:2, 2:])


def times(clock: Clock, seed: int, n: int) -> FloatArray:
    """Return the times of about n samples [s]."""
    random = np.random.default_rng(1000 + seed)
    if clock == "jitter":
        return np.asarray(np.cumsum(MEAN_STEP * random.uniform(0.3, 1.7, n)))
    if clock == "two loggers":
        end = n * MEAN_STEP
        return np.unique(np.round(np.concatenate([np.arange(0, end, 0.05), np.arange(0.0113, end, 0.075)]), 6))
    even = MEAN_STEP * np.arange(n)
    if clock == "even":
        return np.asarray(even)
    return np.asarray((even + 0.1 * MEAN_STEP * random.uniform(-1, 1, n))[random.random(n) > 0.1])


def recording(case: Case, seed: int, n: int = 500) -> tuple[Recording, FloatArray]:
    """Return a recording, exact from each time to the next, and the errors of its output (n_samples,)."""
    random, time = np.random.default_rng(seed), times(case.clock, seed, n)
    n = len(time)
    held = case.hold == "zoh"
    u = random.choice([-1.0, 1.0], n) if held else np.sin(3 * time) + 0.5 * random.standard_normal(n)
    e, y, x = _ERROR * random.standard_normal(n), np.empty(n), np.zeros(2)
    for k in range(n):
        y[k] = x[0] + e[k]
        if k + 1 < n:
            step = time[k + 1] - time[k]
            slope = 0.0 if held else (u[k + 1] - u[k]) / step
            x = (step_matrix(TRUTH, step) @ [*x, u[k], slope, e[k] * (case.errors == "fed back")])[:2]
            if case.errors == "Wiener":
                x = x + random.multivariate_normal(np.zeros(2), wiener_covariance(TRUTH, step))
    y = np.where(random.random(n) < case.missing, np.nan, y)
    clock: dict[str, Any] = {"sample_time": MEAN_STEP} if case.clock == "even" else {"stamps": time}
    return Recording({"u": u, "y": y}, name=f"s{seed}", **clock), e


def ratios(case: Case, seeds: int) -> tuple[FloatArray, int]:
    """Return errors of w, z and g over their standard deviations, (n_fits, 3), and how many fits did not converge."""
    rows, failed = [], 0
    focus = "simulation" if case.errors == "white" else "prediction"
    for seed in range(seeds):
        result = gbid.fit(structure(), recording(case, seed)[0], focus=focus, intersample=case.hold)
        failed += not result.success
        rows.append([(result.parameters[q] - TRUTH[q]) / result.std[q] for q in ("w", "z", "g")])
    return np.array(rows), failed


def measure(seeds: int) -> dict[str, Any]:
    """Return the coverage of all cases."""
    rows = []
    for case in CASES:
        errors, failed = ratios(case, seeds)
        rows.append({**case._asdict(), "covered": float((np.abs(errors) < 1.96).mean()), "failed": failed})
    return {**about(), "seeds": seeds, "rows": rows}


def coverage_table(run: dict[str, Any]) -> str:
    """Return the coverage as Markdown, in percent."""
    rows = [
        (q["clock"], f"{100 * q['missing']:g} %", q["hold"], q["errors"], f"{100 * q['covered']:.1f}")
        for q in run["rows"]
    ]
    failed = sum(row["failed"] for row in run["rows"])
    note = f"{run['seeds']} recordings in each row ({failed} fits failed), {run['date']}, gbid {run['gbid']}."
    return markdown(("clock", "missing", "hold", "errors", "covered"), rows, note)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    options = options_of(__doc__, arguments, "time_coverage.json", seeds=(100, "recordings of each kind"))
    return run_study(lambda: measure(options.seeds), options.output, coverage_table)


if __name__ == "__main__":
    sys.exit(main())
