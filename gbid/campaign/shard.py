"""Shards: parts of a campaign for the jobs of an array, without a scheduler between them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from gbid.errors import UsageError
from gbid.experiment.experiment import Experiment
from gbid.experiment.run.job import Task


@dataclass(frozen=True)
class Shard:
    """Part `number` of `count` parts, counted from one."""

    number: int
    count: int


def read_shard(text: str) -> Shard:
    """Return the shard of a text ``i/n``.

    Raises
    ------
    UsageError
        When the text has another form, or i is not within 1 to n.
    """
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise UsageError(f"shard {text!r}; write i/n with i from 1 to n, as 3/8")
    return Shard(int(found[1]), int(found[2]))


def tasks_of(shard: Shard | None, experiment: Experiment, tasks: Sequence[Task]) -> list[Task]:
    """Return the tasks of a shard: its recordings, their fits, and the stationary recordings that these need.

    Excited recordings are dealt out in turn, then staircases, hammer runs and run-ups. A stationary recording is made
    by each shard that needs it, and is always the same. Tasks that need recordings of several shards, such as a fit to
    all of them or the map of an operating point, are left to a run without shards.

    Parameters
    ----------
    shard : Shard or None
        The shard; None for all tasks.
    experiment : Experiment
        The experiment.
    tasks : sequence of Task
        Tasks of one stage.

    Returns
    -------
    list of Task
        The tasks of the shard, in their order.
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
