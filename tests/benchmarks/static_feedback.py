"""Static output feedback of least H-infinity norm: `gbid.tune` beside BFGS on plants of COMPleib.

``python -m tests.benchmarks.static_feedback --library COMPleib.m [--states N] [--output FILE]``; the library is not
part of gbid.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

import gbid
from gbid.control import PeakResponse, peak_gain
from gbid.core.arrays import FloatArray
from tests.benchmarks.running import about, markdown, options_of, run_study, timed, under

BEST = {
    "NN2": 2.2216,
    "HE1": 0.1538,
    "AC17": 6.6124,
    "NN17": 11.2182,
    "REA3": 74.2513,
    "AC8": 2.0050,
    "TG1": 12.8462,
    "AGS": 8.1732,
    "DIS2": 1.0241,
    "HE2": 3.9030,
    "HE5": 8.8952,
    "REA1": 0.8657,
    "AC15": 15.1687,
    "NN9": 28.6633,
}
"""Lowest norms that any search of this study has found."""
BOUND = 1e3
"""Bound of every gain."""
STARTS = 10
"""Starts of BFGS: no feedback, and normal random gains."""
Objective = Callable[[FloatArray], tuple[float, FloatArray]]


class StaticLoop(NamedTuple):
    """Plant ``x' = A x + B1 w + B u``, ``z = C1 x + D11 w + D12 u``, ``y = C x + D21 w`` with ``u = K y``."""

    A: FloatArray
    B1: FloatArray
    B: FloatArray
    C1: FloatArray
    C: FloatArray
    D11: FloatArray
    D12: FloatArray
    D21: FloatArray

    def closed(self, gains: FloatArray) -> gbid.LinearModel:
        """Loop from w to z."""
        K = gains.reshape(self.B.shape[1], len(self.C))
        left, right = np.vstack([self.B, self.D12]) @ K, np.hstack([self.C, self.D21])
        system, n = np.block([[self.A, self.B1], [self.C1, self.D11]]) + left @ right, len(self.A)
        return gbid.LinearModel(system[:n, :n], system[:n, n:], system[n:, :n], system[n:, n:])

    def norm(self, gains: FloatArray) -> tuple[float, FloatArray]:
        """Exact norm and its gradient."""
        loop = self.closed(gains)
        norm, hz = peak_gain(loop)
        if not np.isfinite(norm):
            return np.inf, np.zeros_like(gains)
        system = 1j * min(2 * np.pi * hz, 1e12) * np.eye(len(self.A)) - loop.A
        states = np.linalg.solve(system, loop.B.astype(complex))
        U, _, Vh = np.linalg.svd(loop.C @ states + loop.D)
        u, v = U[:, 0].conj(), Vh[0].conj()
        rows = np.linalg.solve(system.T, loop.C.T @ u) @ self.B + u @ self.D12
        return norm, np.outer(rows, self.C @ states @ v + self.D21 @ v).real.ravel()

    def growth(self, gains: FloatArray) -> tuple[float, FloatArray]:
        """Largest real part of a pole, and its gradient."""
        values, right = np.linalg.eig(self.closed(gains).A)
        worst = values.real.argmax()
        row = np.linalg.pinv(right)[worst] @ self.B
        return float(values[worst].real), np.outer(row, self.C @ right[:, worst]).real.ravel()

    def tuned(self, **options: Any) -> gbid.control.GainResult:
        """Design by `gbid.tune`."""
        w, u, z, y = (
            tuple(f"{name}{i}" for i in range(M.shape[axis]))
            for name, M, axis in (("w", self.B1, 1), ("u", self.B, 1), ("z", self.C1, 0), ("y", self.C, 0))
        )
        D = np.block([[self.D11, self.D12], [self.D21, np.zeros((len(y), len(u)))]])
        inputs, outputs = np.hstack([self.B1, self.B]), np.vstack([self.C1, self.C])
        plant = gbid.LinearModel(self.A, inputs, outputs, D, input_names=(*w, *u), output_names=(*z, *y))
        names = [f"k_{row}_{column}" for row in u for column in y]

        def matrices(p: Any) -> dict[str, Any]:
            K = ca.reshape(ca.vertcat(*(p[name] for name in names)), len(y), len(u)).T
            return {"A": ca.SX(0, 0), "B": ca.SX(0, len(y)), "C": ca.SX(len(u), 0), "D": K}

        gains = [gbid.Parameter(name, 0.0, -BOUND, BOUND) for name in names]
        structure = gbid.LinearStructure("static feedback", gains, matrices, y, u)
        goals = [PeakResponse(w, z, 1.0, soft=True)]
        return gbid.tune(plant, structure, goals=goals, inputs=u, outputs=y, **options)


# ---- Plants: those of the library, from its MATLAB file, and a chain of masses of any size.


def read_plant(text: str, name: str) -> StaticLoop:
    """Plant of the library by its assignments of matrices."""
    begin = text.index(f"if(strmatch('{name}',")
    block = re.sub(r"%.*", "", text[text.index("\n", begin) : text.index("\nend", begin)])
    M: dict[str, Any] = {}
    for found in re.finditer(r"(?<![\w,\]])(\w+)\s*=\s*((?:[^;\[]|\[[^\]]*\])+);", block):
        M[found[1]] = _value(found[2], M)
    M = {key: np.atleast_2d(np.asarray(value, float)) for key, value in M.items()}
    n, n_u = M["B"].shape
    if "B1" not in M:
        M |= {"B1": np.eye(n), "C1": np.eye(n), "D12": np.eye(n)[:, n - n_u :]}
    zeros = {"D11": ("C1", "B1"), "D21": ("C", "B1"), "D12": ("C1", "B")}
    for key, (rows, columns) in zeros.items():
        M.setdefault(key, np.zeros((len(M[rows]), M[columns].shape[1])))
    return StaticLoop(*(M[key] for key in StaticLoop._fields))


def _value(text: str, known: dict[str, Any]) -> Any:
    """Value of a number, a matrix in brackets, zeros, eye, or a block of rows, with a factor."""
    matrices: list[FloatArray] = []

    def matrix(found: re.Match[str]) -> str:
        rows = [re.findall(r"[^\s,]+", row) for row in re.split(r"[;\n]", found[1])]
        matrices.append(np.block([[np.atleast_2d(_value(x, known)) for x in row] for row in rows if row]))
        return f"M[{len(matrices) - 1}]"

    sizes = {"nx": ("A", 0), "nu": ("B", 1), "nw": ("B1", 1), "nz": ("C1", 0), "ny": ("C", 0)}
    names = {key: known[of].shape[axis] for key, (of, axis) in sizes.items() if of in known}
    names |= known | {"zeros": lambda *size: np.zeros(size), "eye": np.eye, "sqrt": np.sqrt, "size": len}
    text = re.sub(r"\[([^\]]*)\]", matrix, text.strip())
    text = re.sub(r"\b([A-Z]\w*)\((\d+):(\d+),:\)", lambda at: f"{at[1]}[{int(at[2]) - 1}:{at[3]}]", text)
    return eval(text, {"M": matrices, **names})


def chain(n: int) -> StaticLoop:
    """Chain of n / 2 masses and springs; a force on the last, position and velocity of the first fed back there."""
    m = n // 2
    stiff = 2 * np.eye(m) - np.eye(m, k=1) - np.eye(m, k=-1)
    A = np.block([[np.zeros((m, m)), np.eye(m)], [-stiff, -0.02 * stiff - 0.01 * np.eye(m)]])
    first, last = np.eye(2 * m)[m], np.eye(2 * m)[2 * m - 1]
    C = np.eye(2 * m)[[0, m]]
    D12 = np.array([[0.0], [0.1]])
    C1 = np.vstack([np.eye(2 * m)[m - 1], np.zeros(2 * m)])
    return StaticLoop(A, last[:, None], first[:, None], C1, C, np.zeros((2, 1)), D12, np.zeros((2, 1)))


# ---- BFGS with a weak Wolfe line search (A. S. Lewis, M. L. Overton, Mathematical Programming 141, 2013).


def bfgs(objective: Objective, x: FloatArray, most: int, target: float = -np.inf) -> tuple[FloatArray, float]:
    """Local minimum of a nonsmooth function; infinite values are steps that are too long."""
    (f, g), H, vain = objective(x), np.eye(len(x)), 0
    for iteration in range(most):
        p = -H @ g
        if iteration == 0:
            p *= min(1.0, 1 / max(float(np.linalg.norm(p)), 1e-300))
        slope = float(g @ p)
        if f < target or not slope < -1e-14 or vain == 5:
            break
        low, high, t, best = 0.0, np.inf, 1.0, None
        for _ in range(40):
            value, gradient = objective(x + t * p)
            if not value < f + 1e-4 * t * slope:
                high = t
            else:
                low, best = t, (t, value, gradient)
                if gradient @ p >= 0.5 * slope:
                    break
            t = (low + high) / 2 if high < np.inf else 2 * low
        if best is None:
            break
        step, change, vain = best[0] * p, best[2] - g, vain + 1 if f - best[1] < 1e-9 * abs(f) else 0
        x, f, g = x + step, best[1], best[2]
        if (product := float(step @ change)) > 0:
            H = np.eye(len(x)) * product / float(change @ change) if iteration == 0 else H
            E = np.eye(len(x)) - np.outer(step, change) / product
            H = E @ H @ E.T + np.outer(step, step) / product
    return x, f


def best_of_bfgs(plant: StaticLoop) -> float:
    """Least norm from several starts, which BFGS first makes stable."""
    random, size = np.random.default_rng(0), plant.B.shape[1] * len(plant.C)
    norms = []
    for i in range(STARTS):
        x = random.standard_normal(size) * (i > 0)
        x, growth = bfgs(plant.growth, x, 200, -1e-6)
        norms.append(bfgs(plant.norm, x, 300)[1] if growth < 0 else np.inf)
    return min(norms)


# ---- The study.


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table of the study and store its figures."""
    options = options_of(
        __doc__,
        arguments,
        "static-feedback.json",
        library=(str, "COMPleib.m"),
        states=(200, "states of the chain"),
        plants=(tuple(BEST), "plants (all of the table)"),
    )
    text = Path(options.library).read_text(encoding="latin-1")
    return run_study(lambda: measure(text, options.plants, options.states), options.output, feedback_table)


def measure(text: str, plants: Sequence[str], states: int) -> dict[str, Any]:
    """Norms and processor times of both methods."""
    read_plant(text, "NN2").tuned(starts=2)  # imports and first calls are not counted
    rows = []
    for name in plants:
        plant = read_plant(text, name)
        result, spent = timed(plant.tuned)
        norm = peak_gain(plant.closed(np.array(list(result.gains.values())))).value
        theirs, needed = timed(partial(best_of_bfgs, plant))
        row = {"plant": name, "gains": len(result.gains), "norm": norm, "status": str(result.status), "cpu_s": spent}
        rows.append({**row, "bfgs": theirs, "bfgs_cpu_s": needed})
        print(rows[-1], flush=True)
    large = chain(states)
    result, spent = timed(large.tuned)
    norm = peak_gain(large.closed(np.array(list(result.gains.values())))).value
    last = {"states": states, "norm": norm, "open": large.norm(np.zeros(2))[0], "cpu_s": spent}
    return {**about(), "plants": rows, "chain": {**last, "status": str(result.status)}}


def feedback_table(run: dict[str, Any]) -> str:
    """All numbers as Markdown."""
    head = ("plant", "gains", "norm", "best known", "excess", "BFGS", "tune [CPU s]", "over BFGS", "status")
    rows = []
    for q in run["plants"]:
        best, ratio = BEST[q["plant"]], q["cpu_s"] / q["bfgs_cpu_s"]
        norms = f"{q['norm']:.5g}", f"{best:g}", f"{100 * (q['norm'] / best - 1):.2f} %", f"{q['bfgs']:.5g}"
        rows.append((q["plant"], q["gains"], *norms, f"{q['cpu_s']:.2f}", f"{ratio:.2f}", q["status"]))
    q = run["chain"]
    change = f"{q['open']:.4g} without feedback to {q['norm']:.4g}"
    words = f"Chain of {q['states']} states with two gains: {change} in {q['cpu_s']:.1f} CPU s, {q['status']}"
    return markdown(head, rows, under(run, words))


if __name__ == "__main__":
    raise SystemExit(main())
