"""Closed loops of recordings: checks of controllers, designs tuned before recording, and loss of precision."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from gbid import identify
from gbid.core.errors import UsageError, nearest
from gbid.core.tables import Cell, Column, Row, Table, formatted, read_values, table_of_values, write_csv
from gbid.experiment.controllers import early_design, tuned_design
from gbid.experiment.experiment import Experiment
from gbid.experiment.fields import Found, Item, Location
from gbid.experiment.run import Job, Stage, Task
from gbid.experiment.stages.fit import fit_entries, fit_result
from gbid.experiment.stages.prefilter import load_fit_input
from gbid.experiment.stages.rig import controller_problems
from gbid.experiment.stages.tune import design_task
from gbid.identify.table import TableEntry


def fit_loops_are_known(experiment: Experiment) -> Found:
    """Yield a problem for each closed-loop fit with a missing controller or missing comparison fit."""
    for name, section in experiment.spec.fits.items():
        if section.loop is None:
            continue
        where: Location = ("fits", name, "loop")
        yield from controller_problems(experiment, section.loop, where)
        beside = section.loop.beside
        if beside is None:
            continue
        if beside not in experiment.spec.fits:
            yield (*where, "beside"), f"no fit of this name; {nearest(beside, experiment.spec.fits)}"
        elif experiment.spec.fits[beside].loop is not None:
            yield (*where, "beside"), f"fit {beside!r} is in a loop itself; name one to recordings without controller"
        elif section.together or experiment.spec.fits[beside].together:
            yield (*where, "beside"), "compares fits of single recordings; remove together: true, or this key"


def early_designs(experiment: Experiment) -> list[str]:
    """Return the names of designs that control recordings and are therefore tuned first."""
    spec, names = experiment.spec, dict[str, None]()
    for section in (spec.rig.loop if spec.rig else None, *(fit.loop for fit in spec.fits.values())):
        if section is not None and section.controller is not None and section.controller.kind == "tuned":
            with suppress(UsageError):  # a check reports it
                names[tuned_design(experiment, section.controller.name)] = None
    return list(names)


def loop_tasks(job: Job) -> list[Task]:
    """Return the tasks of the designs that recordings need; `gbid tune` runs these tasks, too."""
    return [design_task(early_design(job.experiment, name)) for name in early_designs(job.experiment)]


LOOP = Stage("loop", "controller", (), loop_tasks, early=True)
"""``controller/<design>.h5`` of the designs that close the loop of recordings."""


# ---- Loss of precision by a loop: standard deviations in closed and in open loop.

FOLDER = "loops"
_DIGITS = 2


@dataclass(frozen=True)
class LoopCostRow:
    """Standard deviations of a parameter in closed and open loop at one operating point.

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

    def document(self) -> Row:
        """Return the row as plain values for JSON, with the ratio of the standard deviations."""
        return {**asdict(self), "ratio": self.std / self.std_beside}


def _peak_words(row: LoopCostRow, peak: float) -> str:
    cell = formatted(peak, _DIGITS, row.peak_unit)
    return f"{row.peak_of} up to {cell.text if isinstance(cell, Cell) else '?'}"


def cost_tables(rows: Sequence[LoopCostRow]) -> Iterator[Table]:
    """Yield a comparison table for each closed-loop fit and operating point."""
    columns = [Column("parameter"), Column("std in the loop", format=_DIGITS), Column("std without", format=_DIGITS)]
    columns.append(Column("ratio", format=".2f"))
    for (fit, point), group in groupby(rows, key=lambda row: (row.fit, row.point)):
        first, *_ = here = list(group)
        up_to = partial(_peak_words, first)
        notes = [
            f"{heading}: {count} fits, recordings of {length:g} s, {peak}"
            for heading, count, length, peak in (
                ("in the loop", first.recordings, first.duration_s, up_to(first.peak)),
                ("without", first.recordings_beside, first.duration_beside_s, up_to(first.peak_beside)),
            )
        ]
        notes.append("medians over the converged fits; above a ratio of 1 the loop costs precision, below it gains")
        cells = [
            [q.parameter, *(formatted(std, _DIGITS, q.unit) for std in (q.std, q.std_beside)), q.std / q.std_beside]
            for q in here
        ]
        yield Table(f"{fit}, {point}: what the loop costs in precision, beside {first.beside}", columns, cells, notes)


def cost_tasks(job: Job) -> list[Task]:
    """Return the tasks of the comparison tables, one for each fit that names an open-loop fit."""
    experiment, tasks = job.experiment, []
    for name, section in experiment.spec.fits.items():
        beside = section.loop.beside if section.loop is not None else None
        if beside is not None and _converged(job, name) and _converged(job, beside):
            models = [(fit, entry.model) for fit in (name, beside) for entry, _ in _converged(job, fit)]
            fits = [fit_result(experiment, *model) for model in models]
            result = experiment.result(Item("loop cost", name), FOLDER, {"beside": beside}, fits, ending=".csv")
            tasks.append(Task.of(result, partial(_write, name=name, beside=beside)))
    return tasks


def made_costs(job: Job) -> list[LoopCostRow]:
    """Return the rows of all existing comparison tables of the present fits; nothing is computed."""
    return [row for task in cost_tasks(job) if task.is_made for row in read_values(task.path, LoopCostRow)]


def cost_rows(job: Job, name: str, beside: str) -> list[LoopCostRow]:
    """Return the comparison rows of a fit by operating point and parameter; empty if the fits have none in common."""
    closed_points, free_points = (_by_point(job, _converged(job, each)) for each in (name, beside))
    rows = []
    for point, closed in closed_points.items():
        free = free_points.get(point, [])
        if not free:
            continue
        signal = closed[0].options.outputs[-1].partition(".")[0]
        unit = load_fit_input(job, job.experiment.recordings[closed[0].recordings[0]]).units[signal]
        sizes = _sizes(job, closed) | _sizes(job, free, "_beside")
        for parameter in closed[0].std:
            std, std_beside = (_median_std(group, parameter) for group in (closed, free))
            if std is None or std_beside is None:  # fixed, not a parameter of both, or without standard deviation
                continue
            row = {**sizes, "unit": closed[0].units[parameter], "std": std, "std_beside": std_beside}
            rows.append(LoopCostRow(name, beside, point, peak_of=signal, peak_unit=unit, parameter=parameter, **row))
    return rows


def _converged(job: Job, name: str) -> list[tuple[TableEntry, identify.FitResult]]:
    return [
        (entry, entry.result) for entry in fit_entries(job, name) if entry.result is not None and entry.result.success
    ]


def _by_point(
    job: Job, entries: Sequence[tuple[TableEntry, identify.FitResult]]
) -> dict[str, list[identify.FitResult]]:
    results: dict[str, list[identify.FitResult]] = {}
    for entry, result in entries:
        results.setdefault(job.experiment.recordings[entry.recordings[0]].point, []).append(result)
    return results


def _sizes(job: Job, results: Sequence[identify.FitResult], beside: str = "") -> dict[str, Any]:
    """Return number, median length and median peak of recordings, by table column."""
    recordings = [load_fit_input(job, job.experiment.recordings[result.recordings[0]]) for result in results]
    signal = results[0].options.outputs[-1].partition(".")[0]
    peaks = [float(np.abs(recording.signal(signal)).max()) for recording in recordings]
    length = median(recording.duration for recording in recordings)
    return {f"recordings{beside}": len(recordings), f"duration{beside}_s": length, f"peak{beside}": median(peaks)}


def _median_std(results: Sequence[identify.FitResult], parameter: str) -> float | None:
    known = [float(v) for result in results if (v := result.std.get(parameter, 0.0)) > 0]
    return median(known) if known else None


def _write(job: Job, part: Path, name: str, beside: str) -> None:
    notes = ("standard deviations: medians over the recordings of an operating point; only of fits that converged",)
    rows = cost_rows(job, name, beside)
    write_csv(table_of_values(LoopCostRow, rows, notes), part)


def _in_run(experiment: Experiment) -> bool:
    fits = experiment.spec.fits.values()
    return any(section.loop is not None and section.loop.beside is not None for section in fits)


LOOP_COST = Stage("loop cost", "fits", (fit_loops_are_known,), cost_tasks, in_run=_in_run)
"""``loops/<fit>.csv``: standard deviations in the loop beside those without controller."""
