"""Job and tasks: the part that all stages share."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from gbid.experiment.experiment import Experiment
from gbid.experiment.run.outcome import Made, Outcome
from gbid.experiment.run.reporter import Reporter, Silent
from gbid.naming.paths import file_stem


@dataclass(frozen=True)
class Task:
    """Task that makes one result file, in any process.

    Attributes
    ----------
    stage, item : str
        Names of the stage and of the item.
    path : pathlib.Path
        The result file.
    key : str
        Content key of the result.
    write : callable
        Function that makes the result from job and item, writes it to the given path, and may return its summary. It
        must be defined in a module, so that another process can import it.
    recordings : tuple of str
        Recordings from which the result is made.
    read : callable, optional
        Function that returns the summary of an existing result: the same as `write` returned.
    """

    stage: str
    item: str
    path: Path
    key: str
    write: Callable[[Job, str, Path], Made | None]
    recordings: tuple[str, ...] = ()
    read: Callable[[Path], Made] | None = None


class TaskEngine(Protocol):
    """Engine: it runs tasks in this process or in others."""

    def outcomes(self, job: Job, tasks: Sequence[Task]) -> Generator[tuple[int, Outcome], None, None]:
        """Run tasks; yield number and outcome of each as soon as it ends, in any order.

        The engine informs the reporter of the job when a task begins. Closing the generator stops the running tasks.

        Raises
        ------
        NoSpaceError
            When the disk is full; the remaining tasks are not run.
        """
        ...

    def close(self) -> None:
        """Stop the workers of the engine."""
        ...


@dataclass(frozen=True)
class Job:
    """Job: an experiment with the options of its run.

    Attributes
    ----------
    experiment : Experiment
        The experiment to run.
    overwrite : bool
        Whether results made from other settings may be replaced.
    reporter : Reporter
        Receiver of the progress.
    engine : TaskEngine, optional
        Engine that runs the tasks; without it they run one after the other in this process.
    retry : bool
        Whether tasks that failed in an earlier run, with the same settings and data, are tried again.
    """

    experiment: Experiment
    overwrite: bool = False
    reporter: Reporter = field(default_factory=Silent)
    engine: TaskEngine | None = None
    retry: bool = False

    def path(self, folder: str, name: str, ending: str = ".h5") -> Path:
        """Return the path of a result; a long name is cut, and ends with a digest."""
        *above, last = name.split("/")
        return self.experiment.results.joinpath(folder, *map(file_stem, above), f"{file_stem(last)}{ending}")
