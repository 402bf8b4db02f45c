"""Designs of ten seeds, each beside the best of all: biquads at twelve operating points, two plants of COMPleib.

``python -m tests.benchmarks.tune_seeds [--seeds N] [--output FILE]`` takes about ten minutes of processor time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import Any

import gbid
from tests.benchmarks.known_loops import reactor, tuned_mass_damper
from tests.benchmarks.running import about, markdown, options_of, run_study, timed, under

STORED = "tune-seeds.json"
NEAR = 0.02
"""Share of the best value within which a design counts as equally good."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    options = options_of(__doc__, arguments, STORED, seeds=(10, "number of seeds"))
    return run_study(lambda: measure(options.seeds), options.output, seeds_table)


def problems() -> dict[str, Callable[..., gbid.control.GainResult]]:
    """Return the searches by name, as functions of the seed."""
    model = gbid.load_model("theisen2016")
    searches: dict[str, Callable[..., gbid.control.GainResult]] = {
        f"biquad, {P} bar, {speed} rpm, peak {cap}": partial(
            gbid.tune, model, "biquad", operating_points=[(P, speed)], peak_sensitivity=cap
        )
        for P, speed, cap in product((5, 6, 7), (0, 6000), (2.0, 2.6))
    }
    return searches | {loop.name: loop.tune for loop in (reactor(), tuned_mass_damper())}


def measure(n_seeds: int) -> dict[str, Any]:
    """Return value, status and processor time [s] of each problem from each seed."""
    rows: dict[str, list[dict[str, Any]]] = {}
    for name, search in problems().items():
        results = [timed(partial(search, seed=seed)) for seed in range(n_seeds)]
        rows[name] = [{"value": r.value, "status": str(r.status), "cpu_s": spent} for r, spent in results]
    return {**about(), "problems": rows}


def seeds_table(run: dict[str, Any]) -> str:
    """Return best and worst value, and how many seeds are near the best or were certified, as Markdown."""
    lines = []
    for name, rows in run["problems"].items():
        values = [row["value"] for row in rows]
        near = sum(value >= (1 - NEAR) * max(values) for value in values)
        certified = sum("optim" in row["status"] for row in rows)
        cpu = sum(row["cpu_s"] for row in rows) / len(rows)
        lines.append(
            (name, f"{max(values):.4f}", f"{min(values):.4f}", f"{near} of {len(rows)}", certified, f"{cpu:.1f}")
        )
    head = ("problem", "best", "worst", f"within {100 * NEAR:.0f} %", "local optimum", "CPU s each")
    return markdown(head, lines, under(run))


if __name__ == "__main__":
    raise SystemExit(main())
