"""Time the tuner against brute force in one run.

``python -m benchmarks.tune_speed [--quick] [--biquad]``
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from time import process_time

import gbid
from benchmarks.tune_brute import Loops, brute_force


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; processor time, so that it holds beside other programs."""
    parser = argparse.ArgumentParser(prog="benchmarks.tune_speed", description="Time the tuning of two P gains.")
    parser.add_argument("--quick", action="store_true", help="one operating point only")
    parser.add_argument("--biquad", action="store_true", help="tune one second-order filter per axis as well")
    options = parser.parse_args(arguments)
    model = gbid.load_model("theisen2016")
    gbid.tune(model, operating_points=[(6, 0)])  # imports and first calls are not counted
    print("| points | cap | tune [s] | brute force [s] | ratio | tune reaches | brute force reaches |")
    print("|---|---|---|---|---|---|---|")
    one = [(6.0, 0.0)]
    for points in [one] if options.quick else [one, list(model.operating_points)]:
        for cap in (None, 2.6):
            began = process_time()
            ours = gbid.tune(model, operating_points=points, peak_sensitivity=cap)
            middle = process_time()
            # brute force is given a floor from the answer: without it, its grid alone takes far longer
            theirs = brute_force(Loops(model, points), cap, ours.value - 0.03, polish=3 if options.quick else 20)
            end = process_time()
            times = f"{middle - began:.2f} | {end - middle:.1f} | {(end - middle) / (middle - began):.0f}"
            print(f"| {len(points)} | {cap} | {times} | {ours.value:.6f} | {theirs.value:.6f} |")
    if options.biquad:
        for points in (one, list(model.operating_points)):
            began = process_time()
            ours = gbid.tune(model, operating_points=points, controller="biquad", peak_sensitivity=2.0)
            print(f"biquad, {len(points)} points, cap 2.0: {process_time() - began:.0f} s, damping {ours.value:.4f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
