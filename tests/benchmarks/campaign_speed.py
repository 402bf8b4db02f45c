"""Time a campaign of many small fits through each engine; print throughput, overhead per fit and memory.

``python -m tests.benchmarks.campaign_speed [--full] [--engines serial pool dask] [--workers N] [--output FILE]``

Overhead is processor time of the runner and its workers per fit, from the second tenth of the fits on, less that of the
fit alone: reading and checking the recording, keys, writing the result, the way to the worker and back. The fit alone
is timed before and after, in as many processes at a time as there are workers: side by side they slow each other down,
and that is no overhead.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from gbid.experiment.campaign import collect, run_campaign, working
from gbid.experiment.experiment import Experiment
from gbid.experiment.fields import writing_keyed
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job, Outcome, Reporter, perform
from gbid.experiment.stages.fit import fit_arguments
from gbid.experiment.stages.rig import rig_tasks
from gbid.experiment.structures import make_structure
from gbid.identify import fit
from gbid.recording import load_recording, save_recording
from tests.benchmarks.running import about, markdown, options_of, stored, under
from tests.benchmarks.running import store as store_run

SHORT, FULL = 300, 5000
"""Fits of a run that is soon done, and of one that shows whether memory stays flat."""
_TICK = os.sysconf("SC_CLK_TCK")
_NOISE = 30e-9  # m, new for each recording

ROWS = {
    "fits_per_core_s": "fits per second of a processor",
    "cpu_per_fit_ms": "processor time of a fit in the campaign [ms]",
    "fit_alone_ms": "of the fit alone [ms]",
    "overhead_ms": "overhead [ms]",
    "of_it_runner_ms": "of it in the runner [ms]",
    "collect_ms": "table, for each fit [ms]",
    "runner_mb": "memory of the runner [MB]",
    "runner_growth_mb": "its growth over nine tenths of the fits [MB]",
    "worker_mb": "memory of the largest worker [MB]",
    "worker_growth_mb": "its growth [MB]",
}

YAML = """\
format: 1
name: many
rig:
  operating_points: [{{pressure_bar: 6.0, speed_rpm: 0}}]
  duration_s: {duration}
  prbs: {{recordings: {fits}, amplitude_m: 2.0e-6, hold_s: 10.0e-3}}
  stationary: {{recordings: 0}}
fits:
  piezos: {{structure: piezo_pair}}
"""


def make_campaign(folder: Path, fits: int, samples: int) -> Experiment:
    """Store recordings of one and the same experiment with sensor noise of their own."""
    path = folder / "experiment.yaml"
    path.write_text(YAML.format(duration=samples * 2e-4, fits=fits), encoding="utf-8")
    experiment = load_experiment(path)
    tasks = rig_tasks(Job(experiment))
    perform(Job(experiment), tasks[0])
    first, random = load_recording(tasks[0].path), np.random.default_rng(1)
    for task in tasks[1:]:
        noisy = first.signal("p") + _NOISE * random.standard_normal(first.signal("p").shape)
        with writing_keyed(task.path, task.key) as part:
            save_recording(
                replace(first, name=task.item.section, signals={**first.signals, "p": noisy}), part, overwrite=True
            )
    return experiment


def time_of_fits(experiment: Experiment, processes: int) -> float:
    """Processor time of a fit alone [s], the mean of processes side by side."""
    if processes == 1:
        return time_of_a_fit(experiment.file.path)
    with get_context("spawn").Pool(processes) as pool:
        return float(np.mean(pool.map(time_of_a_fit, [experiment.file.path] * processes, chunksize=1)))


def time_of_a_fit(path: Path, repeats: int = 50) -> float:
    """Processor time of a fit alone [s], compiled and warm."""
    experiment = load_experiment(path)
    names = list(experiment.recordings)[:repeats]
    data = [load_recording(experiment.results / "recordings" / f"{name}.h5") for name in names]
    structure = make_structure(experiment, "piezos")
    fit(structure, data[0], **fit_arguments(experiment, "piezos", data[:1]))
    began = time.process_time()
    for recording in data:
        fit(structure, recording, **fit_arguments(experiment, "piezos", [recording]))
    return (time.process_time() - began) / len(data)


@dataclass
class Meter(Reporter):
    """A reporter that looks at processor time and memory of the runner and its workers as the fits come in."""

    total: int
    processes: Any = None
    done: int = 0
    looks: list[dict[str, float]] = field(default_factory=list)

    def end(self, outcome: Outcome) -> None:
        if outcome.item.stage == "fit":
            self.done += 1
            if self.done in (max(1, self.total // 10), self.total):
                self.look()

    def look(self) -> None:
        ids = [os.getpid(), *(self.processes() if self.processes else ())]
        self.looks.append(
            {
                "done": self.done,
                "wall_s": time.perf_counter(),
                "cpu_s": sum(_cpu(pid) for pid in ids),
                "runner_cpu_s": _cpu(ids[0]),
                "runner_mb": _resident(ids[0]),
                "worker_mb": max((_resident(pid) for pid in ids[1:]), default=0.0),
            }
        )


def run_engine(experiment: Experiment, engine: str, workers: int) -> dict[str, float | str]:
    """Run the fits through one engine and sum up."""
    n_workers = 1 if engine == "serial" else workers
    alone = [time_of_fits(experiment, n_workers)]
    for old in (experiment.results / "fits").rglob("*.h5"):
        old.unlink()
    meter = Meter(len(experiment.recordings))
    with working(experiment, engine=engine, workers=None if engine == "serial" else workers, reporter=meter) as job:
        meter.processes = _processes(job.engine)
        outcomes = run_campaign(job)
        before = time.process_time()
        table, _ = collect(job)
        collecting = time.process_time() - before
    assert table.success.all(), [o.text for o in outcomes if o.state == "failed"][:3]
    first, last = meter.looks
    count = last["done"] - first["done"]
    cpu = (last["cpu_s"] - first["cpu_s"]) / count
    runner = (last["runner_cpu_s"] - first["runner_cpu_s"]) / count
    fit_s = float(np.mean([*alone, time_of_fits(experiment, n_workers)]))
    return {
        "engine": engine,
        "fits": len(table),
        "fits_per_core_s": 1.0 / cpu,
        "wall_per_fit_ms": 1e3 * n_workers * (last["wall_s"] - first["wall_s"]) / count,
        "cpu_per_fit_ms": 1e3 * cpu,
        "fit_alone_ms": 1e3 * fit_s,
        "overhead_ms": 1e3 * (cpu - fit_s),
        "of_it_runner_ms": 1e3 * (runner - fit_s if engine == "serial" else runner),
        "collect_ms": 1e3 * collecting / len(table),
        "runner_mb": last["runner_mb"],
        "runner_growth_mb": last["runner_mb"] - first["runner_mb"],
        "worker_mb": last["worker_mb"],
        "worker_growth_mb": last["worker_mb"] - first["worker_mb"],
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = options_of(
        __doc__,
        arguments,
        full=(False, f"{FULL} fits"),
        fits=(int, f"number of fits; {SHORT} when not given"),
        samples=(1000, "samples of a recording"),
        engines=(("serial", "pool", "dask"), "engines"),
        workers=(2, "processes"),
        json=(False, "print the numbers as JSON"),
    )
    fits = options.fits or (FULL if options.full else SHORT)
    with tempfile.TemporaryDirectory() as folder:
        experiment = make_campaign(Path(folder), fits, options.samples)
        run = {
            **about(),
            "fits": fits,
            "samples": options.samples,
            "workers": options.workers,
            "engines": [run_engine(experiment, engine, options.workers) for engine in options.engines],
        }
    if options.output:
        store(run, options.output)
    print(json.dumps(run, indent=2) if options.json else campaign_table(run))
    return 0


def store(run: dict[str, Any], path: Path) -> None:
    """Write a run to a file; it takes the place of an earlier one of as many fits."""
    others = [old for old in stored(path, []) if old["fits"] != run["fits"]]
    store_run(sorted([*others, run], key=lambda each: int(each["fits"])), path)


def campaign_table(run: dict[str, Any]) -> str:
    """The numbers as Markdown."""
    head = (f"{run['fits']} fits of {run['samples']} samples", *(row["engine"] for row in run["engines"]))
    rows = [(text, *(f"{row[key]:.1f}" for row in run["engines"])) for key, text in ROWS.items()]
    return markdown(head, rows, under(run, f"{run['workers']} workers"))


def _processes(engine: Any) -> Any:
    if hasattr(engine, "client"):
        ids = list(engine.client.run(os.getpid).values())
        return lambda: ids
    return (lambda: engine.process_ids) if hasattr(engine, "process_ids") else None


def _cpu(pid: int) -> float:
    """Processor time of a process so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICK


def _resident(pid: int) -> float:
    """Resident memory of a process [MB]."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


if __name__ == "__main__":
    raise SystemExit(main())
