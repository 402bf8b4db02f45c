"""Tune every structure on random plants and judge the designs by numpy alone.

Double integrators, unstable plants, delays, plants with three inputs and two outputs, direct feed-through, 20 to 40
states, units from 1e-9 to 1e9. A run fails by an exception, by twice its budget, by a design that numpy calls unstable
although it keeps its limits, or by "no stabilising gains" where one of 500 random gains stabilises. Where the time
ended such a search, it is repeated with 5000 evaluations, and counted as a second search.

``python -m tests.benchmarks.random_plants [--plants N] [--seconds S] [--first SEED] [--failures] [--output FILE]``;
with ``--failures`` only the failures of the stored run are tried again.
"""

from __future__ import annotations

import sys
import traceback
from collections import Counter
from collections.abc import Sequence
from time import monotonic, process_time
from typing import Any

import casadi as ca
import numpy as np

import gbid
from gbid.control import GainStatus, MaxDamping, PeakSensitivity, controller_at, sampled_loop, state_feedback
from gbid.control.controllers.built_in import built_in_structures
from tests.benchmarks.running import about, options_of, run_study, stored

PLANTS = ("double integrator", "unstable", "delay", "3 x 2", "feed-through", "many states")
_TRIED = 500
_AGAIN = 5000


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    numbers: dict[str, tuple[Any, str]] = {
        "plants": (500, "number of plants"),
        "seconds": (1.0, "budget of a search"),
        "first": (0, "first seed"),
    }
    numbers["failures"] = (False, "try the failures of the stored run again")
    options = options_of(__doc__, arguments, "random-plants.json", **numbers)
    if options.failures:
        return run_study(lambda: again(stored(options.output, {})), options.output, summary)
    return run_study(lambda: study(options.first, options.plants, options.seconds), options.output, summary)


def again(run: dict[str, Any]) -> dict[str, Any]:
    """Return a stored run in which the plants that failed are replaced by new searches."""
    statuses, failures = Counter(run["statuses"]), []
    for failure in run["failures"]:
        new = study(failure["seed"], 1, run["seconds"])
        statuses.subtract([failure["status"]])
        statuses.update(new["statuses"])
        failures += new["failures"]
    return {**run, "statuses": dict(+statuses), "failures": failures}


def study(first: int, count: int, seconds: float) -> dict[str, Any]:
    """Return how often each status came, and every failure with its seed."""
    statuses: Counter[str] = Counter()
    failures = []
    for seed in range(first, first + count):
        try:
            status, problem = judged(seed, seconds)
        except Exception:
            status, problem = "exception", traceback.format_exc(limit=-2)
        statuses[status] += 1
        if problem:
            failures.append({"seed": seed, "status": status, "what": problem})
            print(seed, problem, flush=True)
    return {"about": about(), "plants": count, "seconds": seconds, "statuses": dict(statuses), "failures": failures}


def summary(run: dict[str, Any]) -> str:
    """Return the result in words."""
    counts = ", ".join(f"{count} {status}" for status, count in sorted(run["statuses"].items()))
    failures = "".join(f"\n  {failure['what']}" for failure in run["failures"])
    return f"{run['plants']} plants, {run['seconds']:g} s each: {counts}\nfailures: {len(run['failures'])}{failures}"


def judged(seed: int, seconds: float, again: bool = False) -> tuple[str, str]:
    """Return the status of one design, and what is wrong with it; `again` is true of a second search."""
    rng = np.random.default_rng(seed)
    kind = PLANTS[seed % len(PLANTS)]
    plant, scale = random_plant(kind, rng)
    structure, bounds, options = random_structure(plant, scale, rng)
    if kind == "delay":
        options["sample_time"] = 1.0 / (60 * rate_of(plant))
    goals = [MaxDamping()] if rng.random() < 0.5 else [MaxDamping(), PeakSensitivity(3.0)]
    began, used = monotonic(), process_time()
    budget: Any = {"evaluations": _AGAIN} if again else {"seconds": seconds}
    result = gbid.tune(plant, structure, goals=goals, bounds=bounds, seed=seed, **budget, **options)
    what = f"{kind}, {getattr(structure, 'name', structure)}, {len(result.gains)} gains"
    if not again and min(monotonic() - began, process_time() - used) > 2 * seconds + 0.5:
        return result.status, f"{what}: {process_time() - used:.1f} s of processor time"
    if result.keeps_limits and not is_stable(plant, result.controller, dict(result.gains), options):
        return result.status, f"{what}: {result.status}, but unstable"
    if result.status is GainStatus.NO_STABILISING_GAINS and random_gains_stabilise(plant, result, bounds, options, rng):
        if "budget" in " ".join(result.notes) and not again:
            status, problem = judged(seed, seconds, again=True)
            return f"{status} (second search)", problem
        return result.status, f"{what}: random gains stabilise"
    return result.status, ""


def random_gains_stabilise(
    plant: gbid.LinearModel, result: gbid.GainResult, bounds: Any, options: Any, rng: np.random.Generator
) -> bool:
    """Return whether one of some random gains within the bounds makes the loop stable."""
    low, high = np.array([bounds[name] for name in result.gains]).T
    draws = low + rng.random((_TRIED, len(low))) * (high - low)
    return any(is_stable(plant, result.controller, dict(zip(result.gains, x, strict=True)), options) for x in draws)


def rate_of(plant: gbid.LinearModel) -> float:
    """Return the largest rate of a plant [rad/s]."""
    return float(np.abs(plant.poles()).max())


def random_plant(kind: str, rng: np.random.Generator) -> tuple[gbid.LinearModel, float]:
    """Return a plant of rates near 300 rad/s, and the size of its outputs over its inputs."""
    n_in = n_out = int(rng.choice([1, 2, 4]))
    if kind == "3 x 2":
        n_in, n_out = 3, 2
    n = int(rng.integers(20, 41)) if kind == "many states" else int(rng.integers(2, 9))
    A = 300 * (rng.standard_normal((n, n)) / np.sqrt(n) - (0.4 if kind == "unstable" else 1.2) * np.eye(n))
    scale = 10.0 ** rng.uniform(-9, 9)
    B, C = 300 * rng.standard_normal((n, n_in)), scale * rng.standard_normal((n_out, n)) / n
    if kind == "double integrator":
        n = 2 * n_in
        A = np.kron([[0.0, 1.0], [0.0, 0.0]], np.eye(n_in))
        B, C = np.vstack([np.zeros((n_in, n_in)), 9e4 * np.eye(n_in)]), scale * np.eye(n)[:n_in]
    D = scale * 0.2 * rng.standard_normal((n_out, n_in)) * (kind == "feed-through")
    if kind == "delay":
        delay = rng.uniform(0, 0.1 / 300, n_in)
        return gbid.LinearModel(A, 0 * B, C, 0 * D, B_delayed=B, delay=delay), scale
    return gbid.LinearModel(A, B, C, D), scale


def random_structure(plant: gbid.LinearModel, scale: float, rng: np.random.Generator) -> tuple[Any, Any, Any]:
    """Return a structure with options for rotors, bounds in the units of the plant, and options of the search."""
    n_out, n_in = plant.D.shape
    if n_out != n_in:
        structure: Any = lagged(n_in, n_out)
    elif rng.random() < 0.1 and plant.delay is None:
        structure = state_feedback(plant, position=scale * 10 ** rng.uniform(-1, 1))
        return structure, {p.name: (p.lower, p.upper) for p in structure.parameters}, {}
    else:
        kind = str(rng.choice(sorted(built_in_structures())))
        options: dict[str, Any] = {"axes": tuple(f"a{i}" for i in range(n_in))}
        if rng.random() < 0.3 and not kind.startswith("full"):
            options["gain_sets"] = ("",) * n_in
        if rng.random() < 0.3 and n_in % 2 == 0 and kind != "observer" and not kind.startswith("full"):
            options["coupling"] = "gyroscopic"
        if rng.random() < 0.3 and n_in % 2 == 0 and "gain_sets" not in options:
            options |= {"sensors_m": (-0.1, 0.2), "actuators_m": (-0.15, 0.1)}
        if rng.random() < 0.3:
            options["notch_orders"] = (1.0,)
        if rng.random() < 0.5 and kind in ("PD", "PID", "full PD"):
            options |= {"derivative_khz": (0.05, 1.0), "order": 0}
        structure = gbid.controller_structure(kind, **options)
    follows = getattr(structure, "follows_speed", False)
    bounds = {}
    for gain in structure.parameters:
        unit = 1 / scale if gain.unit in ("m/m", "ms", "1/s") else 1.0
        bounds[gain.name + ("_1" if follows else "")] = (gain.lower * unit, gain.upper * unit)
    return structure, bounds, {"speeds_rpm": (3000.0,)} if follows else {}


def lagged(n_in: int, n_out: int) -> gbid.LinearStructure:
    """Return a matrix of gains behind lags of 300 Hz."""
    gains = [gbid.Parameter(f"k{i}{j}", 0.0, -3.0, 3.0, unit="m/m") for i in range(n_in) for j in range(n_out)]
    inputs, outputs = tuple(f"y{j}" for j in range(n_out)), tuple(f"u{i}" for i in range(n_in))

    def matrices(p: Any) -> dict[str, Any]:
        K = ca.vertcat(*(ca.horzcat(*(p[f"k{i}{j}"] for j in range(n_out))) for i in range(n_in)))
        lag = 600 * np.pi * np.eye(n_out)
        return {"A": -lag, "B": lag, "C": K, "D": ca.SX(n_in, n_out)}

    return gbid.LinearStructure("lagged gains", gains, matrices, inputs, outputs)


def is_stable(plant: gbid.LinearModel, structure: Any, gains: dict[str, float], options: dict[str, Any]) -> bool:
    """Return whether the eigenvalues of the loop, put together by numpy, are stable; a sampled loop has gbid's own."""
    law = controller_at(structure, gains, 0.0, 3000.0)
    if T := options.get("sample_time"):
        named = gbid.LinearModel(
            law.A, law.B, law.C, law.D, input_names=plant.output_names, output_names=plant.input_names
        )
        return sampled_loop(plant, named, T).stable
    inner = np.eye(len(law.D)) - law.D @ plant.D
    if np.linalg.cond(inner) > 1e12:
        return False
    R = np.linalg.inv(inner)
    S = np.eye(len(plant.D)) + plant.D @ R @ law.D
    A = np.block(
        [
            [plant.A + plant.B @ R @ law.D @ plant.C, plant.B @ R @ law.C],
            [law.B @ S @ plant.C, law.A + law.B @ plant.D @ R @ law.C],
        ]
    )
    return bool(np.linalg.eigvals(A).real.max() < 0)


if __name__ == "__main__":
    sys.exit(main())
