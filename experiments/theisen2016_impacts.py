"""Theisen et al. (2016): impacts that are recorded again, for the scatter of modes from their ring-downs.

`theisen2016_comparison.py` compares them with the paper. Each set of impacts is a task with a file of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal

import numpy as np
from theisen2016_figures import POINT, PaperResults

import gbid
from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError
from gbid.experiment.controllers import controller_at, loop_of
from gbid.experiment.fields import Item, needed
from gbid.experiment.machine import PlannedRun, rig_run
from gbid.experiment.run import Job, Task, run_tasks
from gbid.experiment.stages.impact import planned_impacts, recording_result
from gbid.report.named import write_shipped

LOOPS = ("open", "closed")
_REPEATS = 20
"""Times that the impacts are recorded again for a standard deviation, which they give to 16 %."""


def recorded_again(results: PaperResults, loop: str) -> FloatArray:
    """Return frequency and damping factor of both modes, (n, 2, 2), from impacts that are recorded again.

    Each time has its own noise, and its own draws of the scatter between recordings. A fit to one set of recordings
    cannot show that scatter in its standard deviation.

    Raises
    ------
    DataError
        When more than half of the ring-downs did not converge, or one cannot be made.
    """
    modes = np.array(_modes_again(results, loop)[1:])
    modes = modes[np.isfinite(modes).all(axis=(1, 2))]
    if 2 * len(modes) < _REPEATS:
        raise DataError(f"of {_REPEATS} ring-downs, {loop} loop, {len(modes)} converged; check the section impacts")
    return modes


def ringing_without_noise(results: PaperResults, loop: str) -> FloatArray:
    """Return both modes, (2, 2), of ring-downs without noise and scatter, with as many decays as in the run's fit."""
    return _modes_again(results, loop)[0]


@lru_cache(maxsize=4)
def _modes_again(results: PaperResults, loop: str) -> list[FloatArray]:
    """Return both modes, (2, 2), of each set of impacts; the first one has no noise and no scatter."""
    tasks = [_task(results, loop, i) for i in range(_REPEATS + 1)]
    for outcome in run_tasks(results.job, tasks):
        if outcome.state == "failed":
            raise DataError(outcome.text)
    return [np.loadtxt(task.path, delimiter=",") for task in tasks]


def _task(results: PaperResults, loop: str, i: int) -> Task:
    """Return the task of one set of impacts; its file has a line for each mode, nan when the fit did not converge."""
    experiment = results.job.experiment
    section = needed(experiment.spec.impacts, "impacts")
    lags = section.lags if i else len(results.impacts_at(False)[loop].ringdown.lag_rates)
    settings = {"set": i, "lags": lags, "harmonics": section.harmonics}
    impacts = [impact for impact in planned_impacts(experiment).values() if impact.loop == loop]
    sources = [recording_result(experiment, impact) for impact in impacts]
    name = f"{loop}_{i:02d}"
    result = experiment.result(Item("impacts again", name), "impacts_again", settings, sources, ending=".csv")
    write = partial(write_shipped, module=Path(__file__).stem, function=write_modes.__name__, loop=loop, i=i, lags=lags)
    return Task.of(result, write)


def write_modes(job: Job, part: Path, loop: str, i: int, lags: int | Literal["auto"]) -> None:
    """Write frequency [Hz] and damping factor of both modes from impacts at the point of the paper, recorded again."""
    experiment = job.experiment
    change: Callable[[PlannedRun], PlannedRun] = partial(_with_other_seed, i) if i else without_noise
    recordings = []
    for impact in planned_impacts(experiment).values():
        if impact.loop == loop and (impact.point.pressure_bar, impact.point.speed_rpm) == POINT:
            run = change(rig_run(experiment, impact.planned))
            law = None if loop == "open" else controller_at(experiment, impact.point, loop)
            recordings.append(run.record(None if law is None else loop_of(experiment, law, run)))
    harmonics = needed(experiment.spec.impacts, "impacts").harmonics
    ring = gbid.fit_ringdown(recordings, harmonics=harmonics, lags=lags)
    modes = np.array(ring.modes()) if ring.success or not i else np.full((2, 2), np.nan)
    np.savetxt(part, modes, fmt="%.17g", delimiter=",")


def _with_other_seed(i: int, run: PlannedRun) -> PlannedRun:
    return replace(run, options={**run.options, "seed": run.options["seed"] + i})


def without_noise(run: PlannedRun) -> PlannedRun:
    """Return the run without any noise, and without scatter between recordings."""
    sensors = replace(run.machine.sensors, noise_p_m=0.0, noise_u_m=0.0)
    machine = replace(run.machine, sensors=sensors, non_synchronous=None)
    return replace(run, machine=machine, options={**run.options, "scatter": None})
