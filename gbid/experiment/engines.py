"""Engines that run the tasks of a campaign: this process, a pool of processes, or Dask."""

from __future__ import annotations

import os
from collections.abc import Generator, Sequence
from typing import Literal, get_args

from gbid.core.errors import UsageError
from gbid.experiment.dask import DaskEngine
from gbid.experiment.pool import ProcessPool
from gbid.experiment.run import InTurn, Job, Outcome, Task, TaskEngine

EngineName = Literal["auto", "serial", "pool", "dask"]

FEW = 8
"""Smallest number of tasks of a stage for which worker processes are started."""


def make_engine(name: str = "auto", workers: int | None = None, scheduler: str | None = None) -> TaskEngine:
    """Return an engine that runs tasks.

    Parameters
    ----------
    name : {"auto", "serial", "pool", "dask"}
        "serial" is this process; "pool" is a pool of processes on this machine; "auto" is this process for a few tasks
        and the pool for many.
    workers : int, optional
        Number of processes; the default is the number of processors that this process may use.
    scheduler : str, optional
        Address of a Dask scheduler.

    Returns
    -------
    TaskEngine
        The engine; close it after use.

    Raises
    ------
    UsageError
        When the name is unknown, the options contradict each other, or the scheduler does not answer.
    """
    if name not in get_args(EngineName):
        raise UsageError(f"engine {name!r}; choose {', '.join(get_args(EngineName))}")
    if workers is not None and workers < 1:
        raise UsageError(f"{workers} workers; give at least 1")
    if scheduler is not None and name not in ("auto", "dask"):
        raise UsageError(f"a scheduler is for the engine dask, not {name}; leave one of the two out")
    if scheduler is not None and workers is not None:
        raise UsageError("a scheduler has its own workers; leave the number of workers out")
    if workers is not None and name == "serial":
        raise UsageError("the engine serial is this process alone; leave the number of workers out, or choose pool")
    count = workers or _processors()
    if name == "dask" or scheduler is not None:
        return DaskEngine(scheduler, count)
    if name == "serial":
        return InTurn()

    return ProcessPool(count) if name == "pool" else Auto(ProcessPool(count))


class Auto:
    """Engine that runs a few tasks in this process and many on a pool; a pool that has started runs all."""

    def __init__(self, pool: TaskEngine) -> None:
        self._pool, self._started = pool, False

    def outcomes(self, job: Job, tasks: Sequence[Task]) -> Generator[tuple[int, Outcome], None, None]:
        """Run tasks; yield number and outcome of each, as in `gbid.experiment.run.TaskEngine`."""
        self._started = self._started or len(tasks) >= FEW
        yield from (self._pool if self._started else InTurn()).outcomes(job, tasks)

    def close(self) -> None:
        """Close the pool."""
        self._pool.close()


def _processors() -> int:
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # missing on some systems
        return os.cpu_count() or 1
