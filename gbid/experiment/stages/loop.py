"""Loops: checks of the controllers of recordings and fits, designs tuned before, and the cost of a loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np

from gbid.core.errors import GbidError
from gbid.core.tables import read_values, table_of_values, write_csv
from gbid.experiment.controllers import (
    chosen,
    early_design,
    early_designs,
    found_controller,
)
from gbid.experiment.experiment import Experiment
from gbid.experiment.fields import Found, InputError, Location, nearest, refusal
from gbid.experiment.rig_schema import ControllerChoice
from gbid.experiment.run import Job, Stage, Task
from gbid.experiment.stages.fit import fit_entries, fit_result
from gbid.experiment.stages.prefilter import load_fit_input
from gbid.experiment.stages.rig import check_loop_stable, loop_controller_of
from gbid.experiment.stages.tune import design_task
from gbid.identify import FitResult, TableEntry


def fit_loops_are_known(experiment: Experiment) -> Found:
    """Yield a problem for each fit in a loop whose controller or comparison is not there."""
    for name, section in experiment.spec.fits.items():
        if section.loop is None:
            continue
        where: Location = ("fits", name, "loop")
        yield from _controller_problems(experiment, section.loop, where)
        beside = section.loop.beside
        if beside is None:
            continue
        if beside not in experiment.spec.fits:
            yield (*where, "beside"), f"no fit of this name; {nearest(beside, experiment.spec.fits)}"
        elif experiment.spec.fits[beside].loop is not None:
            yield (*where, "beside"), f"fit {beside!r} is in a loop itself; name one to recordings without controller"
        elif section.together or experiment.spec.fits[beside].together:
            yield (*where, "beside"), "compares fits of single recordings; remove together: true, or this key"


def rig_loop_can_run(experiment: Experiment) -> Found:
    """Yield problems of the controller of the rig's recordings in closed loop."""
    rig = experiment.spec.rig
    if rig is None or rig.loop is None:
        return
    where: Location = ("rig", "loop")
    found = list(_controller_problems(experiment, rig.loop, where))
    yield from found
    if rig.controller == "compiled" and rig.loop.runout != "online":
        yield (*where, "runout"), "the control chain in C subtracts the run-out; write runout: online"
    if rig.loop.runout == "offline" and rig.loop.stationary == 0:
        yield (*where, "stationary"), "the answers to run-out come from recordings without excitation; write 1"
    if rig.loop.runout == "online" and rig.stationary.recordings == 0:
        yield (
            (*where, "runout"),
            "the map comes from stationary recordings without controller, and there are none; write runout: offline or "
            "none",
        )
    if found:
        return
    reported: set[str] = set()
    for planned in experiment.recordings.values():
        if not planned.in_loop:
            continue
        try:
            check_loop_stable(experiment, planned, loop_controller_of(experiment, planned).sampled)
        except InputError:
            return  # the design is tuned first, and checked when it runs
        except GbidError as error:
            if str(error) not in reported:
                yield (*where, _key_of(rig.loop)), str(error)
            reported.add(str(error))


def _controller_problems(experiment: Experiment, section: ControllerChoice, where: Location) -> Found:
    problems = list(refusal(where, partial(chosen, experiment, section)))
    yield from problems
    if not problems and chosen(experiment, section) is section:  # else that of the rig, reported there
        yield from refusal(where, partial(found_controller, experiment, section, planned=True), _key_of(section))


def _key_of(section: ControllerChoice) -> str:
    return "structure" if section.controller is None else "controller"


# ---- Stage of the designs that close the loop of recordings: they are tuned before anything is recorded.


def loop_tasks(job: Job) -> list[Task]:
    """Return the tasks of the designs that recordings need; `gbid tune` makes the same."""
    return [design_task(early_design(job.experiment, name)) for name in early_designs(job.experiment)]


LOOP = Stage("loop", "rig", (rig_loop_can_run, fit_loops_are_known), loop_tasks, early=True)
"""``controller/<design>.h5`` of the designs that close the loop of recordings."""


# ---- What a loop costs in precision: standard deviations in the loop beside those without controller.

FOLDER = "loops"


@dataclass(frozen=True)
class LoopCostRow:
    """Standard deviation of a parameter in the loop and without controller, at one operating point.

    Attributes
    ----------
    fit, beside : str
        Names of the fits: in the loop, and to recordings without controller.
    point : str
        Operating point, e.g. ``p7_n6000``.
    recordings, recordings_beside : int
        Numbers of converged fits.
    duration_s, duration_beside_s : float
        Length of a recording, the median [s].
    peak, peak_beside : float
        Largest value of the last output in a recording, the median, in `peak_unit`.
    peak_of, peak_unit : str
        Signal of the peaks, and its unit.
    parameter, unit : str
        The parameter.
    std, std_beside : float
        Its standard deviations, the medians.
    """

    fit: str
    beside: str
    point: str
    recordings: int
    recordings_beside: int
    duration_s: float
    duration_beside_s: float
    peak: float
    peak_beside: float
    peak_of: str
    peak_unit: str
    parameter: str
    unit: str
    std: float
    std_beside: float


def cost_tasks(job: Job) -> list[Task]:
    """Return the tasks of the tables, one for each fit that names another one to stand beside it."""
    experiment, tasks = job.experiment, []
    for name, section in experiment.spec.fits.items():
        beside = section.loop.beside if section.loop is not None else None
        if beside is not None and _converged(job, name) and _converged(job, beside):
            fits = [
                fit_result(experiment, fit, entry.model) for fit in (name, beside) for entry, _ in _converged(job, fit)
            ]
            path = experiment.path(FOLDER, name, ".csv")
            result = experiment.result("loop cost", name, path, {"beside": beside}, fits)
            tasks.append(Task.of(result, partial(_write, name=name, beside=beside)))
    return tasks


def made_costs(job: Job) -> list[LoopCostRow]:
    """Return the rows of all tables that were made from the present fits; nothing is computed."""
    return [row for task in cost_tasks(job) if task.is_made for row in read_values(task.path, LoopCostRow)]


def cost_rows(job: Job, name: str, beside: str) -> list[LoopCostRow]:
    """Return the rows of a fit, by operating point and parameter; empty without a common point or parameter."""
    here, there = (_by_point(job, _converged(job, each)) for each in (name, beside))
    rows = []
    for point in here:
        if point not in there:
            continue
        closed, free = here[point], there[point]
        size, free_size = _size(job, closed), _size(job, free)
        for parameter in closed[0].std:
            std, std_beside = (_median_std(group, parameter) for group in (closed, free))
            if std is None or std_beside is None:  # fixed, not a parameter of both, or without standard deviation
                continue
            rows.append(
                LoopCostRow(
                    fit=name,
                    beside=beside,
                    point=point,
                    recordings=len(closed),
                    recordings_beside=len(free),
                    duration_s=size.duration,
                    duration_beside_s=free_size.duration,
                    peak=size.peak,
                    peak_beside=free_size.peak,
                    peak_of=size.signal,
                    peak_unit=size.unit,
                    parameter=parameter,
                    unit=closed[0].units[parameter],
                    std=std,
                    std_beside=std_beside,
                )
            )
    return rows


def _converged(job: Job, name: str) -> list[tuple[TableEntry, FitResult]]:
    return [
        (entry, entry.result) for entry in fit_entries(job, name) if entry.result is not None and entry.result.success
    ]


def _by_point(job: Job, entries: Sequence[tuple[TableEntry, FitResult]]) -> dict[str, list[FitResult]]:
    found: dict[str, list[FitResult]] = {}
    for entry, result in entries:
        found.setdefault(job.experiment.recordings[entry.recordings[0]].point, []).append(result)
    return found


class _Size(NamedTuple):
    duration: float
    peak: float
    signal: str
    unit: str


def _size(job: Job, results: Sequence[FitResult]) -> _Size:
    """Return length and peak of recordings, as medians, with signal and unit of the peak."""
    recordings = [load_fit_input(job, job.experiment.recordings[result.recordings[0]]) for result in results]
    signal = results[0].options.outputs[-1].partition(".")[0]
    peaks = [float(np.abs(recording.signal(signal)).max()) for recording in recordings]
    length = median(recording.duration for recording in recordings)
    return _Size(length, median(peaks), signal, recordings[0].units[signal])


def _median_std(results: Sequence[FitResult], parameter: str) -> float | None:
    known = [float(v) for result in results if (v := result.std.get(parameter, 0.0)) > 0]
    return median(known) if known else None


def _write(job: Job, part: Path, name: str, beside: str) -> None:
    notes = ("standard deviations: medians over the recordings of an operating point; only of fits that converged",)
    rows = cost_rows(job, name, beside)
    write_csv(table_of_values(LoopCostRow, rows, notes), part)


def _in_run(experiment: Experiment) -> bool:
    fits = experiment.spec.fits.values()
    return any(section.loop is not None and section.loop.beside is not None for section in fits)


LOOP_COST = Stage("loop cost", "fits", (), cost_tasks, in_run=_in_run)
"""``loops/<fit>.csv``: standard deviations in the loop beside those without controller."""
