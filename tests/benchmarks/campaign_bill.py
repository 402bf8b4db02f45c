"""Time the campaign of the paper stage by stage: recordings on the rig, prefilter, 86 bearing fits, their table.

``python -m tests.benchmarks.campaign_bill [--folder FOLDER] [--workers N] [--recordings N] [--output FILE]``

Results stay in the folder. What is there already is kept and not timed, but for the fits and their table, which are
always made again. A first fit compiles the kernel or loads it, and is not timed. Processor time is that of all
processes, with the start of the workers. Wall time is what one waits for a stage. It is processor time over workers
only where the machine has nothing else to do: with the cores in use the table shows whether it had.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from ruamel.yaml import YAML

from gbid.experiment.campaign import collect, working
from gbid.experiment.experiment import Experiment
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job, Stage, perform, run_stage
from gbid.experiment.stages.fit import FIT, fit_tasks
from gbid.experiment.stages.prefilter import PREFILTER
from gbid.experiment.stages.rig import RIG
from tests.benchmarks.running import about, markdown, options_of, store, under

ROOT = Path(__file__).parents[2]
T = TypeVar("T")

ROWS = {
    "rig": "recordings on the rig",
    "prefilter": "prefilter",
    "fits": "fits from stored recordings",
    "table": "their table",
}


def experiment(folder: Path, recordings: int | None) -> Experiment:
    """Write the campaign of the paper without its staircases, with the bearing's fits only."""
    sections = YAML(typ="safe").load(ROOT / "experiments" / "theisen2016.yaml")
    kept = {key: sections[key] for key in ("format", "name", "rig", "prefilter")}
    kept["rig"] = {key: value for key, value in kept["rig"].items() if "staircase" not in key}
    kept["fits"] = {"bearing": sections["fits"]["bearing"]}
    if recordings:
        kept["rig"]["operating_points"] = kept["rig"]["operating_points"][:1]
        kept["rig"]["prbs"]["recordings"] = recordings
    path = folder / "campaign.yaml"
    path.write_text(json.dumps(kept), encoding="utf-8")  # which is YAML
    return load_experiment(path)


def measure(folder: Path, recordings: int | None, workers: int) -> dict[str, Any]:
    """Run the stages one after the other, each with workers of its own."""
    made = experiment(folder, recordings)
    times: dict[str, dict[str, float]] = {}
    for name, stage in (("rig", RIG), ("prefilter", PREFILTER)):
        before = {task.path for task in stage.work(Job(made)) if hasattr(task, "path") and task.path.exists()}
        _, times[name] = timed(lambda stage=stage: run(made, stage, workers))  # type: ignore[misc]  # bound now
        if before:  # of an earlier run
            times.pop(name)
    shutil.rmtree(made.results / "fits", ignore_errors=True)
    for table in made.results.glob("table.*"):
        table.unlink()
    job = Job(made)
    first = fit_tasks(job)[0]
    perform(job, first)
    first.path.unlink()
    _, times["fits"] = timed(lambda: run(made, FIT, workers))
    (table, _), times["table"] = timed(lambda: collect(job))
    return {
        **about(),
        "workers": workers,
        "fits": len(table),
        "converged": int(sum(table.success)),
        "stages": times,
    }


def run(made: Experiment, stage: Stage, workers: int) -> Any:
    """Run a stage with workers of its own."""
    chosen: dict[str, Any] = {"engine": "pool", "workers": workers} if workers > 1 else {"engine": "serial"}
    with working(made, **chosen) as job:
        return run_stage(job, stage)


def timed(call: Callable[[], T]) -> tuple[T, dict[str, float]]:
    """Return what a call returns, with its wall time and the processor time of all processes [s]."""
    wall, cpu = time.perf_counter(), _spent()
    computed = call()
    return computed, {"wall_s": time.perf_counter() - wall, "cpu_s": _spent() - cpu}


def _spent() -> float:
    usage = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(each.ru_utime + each.ru_stime for each in usage)


def bill_table(run: dict[str, Any]) -> str:
    """The numbers as Markdown, and how busy the workers were: far less than all cores means other work beside them."""
    times = ((text, run["stages"][key]) for key, text in ROWS.items() if key in run["stages"])
    numbers = ((text, stage["cpu_s"], stage["wall_s"]) for text, stage in times)
    rows = [(text, f"{cpu:.1f}", f"{wall:.1f}", f"{cpu / wall:.1f}") for text, cpu, wall in numbers]
    head = ("stage", "processor time [s]", "wall time [s]", "cores in use")
    return markdown(head, rows, under(run, f"{run['fits']} fits", f"{run['workers']} workers"))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = options_of(
        __doc__,
        arguments,
        folder=(Path, "where results are and stay; a temporary folder by default"),
        workers=(len(os.sched_getaffinity(0)), "processes"),
        recordings=(int, "so many at the first point only, to see that it works"),
    )
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        computed = measure(folder, options.recordings, options.workers)
    store(computed, options.output)
    print(bill_table(computed))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
