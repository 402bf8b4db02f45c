"""Time the tuner against brute force and general optimisers in one run; print a table, store the numbers.

``python -m benchmarks.tune_speed [--quick] [--polish N] [--output FILE]``
"""

from __future__ import annotations

import argparse
import datetime
import json
from collections.abc import Sequence
from pathlib import Path
from time import process_time
from typing import Any

import gbid
from benchmarks.fit_speed import processor
from benchmarks.tune_brute import Loops, brute_force
from benchmarks.tune_others import compare, others_table
from gbid.core.arrays import one_blas_thread

_ONE = [(6.0, 0.0)]
_CAPS = (None, 2.6)
_BIQUAD_CAPS = (2.0, 2.6)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; processor time, so that it holds beside other programs."""
    parser = argparse.ArgumentParser(prog="benchmarks.tune_speed", description="Time the tuning of controllers.")
    parser.add_argument(
        "--quick",
        action="store_true",
        help="one operating point and cap, P gains in place of biquads: to see that it works",
    )
    parser.add_argument("--polish", type=int, default=5, help="how many grid points brute force polishes (default 5)")
    parser.add_argument("--output", type=Path, help="write the numbers to this JSON file (replaced if there)")
    options = parser.parse_args(arguments)
    with one_blas_thread():
        run = measure(options.quick, 1 if options.quick else options.polish)
    if options.output:
        options.output.write_text(json.dumps(run, indent=2) + "\n", encoding="utf-8")
    print(tune_table(run))
    return 0


def measure(quick: bool, polish: int) -> dict[str, Any]:
    """Two P gains beside brute force, and a second-order filter per axis beside the P gains."""
    model = gbid.load_model("theisen2016")
    every = list(model.operating_points)
    gbid.tune(model, operating_points=_ONE)  # imports and first calls are not counted, here of grid and random starts
    gbid.tune(model, operating_points=_ONE, starts=1)
    brute, biquad = [], []
    for points in [_ONE] if quick else [_ONE, every]:
        for cap in _CAPS[: 1 if quick else None]:
            began = process_time()
            ours = gbid.tune(model, operating_points=points, peak_sensitivity=cap)
            middle = process_time()
            # brute force is given a floor from the answer: without it, its grid alone takes far longer
            theirs = brute_force(Loops(model, points), cap, ours.value - 0.03, polish)
            times = {"cpu_s": middle - began, "brute_cpu_s": process_time() - middle}
            brute.append(
                {"n_points": len(points), "cap": cap, "damping": ours.value, "brute_damping": theirs.value, **times}
            )
    for points in [_ONE] if quick else [_ONE, every]:
        for cap in _BIQUAD_CAPS[: 1 if quick else None]:
            began = process_time()
            ours = gbid.tune(
                model,
                operating_points=points,
                controller="P" if quick else "biquad",
                peak_sensitivity=cap,
            )
            spent = process_time() - began
            plain = gbid.tune(model, operating_points=points, peak_sensitivity=cap)
            biquad.append(
                {"n_points": len(points), "cap": cap, "damping": ours.value, "p_damping": plain.value, "cpu_s": spent}
            )
    return {
        "date": datetime.date.today().isoformat(),
        "processor": processor(),
        "gbid": gbid.__version__,
        "polished": polish,
        "proportional": brute,
        "biquad": biquad,
        "others": compare(quick),
    }


def tune_table(run: dict[str, Any]) -> str:
    """All numbers as Markdown."""
    where = f"{run['processor']}, {run['date']}, gbid {run['gbid']}."
    return "\n\n".join([proportional_table(run), biquad_table(run), others_table(run["others"]), where])


def proportional_table(run: dict[str, Any]) -> str:
    """Two P gains beside brute force."""
    lines = [
        "| P gains: points | cap | tune [CPU s] | brute force [CPU s] | ratio | damping | of brute force |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in run["proportional"]:
        ratio = row["brute_cpu_s"] / row["cpu_s"]
        lines.append(
            f"| {row['n_points']} | {_cap(row)} | {row['cpu_s']:.2f} | {row['brute_cpu_s']:.1f} | {ratio:.0f} | "
            f"{row['damping']:.6f} | {row['brute_damping']:.6f} |"
        )
    return "\n".join(lines)


def biquad_table(run: dict[str, Any]) -> str:
    """A second-order filter per axis beside P gains."""
    lines = ["| biquad: points | cap | tune [CPU s] | damping | of P gains | ratio |", "|---|---|---|---|---|---|"]
    for row in run["biquad"]:
        lines.append(
            f"| {row['n_points']} | {_cap(row)} | {row['cpu_s']:.1f} | {row['damping']:.4f} | "
            f"{row['p_damping']:.4f} | {row['damping'] / row['p_damping']:.2f} |"
        )
    return "\n".join(lines)


def _cap(row: dict[str, Any]) -> str:
    return "none" if row["cap"] is None else f"{row['cap']:g}"


if __name__ == "__main__":
    raise SystemExit(main())
