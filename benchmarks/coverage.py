"""Count how often 95 % intervals of a fit contain the truth, for errors of many kinds; store the numbers.

``python -m benchmarks.coverage [--quick] [--seeds N] [--output FILE]``
"""

from __future__ import annotations

import argparse
import datetime
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import gbid
from benchmarks.coverage_cases import CASES, OSCILLATORS, Case, Oscillator
from gbid.core.arrays import one_blas_thread

LENGTHS = (1000, 5000, 25_000)
TARGET = (0.92, 0.97)
_QUANTILE = 1.96  # of the normal distribution, for 95 %


class Coverage(NamedTuple):
    """Figures of one kind of errors at one length.

    Attributes
    ----------
    coverage : float
        Share of the intervals, of all parameters and seeds, that contain the truth.
    coverage_white : float
        The same with the standard deviations for white errors.
    stated : float
        Root mean square of the standard deviations over that of the errors, mean over the parameters.
    failed : int
        Number of fits that did not converge; they do not count.
    """

    coverage: float
    coverage_white: float
    stated: float
    failed: int


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="benchmarks.coverage", description="Coverage of the intervals of a fit.")
    parser.add_argument("--quick", action="store_true", help="shortest recordings and few seeds, to see that it works")
    parser.add_argument("--seeds", type=int, default=60, help="recordings of each kind (default 60)")
    parser.add_argument("--output", type=Path, help="write the numbers to this JSON file (replaced if there)")
    options = parser.parse_args(arguments)
    with one_blas_thread():
        run = measure(LENGTHS[:1] if options.quick else LENGTHS, 4 if options.quick else options.seeds)
    if options.output:
        options.output.write_text(json.dumps(run, indent=2) + "\n", encoding="utf-8")
    print(coverage_table(run))
    return 0


def measure(lengths: Sequence[int], seeds: int) -> dict[str, Any]:
    """All kinds of errors on all oscillators."""
    rows = [
        {
            "oscillator": oscillator.name,
            "errors": case.name,
            "options": case.words,
            "target": case.target,
            "cells": {str(n): cell(oscillator, case, n, seeds)._asdict() for n in lengths},
        }
        for oscillator in OSCILLATORS
        for case in CASES
    ]
    return {"date": datetime.date.today().isoformat(), "gbid": gbid.__version__, "seeds": seeds, "rows": rows}


def cell(oscillator: Oscillator, case: Case, n: int, seeds: int) -> Coverage:
    """Fit recordings of one kind and length from starts near the truth."""
    truth = oscillator.truth
    values, stated, white = [], [], []
    for seed in range(seeds):
        result = gbid.fit(case.structure(oscillator), case.recording(oscillator, n, seed), start=truth, **case.options)
        if not result.success:
            continue
        values.append([result.parameters[name] - true for name, true in truth.items()])
        stated.append([result.std[name] for name in truth])
        white.append([result.std_with("white")[name] for name in truth])
    off, sigma, plain = map(np.array, (values, stated, white))
    ratio = np.sqrt((sigma**2).mean(axis=0) / (off**2).mean(axis=0))
    return Coverage(
        coverage=float((np.abs(off) < _QUANTILE * sigma).mean()),
        coverage_white=float((np.abs(off) < _QUANTILE * plain).mean()),
        stated=float(ratio.mean()),
        failed=seeds - len(values),
    )


def coverage_table(run: dict[str, Any]) -> str:
    """Return the coverage of all kinds as Markdown, in percent; in brackets with the white standard deviations."""
    lengths = list(run["rows"][0]["cells"])
    lines = [
        "| oscillator | errors | fit | " + " | ".join(f"N = {int(n):,}".replace(",", " ") for n in lengths) + " |",
        "|---|---|---|" + "---|" * len(lengths),
    ]
    for row in run["rows"]:
        cells = [_shown(Coverage(**row["cells"][n]), row["target"]) for n in lengths]
        lines.append(f"| {row['oscillator']} | {row['errors']} | {row['options']} | " + " | ".join(cells) + " |")
    lines += ["", f"{run['seeds']} recordings in each cell, {run['date']}, gbid {run['gbid']}."]
    return "\n".join(lines)


def missed(run: dict[str, Any]) -> list[str]:
    """Return the cells with a target that is not reached, in words."""
    found = []
    for row in run["rows"]:
        for n, numbers in row["cells"].items():
            if row["target"] and not TARGET[0] <= numbers["coverage"] <= TARGET[1]:
                found.append(f"{row['oscillator']}, {row['errors']}, N = {n}: {100 * numbers['coverage']:.1f} %")
    return found


def _shown(found: Coverage, target: bool) -> str:
    inside = TARGET[0] <= found.coverage <= TARGET[1]
    text = f"{100 * found.coverage:.1f}"
    text = f"**{text}**" if target and not inside else text
    left_out = f", {found.failed} failed" if found.failed else ""
    return f"{text} ({100 * found.coverage_white:.0f}){left_out}"


if __name__ == "__main__":
    raise SystemExit(main())
