"""Damping that each controller structure buys at caps on the peak of S_o, over the published model's points.

``python -m tests.benchmarks.structures [structure ...]`` designs them one after the other and adds them to
docs/structures.json, of which the page on tuning makes a table and a picture.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import partial
from typing import Any

import gbid
from gbid.control import MaxDamping, pareto
from gbid.control.controllers.structures import controller_structure, with_schedule
from tests.benchmarks.running import DOCS, markdown, store, timed
from tests.benchmarks.running import stored as stored_run

STORED = DOCS / "structures.json"
CAPS = (1.5, 2.0, 2.6)
STARTS = 3
"""Random starts of the design under each cap; the design under the cap before is a further start."""
KINDS = ("P", "PI", "lead-lag", "PPF", "PD", "full P", "notch", "PID", "observer", "full PD", "biquad", "filter")


def designs_of(kind: str, model: gbid.LPVModel, caps: tuple[float, ...] = CAPS, starts: int = STARTS) -> dict[str, Any]:
    """Return the designs of one structure: number of gains, and damping, peak, status and time under each cap."""
    structure = with_schedule(controller_structure(kind), model.domain)
    front, spent = timed(partial(pareto, model, caps, goals=[MaxDamping()], controller=structure, starts=starts))
    results = [
        {
            "cap": cap,
            "damping": design.value,
            "peak": design.peak_sensitivity,
            "control": design.peak_control,
            "status": str(design.status),
            "gains": dict(design.gains),
        }
        for cap, design in zip(front.caps, front.designs, strict=True)
    ]
    return {"gains": len(structure.parameters), "cpu_s": spent, "designs": results}


def structures_table(run: Mapping[str, Any]) -> str:
    """Return the table of a stored run as Markdown, the structures by rising damping at the middle cap."""
    caps = run["caps"]
    rows = sorted(run["structures"].items(), key=lambda item: item[1]["designs"][len(caps) // 2]["damping"])
    head = ("structure", "gains", *(f"damping, peak {cap:g}" for cap in caps), f"K S_o at {caps[1]:g}")
    lines = []
    for kind, entry in rows:
        cells = (
            f"{d['damping']:.3f}" + ("" if "optim" in d["status"] else f" ({d['status']})") for d in entry["designs"]
        )
        lines.append((kind, entry["gains"], *cells, f"{entry['designs'][1]['control']:.1f}"))
    return markdown(head, lines)


def main() -> None:
    model = gbid.load_model("theisen2016")
    for kind in sys.argv[1:] or KINDS:
        entry = designs_of(kind, model)
        run = stored_run(STORED, {})
        run |= {"caps": CAPS, "points": len(model.operating_points), "starts": STARTS}
        run.setdefault("structures", {})[kind] = entry
        store(run, STORED)
        print(
            kind,
            entry["gains"],
            [f"{d['damping']:.4f}" for d in entry["designs"]],
            f"{entry['cpu_s']:.0f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
