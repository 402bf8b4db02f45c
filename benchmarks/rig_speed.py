"""Time the recordings of a campaign on the virtual rig; print a table, store the numbers.

``python -m benchmarks.rig_speed [--quick] [--output FILE]``
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gbid
from benchmarks.running import about, finish
from gbid.core.arrays import one_blas_thread
from gbid.rig import (
    FilmStiffening,
    FlexibleMode,
    Machine,
    NonSynchronous,
    PiezoStacks,
    Prbs,
    ProcessNoise,
    Scatter,
    record,
)

_N_RECORDINGS, _DURATION_S, _SETTLE_S = 86, 5.0, 0.5
_POINTS = [(pressure, speed) for pressure in (3.0, 4.0, 5.0, 6.0, 7.0) for speed in (0.0, 4000.0, 6000.0)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(prog="benchmarks.rig_speed", description="Time recordings of the virtual rig.")
    parser.add_argument("--quick", action="store_true", help="two short recordings only, to see that it works")
    parser.add_argument("--output", type=Path, help="write the numbers to this JSON file (replaced if there)")
    options = parser.parse_args(arguments)
    with one_blas_thread():
        run = measure(2, 0.05) if options.quick else measure(_N_RECORDINGS, _DURATION_S)
    return finish(run, options.output, rig_table(run))


def measure(n_recordings: int, duration_s: float) -> dict[str, Any]:
    """CPU time of recordings with nonlinear stacks and all effects, and of a linear one."""
    make(0, 0.02)  # compiles
    began, wall = time.process_time(), time.perf_counter()
    for i in range(n_recordings):
        make(i, duration_s)
    campaign, campaign_wall = time.process_time() - began, time.perf_counter() - wall
    began = time.process_time()
    make(0, duration_s, linear=True)
    return {
        **about(),
        "n_recordings": n_recordings,
        "duration_s": duration_s,
        "settle_s": _SETTLE_S,
        "campaign_cpu_s": campaign,
        "campaign_wall_s": campaign_wall,
        "linear_cpu_s": time.process_time() - began,
    }


def make(i: int, duration_s: float, linear: bool = False) -> None:
    """One recording of the campaign, with all that the rig can do, or with what is linear only."""
    pressure, speed = _POINTS[i % len(_POINTS)]
    model = gbid.load_model("theisen2016")
    effects: dict[str, Any] = {
        "flexible_mode": FlexibleMode(),
        "stiffening": FilmStiffening(),
        "non_synchronous": NonSynchronous(),
        "process_noise": ProcessNoise(),
    }
    machine = Machine.from_parameters(
        model.key_parameters(pressure, speed),
        model.actuators if linear else PiezoStacks.unequal(0.05, 1),
        **({} if linear else effects),
    )
    record(
        machine,
        Prbs(duration_s),
        conditions={"pressure_bar": pressure, "speed_rpm": speed},
        seed=1,
        name=f"recording {i}",
        scatter=None if linear else Scatter(),
        touch_down="flag",
        settle_s=_SETTLE_S,
    )


def rig_table(run: dict[str, Any]) -> str:
    """The numbers as Markdown."""
    length = f"{run['duration_s']:g} s + {run['settle_s']:g} s"
    rows = [
        (f"{run['n_recordings']} recordings of {length}, stacks and all effects, one core", run["campaign_cpu_s"]),
        ("one of them", run["campaign_cpu_s"] / run["n_recordings"]),
        (f"one of {length}, linear, closed form", run["linear_cpu_s"]),
    ]
    lines = ["| what | CPU time [s] |", "|---|---|", *(f"| {what} | {seconds:.3g} |" for what, seconds in rows)]
    return "\n".join([*lines, "", f"{run['processor']}, {run['date']}, gbid {run['gbid']}."])


if __name__ == "__main__":
    sys.exit(main())
