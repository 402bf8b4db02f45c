"""Count how often 95 % intervals contain the truth with robust standard deviations, and with those of the bootstrap.

``python -m benchmarks.coverage_bootstrap [--seeds N] [--output FILE]``
"""

from __future__ import annotations

import argparse
import datetime
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import gbid
from benchmarks.coverage_cases import CASES, OSCILLATORS, Case, Oscillator
from gbid.core.arrays import one_blas_thread

CELLS = (
    ("AR(2) at the resonance", 1000),
    ("AR(2) at the resonance", 5000),
    ("AR(1), pole 0.9", 1000),
    ("process noise", 1000),
)
_QUANTILE = 1.96  # of the normal distribution, for 95 %


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="benchmarks.coverage_bootstrap", description="Coverage of the bootstrap.")
    parser.add_argument("--seeds", type=int, default=40, help="recordings of each kind (default 40)")
    parser.add_argument("--output", type=Path, help="write the numbers to this JSON file (replaced if there)")
    options = parser.parse_args(arguments)
    with one_blas_thread():
        run = measure(CELLS, options.seeds)
    if options.output:
        options.output.write_text(json.dumps(run, indent=2) + "\n", encoding="utf-8")
    print(bootstrap_table(run))
    return 0


def measure(cells: Sequence[tuple[str, int]], seeds: int) -> dict[str, Any]:
    """Coloured errors on the oscillator with little damping, fitted without a disturbance gain."""
    plain = {case.name: case for case in CASES if case.words == "plain"}
    rows = [{"errors": name, "samples": n, **cell(OSCILLATORS[0], plain[name], n, seeds)} for name, n in cells]
    return {
        "date": datetime.date.today().isoformat(),
        "gbid": gbid.__version__,
        "oscillator": OSCILLATORS[0].name,
        "seeds": seeds,
        "rows": rows,
    }


def cell(oscillator: Oscillator, case: Case, n: int, seeds: int) -> dict[str, float]:
    """Return the coverage of both, how much wider those of the bootstrap are (median), and the fits that failed."""
    truth = oscillator.truth
    off, robust, bootstrap = [], [], []
    for seed in range(seeds):
        result = gbid.fit(
            case.structure(oscillator),
            case.recording(oscillator, n, seed),
            start=truth,
            std="bootstrap",
            **case.options,
        )
        if result.success:
            off.append([abs(result.parameters[name] - true) for name, true in truth.items()])
            robust.append([result.std_with("robust")[name] for name in truth])
            bootstrap.append([result.std[name] for name in truth])
    missed, narrow, wide = map(np.array, (off, robust, bootstrap))
    return {
        "robust": float((missed < _QUANTILE * narrow).mean()),
        "bootstrap": float((missed < _QUANTILE * wide).mean()),
        "wider": float(np.median(wide / narrow)),
        "failed": seeds - len(off),
    }


def bootstrap_table(run: dict[str, Any]) -> str:
    """Return the coverage as Markdown, in percent."""
    lines = ["| errors | N | robust | bootstrap | wider by |", "|---|---|---|---|---|"]
    for row in run["rows"]:
        shown = f"{100 * row['robust']:.1f} | {100 * row['bootstrap']:.1f} | {row['wider']:.2f}"
        lines.append(f"| {row['errors']} | {row['samples']} | {shown} |")
    failed = sum(row["failed"] for row in run["rows"])
    lines += ["", f"{run['seeds']} recordings in each row ({failed} fits failed), {run['date']}, gbid {run['gbid']}."]
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
