"""What all stages share: the job, its tasks, what became of them, and who is told."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from gbid.experiment.experiment import Experiment
from gbid.experiment.run.outcome import Made, Outcome
from gbid.experiment.run.reporter import Reporter, Silent


@dataclass(frozen=True)
class Task:
    """One result file that can be made on its own, in any process.

    Attributes
    ----------
    stage, item : str
    path : pathlib.Path
        The file.
    key : str
        Its content key.
    write : callable
        Function of a module (so that another process finds it) that makes the result from job and item, writes it
        to the path given to it, and may say what to know of it.
    recordings : tuple of str
        Recordings that it is made from.
    read : callable, optional
        Tells of a result that is there what `write` told when it made it.
    """

    stage: str
    item: str
    path: Path
    key: str
    write: Callable[[Job, str, Path], Made | None]
    recordings: tuple[str, ...] = ()
    read: Callable[[Path], Made] | None = None


class TaskEngine(Protocol):
    """What runs tasks, here or elsewhere."""

    def outcomes(self, job: Job, tasks: Sequence[Task]) -> Generator[tuple[int, Outcome], None, None]:
        """Run tasks and give the outcome of each with its number as soon as it is known, in any order.

        It tells the job's reporter when work on a task begins. Closing the generator stops what is still running.

        Raises
        ------
        NoSpaceError
            When the disk is full; the tasks that are left are not run.
        """
        ...

    def close(self) -> None:
        """End what runs the tasks."""
        ...


@dataclass(frozen=True)
class Job:
    """An experiment to be run.

    Attributes
    ----------
    experiment : Experiment
    overwrite : bool
        Whether results made from other settings may be replaced.
    reporter : Reporter
    engine : TaskEngine, optional
        What runs the tasks; one after the other in this process when not given.
    retry : bool
        Whether what failed in an earlier run, with the same settings and data, is tried again.
    """

    experiment: Experiment
    overwrite: bool = False
    reporter: Reporter = field(default_factory=Silent)
    engine: TaskEngine | None = None
    retry: bool = False

    def path(self, folder: str, name: str, ending: str = ".h5") -> Path:
        """Path of a result."""
        return self.experiment.results / folder / f"{name}{ending}"
