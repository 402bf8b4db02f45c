"""Time fits and folders of results over their size, and the share of the compiled passes; print growth exponents.

``python -m tests.benchmarks.scaling [--quick] [--output FILE]``

Times are processor times, the smallest of three runs where these are short. The exponent is that between the two
largest sizes. The folder of 10 000 results takes 4 GB of the disk, as long as it is measured.
"""

from __future__ import annotations

import math
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import casadi as ca
import numpy as np

import gbid
from gbid.identify.kernel import linear
from gbid.serve import server
from gbid.structure import evaluate
from tests.benchmarks.baselines import STRUCTURE, make_samples
from tests.benchmarks.many_results import make_results
from tests.benchmarks.running import about, dgemm_s, markdown, options_of, run_study, timed, under

_VERBS = {  # in the order in which a user calls them first
    "report": ("report",),
    "table": ("batch", "--collect"),
    "run": ("run",),
    "dry_run": ("run", "--dry-run"),
    "resume": ("batch",),
    "one": ("fit", "--one", "piezos/p5_n6000_prbs1"),
}
SIZES = {
    "samples": (10_000, 100_000, 1_000_000, 10_000_000),
    "recordings": (4, 20, 100, 400),
    "states": (2, 10, 20, 40),
    **dict.fromkeys((*_VERBS, "poll"), (10, 100, 1000, 10_000)),
}
WORDS = {
    "samples": "samples of a fit with 24 unknowns",
    "recordings": "recordings of 2 000 samples in one fit, each with unknown initial states",
    "states": "states of a chain of masses, three unknown parameters, 25 000 samples",
    "report": "fits in the first report, with the start of gbid",
    "table": "fits in their first table, with the start",
    "run": "results of `gbid run` with nothing to do, with the start",
    "dry_run": "the same with `--dry-run`",
    "resume": "results of `gbid batch` with nothing to do, with the start",
    "one": "results beside that of `gbid fit --one` with nothing to do, with the start",
    "poll": "results behind a poll of `gbid serve`",
}
_AT = 25_000
_SHORT_S = 5.0


def chain(n_masses: int) -> gbid.LinearStructure:
    """Return a chain of masses between two walls: a force moves the first one, whose position is measured."""
    springs = 2 * np.eye(n_masses) - np.eye(n_masses, k=1) - np.eye(n_masses, k=-1)
    first = np.eye(n_masses, 1)
    zero = np.zeros((n_masses, n_masses))

    def matrices(p: Any) -> Mapping[str, Any]:
        A = ca.blockcat([[zero, np.eye(n_masses)], [-p.k * springs, -p.d * np.eye(n_masses)]])
        return {"A": A, "B": ca.vertcat(0 * first, p.b * first), "C": np.vstack([first, 0 * first]).T}

    parameters = [gbid.Parameter(name, start) for name, start in (("k", 4.2e4), ("d", 38.0), ("b", 1.1))]
    return gbid.LinearStructure("chain", parameters, matrices)


def recordings(structure: gbid.LinearStructure, count: int, n_samples: int) -> list[gbid.Recording]:
    """Return recordings of the chain with other values than those of its start, with white noise."""
    random = np.random.default_rng(1)
    model = evaluate(structure, {"k": 4e4, "d": 40.0, "b": 1.0})
    made = []
    for number in range(count):
        u = np.repeat(random.choice([-1.0, 1.0], n_samples // 20), 20)[:, None]
        y = model.simulate(u, 1e-3)
        y += 0.05 * y.std() * random.standard_normal(y.shape)
        made.append(gbid.Recording({"u": u, "y": y}, 1e-3, name=f"r{number}"))
    return made


def of_samples(n_samples: int) -> Callable[[], Any]:
    """Return the fit of `tests.benchmarks.fit_speed` to so many samples."""
    recording = make_samples(n_samples).recording()
    return lambda: gbid.fit(STRUCTURE, recording, criterion="trace")


def of_recordings(count: int) -> Callable[[], Any]:
    """Return a fit of one mode to so many recordings."""
    structure = chain(1)
    data = recordings(structure, count, 2000)
    return lambda: gbid.fit(structure, data, focus="simulation", initial_state="estimated")


def of_states(n_states: int) -> Callable[[], Any]:
    """Return a fit with so many states."""
    structure = chain(n_states // 2)
    (data,) = recordings(structure, 1, _AT)
    return lambda: gbid.fit(structure, data, focus="simulation")


def smallest(call: Callable[[], Any]) -> float:
    """Return the processor time of a call [s]: the smallest of three after a first one, or of one that is long."""
    result, first = timed(call)
    if not result.success:
        raise RuntimeError(f"not converged: {result.status}")
    return first if first > _SHORT_S else min(timed(call)[1] for _ in range(3))


def of_results(count: int) -> dict[str, float]:
    """Return the processor time of verbs on a folder with so many fits, and that of a poll of its server [s].

    Report and table are made once. The others have nothing to do; they are called after a run that leaves its index.
    """
    with tempfile.TemporaryDirectory() as folder:
        experiment = make_results(Path(folder) / "many", count)
        path = experiment.file.path
        times = {name: verb_s(path, *verb) for name, verb in _VERBS.items()}
        for name in list(_VERBS)[2:]:
            times[name] = min(verb_s(path, *_VERBS[name]) for _ in range(3))
        with mock.patch.object(server, "_REST", 0.0):  # else it does not look again at once
            live = server.Live(path)
            stages = live.state()["stages"].values()
            times["poll"] = min(timed(live.state)[1] for _ in range(3))
        page = (experiment.results / "report.html").read_text(encoding="utf-8")
    if page.count('"facts":[[') != count or any(states != {"kept": count} for states in stages):
        raise RuntimeError(f"the report or the server has not all of the {count} fits")
    return times


def verb_s(path: Path, verb: str, *options: str) -> float:
    """Return the processor time of a verb in a process of its own [s]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-m", "gbid", verb, str(path), *options], check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def share_of_passes() -> dict[str, Any]:
    """Return the processor times of a fit to 25 000 samples, its compiled passes, one of them, and of dgemm [s]."""
    fit, spent, passes = of_samples(_AT), [0.0], list[float]()
    run = linear.run_compiled

    def watched(function: Any, *arguments: Any) -> None:
        took = timed(lambda: run(function, *arguments))[1]
        spent[0] += took
        if function.__name__ == "gbid_pass":
            passes.append(took)

    fit()
    with mock.patch.object(linear, "run_compiled", watched):
        runs = []
        for _ in range(5):
            spent[0] = 0.0
            runs.append((timed(fit)[1], spent[0]))
    fit_s, passes_s = min(runs)
    return {**about(), "fit_s": fit_s, "passes_s": passes_s, "pass_s": min(passes), "dgemm_s": dgemm_s()}


def measure(quick: bool) -> dict[str, Any]:
    """Return the times of all studies by size; of a quick run the two smallest sizes of each."""
    made: dict[str, dict[str, float]] = {}
    fits = {"samples": of_samples, "recordings": of_recordings, "states": of_states}
    folders = cache(of_results)
    for name, sizes in SIZES.items():
        chosen = sizes[:2] if quick else sizes
        times = (smallest(fits[name](size)) if name in fits else folders(size)[name] for size in chosen)
        made[name] = {str(size): time for size, time in zip(chosen, times, strict=True)}
    return {**about(), "passes": share_of_passes(), "times_s": made}


def exponent(times: Mapping[str, float]) -> float:
    """Return the exponent of the growth between the two largest sizes."""
    (before, short), (size, long) = list(times.items())[-2:]
    return math.log(long / short) / math.log(int(size) / int(before))


def scaling_table(run: Mapping[str, Any]) -> str:
    """Return the times over the sizes as Markdown, and the ratio of a fit to its passes."""
    rows = [
        (
            WORDS[name],
            ", ".join(f"{int(size):,}".replace(",", " ") for size in times),
            ", ".join(f"{time:.3g}" for time in times.values()),
            f"{exponent(times):.2f}",
        )
        for name, times in run["times_s"].items()
    ]
    fit_s, passes_s, pass_s, dgemm = (run["passes"][name] for name in ("fit_s", "passes_s", "pass_s", "dgemm_s"))
    text = (
        f"A fit to 25 000 samples takes {fit_s:.3g} s, {fit_s / passes_s:.1f} times its compiled passes; a pass with "
        f"sensitivities takes {pass_s * 1e3:.2g} ms, {pass_s / dgemm:.2f} times a product of two 512 by 512 matrices "
        "on the same core"
    )
    head = ("size", "sizes", "processor time [s]", "exponent")
    return markdown(head, rows, under(dict(run)), under(run["passes"], text))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the studies."""
    options = options_of(__doc__, arguments, quick=(False, "two sizes of each, in a minute"))
    return run_study(lambda: measure(options.quick), options.output, scaling_table)


if __name__ == "__main__":
    raise SystemExit(main())
