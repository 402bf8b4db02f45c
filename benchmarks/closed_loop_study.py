"""Compare ways to identify a rotor from recordings in closed loop; store the figures.

``python -m benchmarks.closed_loop_study [--seeds N] [--output FILE]``
"""

from __future__ import annotations

import argparse
import datetime
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import gbid
from benchmarks.closed_loop_cases import CASES, CONTROLLER, LoopCase
from benchmarks.dual_youla import dual_youla
from gbid.core.arrays import one_blas_thread
from gbid.structure import KEY_PARAMETERS

STORED = Path(__file__).parents[1] / "docs" / "closed-loop.json"
Found = tuple[Mapping[str, float], Mapping[str, float] | None, bool]
"""Estimates, standard deviations where the way has them, and whether it converged."""


def bearing(gain: str) -> gbid.RotorBearing:
    """Return the structure from u to p with exact delays and a disturbance gain."""
    return gbid.RotorBearing(delay="exact", disturbance_gain=gain)  # type: ignore[arg-type]  # a word


def before_values() -> dict[str, float]:
    """Return what is known before the recording: the published model at another pressure."""
    return dict(gbid.load_model("theisen2016").key_parameters(6.0, 6000.0))


def _fitted(structure: Any, recording: gbid.Recording, start: Mapping[str, float], focus: Any) -> Found:
    result = gbid.fit(structure, recording, start=start, focus=focus)
    return result.parameters, result.std, result.success


def _looped(gain: str, recording: gbid.Recording, focus: str) -> Found:
    start = {**before_values(), **gbid.load_model("theisen2016").actuators}
    return _fitted(gbid.ClosedLoop(gbid.Plant(bearing(gain)), CONTROLLER), recording, start, focus)


def _naive(recording: gbid.Recording) -> Found:
    return _fitted(bearing("none"), recording, before_values(), "simulation")


def _direct(recording: gbid.Recording) -> Found:
    return _looped("states", recording, "prediction")


def _indirect(recording: gbid.Recording) -> Found:
    return _looped("none", recording, "simulation")


def _hansen(recording: gbid.Recording) -> Found:
    fixed = dict(gbid.fit(gbid.PiezoPair(), recording).parameters)  # from r to u, whose noise is not fed back
    loop = gbid.ClosedLoop(gbid.Plant(bearing("none"), outputs=("p",)), CONTROLLER)
    return dual_youla(loop, recording, before_values(), fixed), None, True


WAYS: dict[str, Callable[[gbid.Recording], Found]] = {
    "indirect": _indirect,
    "direct": _direct,
    "dual-Youla": _hansen,
    "naive": _naive,
}
"""By the name in the table."""


def measure(case: LoopCase, way: str, recordings: Sequence[gbid.Recording]) -> dict[str, Any]:
    """Return bias and scatter of the key parameters in percent, coverage and time of one way."""
    rows, errors, failed, began = [], [], 0, time.process_time()
    for recording in recordings:
        try:
            values, std, converged = WAYS[way](recording)
        except gbid.core.errors.GbidError:
            converged = False
        if not converged:
            failed += 1
            continue
        true = case.linearised(recording)
        off = np.array([values[name] - true[name] for name in KEY_PARAMETERS])
        rows.append(off)
        if std is not None:
            errors.append(off / np.array([std[name] for name in KEY_PARAMETERS]))  # NaN without a std: outside
    seconds = (time.process_time() - began) / len(recordings)
    found: dict[str, Any] = {"recordings": len(recordings), "failed": failed, "seconds": seconds}
    if not rows:
        return found
    size = np.array([_size(case, name) for name in KEY_PARAMETERS])
    off = np.array(rows) / size
    found["bias"] = float(100 * np.sqrt((off.mean(axis=0) ** 2).mean()))
    found["scatter"] = float(100 * np.sqrt(off.var(axis=0).mean()))
    found["biases"] = {name: float(100 * v) for name, v in zip(KEY_PARAMETERS, off.mean(axis=0), strict=True)}
    if errors:
        t = np.abs(np.array(errors))
        found |= {"within_2": float((t < 1.96).mean()), "within_3": float((t < 3).mean())}
    return found


def _size(case: LoopCase, name: str) -> float:
    """Return the size that a parameter is compared with: the largest of its kind."""
    return max(abs(v) for key, v in case.truth.items() if key in KEY_PARAMETERS and key[:2] == name[:2])


def price(case: LoopCase, seeds: Sequence[int]) -> dict[str, Any]:
    """Return standard deviations in the loop beside those of open-loop recordings of equal length and equal peaks.

    The amplitude in open loop is the one whose largest movement of the disc is that of the loop.
    """
    start = {**before_values(), **gbid.load_model("theisen2016").actuators}
    small, ratios, amplitudes = replace(case, amplitude=1e-6), [], []
    for seed in seeds:
        held = case.recording(seed)
        scale = _peak(held) / _peak(small.recording(seed, closed=False))
        free = replace(case, amplitude=scale * small.amplitude)
        amplitudes.append(free.amplitude)
        apart = gbid.fit(gbid.Plant(bearing("states")), free.recording(seed, closed=False), start=start)
        _, std, _ = _direct(held)
        ratios.append([(std or {})[key] / apart.std[key] for key in KEY_PARAMETERS])
    by_name = np.nanmedian(np.array(ratios), axis=0)
    return {
        "recordings": len(seeds),
        "amplitude": float(np.median(amplitudes)),
        "std_ratio": {key: float(v) for key, v in zip(KEY_PARAMETERS, by_name, strict=True)},
    }


def _peak(recording: gbid.Recording) -> float:
    return float(np.abs(recording.signal("p")).max())


def price_text(run: Mapping[str, Any], amplitude: float) -> str:
    """Return what the loop costs in precision, as a sentence and a table."""
    found = run["price"]
    ratios = found["std_ratio"]
    return "\n".join(
        [
            f"References of {1e6 * amplitude:.1f} um in the loop move the disc as far as "
            f"{1e6 * found['amplitude']:.1f} um without it. Standard deviation in the loop (direct method) over that "
            "in open loop, median of "
            f"{found['recordings']} pairs of recordings:",
            "",
            f"| {' | '.join(ratios)} |",
            f"|{'---|' * len(ratios)}",
            f"| {' | '.join(f'{v:.2f}' for v in ratios.values())} |",
        ]
    )


def study(seeds: int, cases: Sequence[LoopCase] = CASES) -> dict[str, Any]:
    """Run all ways on the recordings of all cases."""
    run: dict[str, Any] = {"date": datetime.date.today().isoformat(), "gbid": gbid.__version__, "seeds": seeds}
    run["cases"] = {}
    for case in cases:
        recordings = [case.recording(seed) for seed in range(seeds)]
        run["cases"][case.name] = {}
        for way in WAYS:
            run["cases"][case.name][way] = measure(case, way, recordings)
            print(case.name, way, json.dumps(run["cases"][case.name][way]), flush=True)
    run["price"] = price(CASES[0], range(seeds))
    print("price", json.dumps(run["price"]), flush=True)
    return run


def study_table(run: Mapping[str, Any]) -> str:
    """Return the figures of all cases as Markdown."""
    lines = [
        "| recordings | way | bias % | scatter % | within 1.96 std | within 3 std | s a fit | failed |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for case, ways in run["cases"].items():
        for way, f in ways.items():
            size = [f"{f[key]:.2f}" if key in f else "" for key in ("bias", "scatter")]
            shares = [f"{100 * f[key]:.1f} %" if key in f else "" for key in ("within_2", "within_3")]
            cells = [f"{case} ({f['recordings']})", way, *size, *shares, f"{f['seconds']:.1f}", str(f["failed"])]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, "", f"Recordings of each case in brackets; {run['date']}, gbid {run['gbid']}."])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="benchmarks.closed_loop_study", description=__doc__)
    parser.add_argument("--seeds", type=int, default=20, help="recordings of each case (default 20)")
    parser.add_argument("--case", action="append", help="only this case; can be repeated")
    parser.add_argument("--output", type=Path, help="write the figures to this JSON file (other cases stay)")
    options = parser.parse_args(arguments)
    cases = [case for case in CASES if not options.case or case.name in options.case]
    with one_blas_thread():
        run = study(options.seeds, cases)
    print(study_table(run))
    if options.output:
        if options.output.is_file():  # other cases of an earlier run stay
            run["cases"] = {**json.loads(options.output.read_text(encoding="utf-8"))["cases"], **run["cases"]}
        options.output.write_text(json.dumps(run, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
