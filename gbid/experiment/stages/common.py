"""What all stages share: the job, its tasks, what became of them, and who is told."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

from gbid.control.tuning.gain_result import SearchStep
from gbid.experiment.load import Experiment
from gbid.identify import Progress

State = Literal["made", "kept", "failed"]
Cause = Literal["", "input", "data", "usage", "defect", "crash"]


@dataclass(frozen=True)
class Outcome:
    """What became of one result file.

    Attributes
    ----------
    stage, item : str
        ``"fit"`` and ``"bearing/p5_n6000_prbs1"``, for example.
    path : pathlib.Path
        The file.
    state : {"made", "kept", "failed"}
        Kept: it was there, made from the same settings and data.
    text : str
        Why it failed, or what to know about it.
    seconds : float
        Time it took.
    converged : bool
        False for a fit that did not; its file is written all the same.
    fit_percent : float
        Of a fit, the smallest of its outputs; nan for anything else.
    cause : {"", "input", "data", "usage", "defect", "crash"}
        Of a failure: an input that is not there, bad data, wrong options, a defect of gbid, a process that died.
    before : bool
        Whether it failed in an earlier run, and was not tried again.
    """

    stage: str
    item: str
    path: Path
    state: State
    text: str = ""
    seconds: float = 0.0
    converged: bool = True
    fit_percent: float = math.nan
    cause: Cause = ""
    before: bool = False


@dataclass(frozen=True)
class Made:
    """What to know of a result; see `Outcome`."""

    text: str = ""
    converged: bool = True
    fit_percent: float = math.nan


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


class Reporter(Protocol):
    """Where stages tell how they get on."""

    def expect(self, stage: str, todo: int, there: int, failed: int) -> None:
        """Tell how many items of a stage are to be made, are there, and failed before; their outcomes follow."""
        ...

    def begin(self, stage: str, item: str) -> None:
        """Tell that work on an item begins."""
        ...

    def iteration(self, progress: Progress) -> None:
        """Tell of an iteration of the solver."""
        ...

    def search(self, step: SearchStep) -> None:
        """Tell how far a search for gains has come."""
        ...

    def end(self, outcome: Outcome) -> None:
        """Tell what became of an item."""
        ...


class Silent:
    """A reporter that says nothing."""

    def expect(self, stage: str, todo: int, there: int, failed: int) -> None:
        """Say nothing."""

    def begin(self, stage: str, item: str) -> None:
        """Say nothing."""

    def iteration(self, progress: Progress) -> None:
        """Say nothing."""

    def search(self, step: SearchStep) -> None:
        """Say nothing."""

    def end(self, outcome: Outcome) -> None:
        """Say nothing."""


class Engine(Protocol):
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


class InTurn:
    """The engine that runs one task after the other in this process."""

    def outcomes(self, job: Job, tasks: Sequence[Task]) -> Generator[tuple[int, Outcome], None, None]:
        """Run tasks in their order."""
        from gbid.experiment.stages.performing import perform  # after this module: performing needs Job

        for number, task in enumerate(tasks):
            job.reporter.begin(task.stage, task.item)
            yield number, perform(job, task)

    def close(self) -> None:
        """Do nothing."""


@dataclass(frozen=True)
class Job:
    """An experiment to be run.

    Attributes
    ----------
    experiment : Experiment
    overwrite : bool
        Whether results made from other settings may be replaced.
    reporter : Reporter
    engine : Engine
        What runs the tasks.
    retry : bool
        Whether what failed in an earlier run, with the same settings and data, is tried again.
    """

    experiment: Experiment
    overwrite: bool = False
    reporter: Reporter = field(default_factory=Silent)
    engine: Engine = field(default_factory=InTurn)
    retry: bool = False

    def path(self, folder: str, name: str, ending: str = ".h5") -> Path:
        """Path of a result."""
        return self.experiment.results / folder / f"{name}{ending}"
