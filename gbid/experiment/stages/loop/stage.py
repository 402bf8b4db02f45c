"""Stage of the designs that close the loop of recordings: they are tuned before anything is recorded."""

from __future__ import annotations

from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.stage import Stage
from gbid.experiment.stages.impact.plan import TUNED
from gbid.experiment.stages.loop.checks import fit_loops_are_known, rig_loop_can_run
from gbid.experiment.stages.loop.plan import early_designs, early_key
from gbid.experiment.stages.tune.stage import read_design_summary, write_design


def loop_tasks(job: Job) -> list[Task]:
    """Return the tasks of the designs that recordings need; `gbid tune` makes the same."""
    return [
        Task(
            "tune", name, job.path(TUNED, name), early_key(job.experiment, name), write_design, read=read_design_summary
        )
        for name in early_designs(job.experiment)
    ]


LOOP = Stage("loop", "rig", (rig_loop_can_run, fit_loops_are_known), loop_tasks, early=True)
"""``controller/<design>.h5`` of the designs that close the loop of recordings."""
