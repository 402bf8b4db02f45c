"""Identify a magnetic levitation from closed-loop recordings, with known and with unknown controller.

``python -m benchmarks.levitation [--recordings N] [--output FILE]``
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import gbid
from benchmarks.running import options_of, run_study
from gbid.cli.templates import write_held_bearing
from gbid.core.files import share_folder
from gbid.structure import load_structure

TRUE = {"k_s": 4e4, "k_i": 60.0}
_SAMPLE_TIME, _INSIDE = 1e-4, 1.96
_WAYS = {"unknown": ("structure", "prediction"), "known": ("loop", "simulation")}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    count = options_of(__doc__, arguments, recordings=(60, "number of recordings"))
    run = {"gbid": gbid.__version__, "recordings": count.recordings}
    return run_study(
        lambda: run | {"rows": study(count.recordings)}, count.output, lambda computed: json.dumps(computed, indent=2)
    )


def study(count: int) -> list[dict[str, Any]]:
    """Return bias, scatter and coverage of both ways to identify the bearing."""
    recordings = [held(seed) for seed in range(count)]
    rows = []
    for controller, (name, focus) in _WAYS.items():
        structure = load_structure(f"magnetic_bearing.py:{name}", share_folder("models"))
        fits = [gbid.fit(structure, recording, focus=focus) for recording in recordings]
        good = [fit for fit in fits if fit.success]
        for parameter, true in TRUE.items():
            value, std = (np.array([getattr(fit, what)[parameter] for fit in good]) for what in ("parameters", "std"))
            rows.append(
                {
                    "controller": controller,
                    "parameter": parameter,
                    "truth": true,
                    "bias": 100 * float(value.mean() / true - 1),
                    "scatter": 100 * float(value.std(ddof=1) / true),
                    "std": 100 * float(std.mean() / true),
                    "inside": int(np.sum(np.abs(value - true) < _INSIDE * std)),
                    "fits": len(good),
                }
            )
    return rows


def held(seed: int) -> gbid.Recording:
    """Return a recording of the bearing under the controller of the shop."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.csv"
        write_held_bearing(path, seed)
        _, added, current, position = np.loadtxt(path, delimiter=",", skiprows=1).T
    signals = {"added": added[:, None], "current": current[:, None], "position": 1e-6 * position[:, None]}
    units = {"added": "A", "current": "A", "position": "m"}
    return gbid.Recording(signals, _SAMPLE_TIME, name=f"run{seed}", units=units)


if __name__ == "__main__":
    sys.exit(main())
