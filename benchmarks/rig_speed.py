"""Time the recordings of a campaign on the virtual rig; print a table, store the numbers.

``python -m benchmarks.rig_speed [--quick] [--output FILE]``
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

import gbid
from benchmarks.running import about, markdown, options_of, run_study, timed, under
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

_SETTLE_S = 0.5


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = options_of(__doc__, arguments, quick=(False, "two short recordings only, to see that it works"))
    return run_study(lambda: measure(*((2, 0.05) if options.quick else (86, 5.0))), options.output, rig_table)


def measure(n_recordings: int, duration_s: float) -> dict[str, Any]:
    """CPU time of recordings with nonlinear stacks and all effects, and of a linear one."""
    make(0, 0.02)  # compiles
    wall = time.perf_counter()
    _, campaign = timed(lambda: [make(i, duration_s) for i in range(n_recordings)])
    return {
        **about(),
        "n_recordings": n_recordings,
        "duration_s": duration_s,
        "settle_s": _SETTLE_S,
        "campaign_cpu_s": campaign,
        "campaign_wall_s": time.perf_counter() - wall,
        "linear_cpu_s": timed(lambda: make(0, duration_s, linear=True))[1],
    }


def make(i: int, duration_s: float, linear: bool = False) -> None:
    """One recording of the campaign, with all that the rig can do, or with what is linear only."""
    model = gbid.load_model("theisen2016")
    pressure, speed = model.operating_points[i % len(model.operating_points)]
    effects: dict[str, Any] = {
        "flexible_mode": FlexibleMode(),
        "stiffening": FilmStiffening(),
        "non_synchronous": NonSynchronous(),
        "process_noise": ProcessNoise(),
    }
    actuators = model.actuators if linear else PiezoStacks.unequal(0.05, 1)
    machine = Machine.from_parameters(model.key_parameters(pressure, speed), actuators, **({} if linear else effects))
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
    rows = {
        f"{run['n_recordings']} recordings of {length}, stacks and all effects, one core": run["campaign_cpu_s"],
        "one of them": run["campaign_cpu_s"] / run["n_recordings"],
        f"one of {length}, linear, closed form": run["linear_cpu_s"],
    }
    return markdown(("what", "CPU time [s]"), [(what, f"{s:.3g}") for what, s in rows.items()], under(run))


if __name__ == "__main__":
    sys.exit(main())
