"""A part of a campaign for each job of an array, with no scheduler between them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from gbid.errors import UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.run.job import Task


@dataclass(frozen=True)
class Shard:
    """Part `number` of `count`, counted from one."""

    number: int
    count: int


def read_shard(text: str) -> Shard:
    """Read ``i/n``.

    Raises
    ------
    UsageError
        When it is something else, or i is not within 1 to n.
    """
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise UsageError(f"shard {text!r}; write i/n with i from 1 to n, as 3/8")
    return Shard(int(found[1]), int(found[2]))


def tasks_of(shard: Shard | None, experiment: Experiment, tasks: Sequence[Task]) -> list[Task]:
    """Tasks of a shard: its share of the recordings, fits of these, and the stationary recordings that they need.

    Excited recordings are dealt out in turn, then staircases, hammer runs and run-ups. A stationary recording is made
    by each shard that needs it, always the same. What needs recordings of several shards, a fit to all of them or the
    map of an operating point, is left to a run without shards.

    Parameters
    ----------
    shard : Shard or None
        None for all tasks.
    experiment : Experiment
    tasks : sequence of Task

    Returns
    -------
    list of Task
    """
    if shard is None:
        return list(tasks)
    recordings = experiment.recordings.values()
    apart = sorted((q for q in recordings if not q.stationary), key=lambda planned: not planned.excited)
    own = apart[shard.number - 1 :: shard.count]
    points = {planned.point for planned in own if planned.excited}
    still = [q.name for q in recordings if q.stationary and q.point in points]
    mine = {*(planned.name for planned in own), *still}
    return [task for task in tasks if mine.issuperset(task.recordings)]
