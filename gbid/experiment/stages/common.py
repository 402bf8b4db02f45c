"""What all stages share: what they report, and how one result is made or kept."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

from gbid.errors import DataError
from gbid.experiment.keys import is_current, writing_keyed
from gbid.experiment.load import Experiment
from gbid.identify import Progress

State = Literal["made", "kept", "failed"]


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
    """

    stage: str
    item: str
    path: Path
    state: State
    text: str = ""
    seconds: float = 0.0
    converged: bool = True


class Reporter(Protocol):
    """Where stages tell how they get on."""

    def begin(self, stage: str, item: str) -> None:
        """Tell that work on an item begins."""
        ...

    def iteration(self, progress: Progress) -> None:
        """Tell of an iteration of the solver."""
        ...

    def end(self, outcome: Outcome) -> None:
        """Tell what became of an item."""
        ...


class Silent:
    """A reporter that says nothing."""

    def begin(self, stage: str, item: str) -> None:
        """Say nothing."""

    def iteration(self, progress: Progress) -> None:
        """Say nothing."""

    def end(self, outcome: Outcome) -> None:
        """Say nothing."""


@dataclass(frozen=True)
class Job:
    """An experiment to be run.

    Attributes
    ----------
    experiment : Experiment
    overwrite : bool
        Whether results made from other settings may be replaced.
    reporter : Reporter
    """

    experiment: Experiment
    overwrite: bool = False
    reporter: Reporter = field(default_factory=Silent)

    def path(self, folder: str, name: str, ending: str = ".h5") -> Path:
        """Path of a result."""
        return self.experiment.results / folder / f"{name}{ending}"


def produce(job: Job, stage: str, item: str, path: Path, key: str, write: Callable[[Path], str | None]) -> Outcome:
    """Keep a result, or make it; bad data are an outcome, so that the others go on.

    Parameters
    ----------
    job : Job
    stage, item : str
    path : pathlib.Path
        The result.
    key : str
        Its content key.
    write : callable
        Makes the result, writes it to the path given to it, and may say a word about it.

    Returns
    -------
    Outcome

    Raises
    ------
    UsageError
        When a result made from other settings is there and may not be replaced.
    """
    began = time.perf_counter()
    try:
        if is_current(path, key, job.overwrite):
            outcome = Outcome(stage, item, path, "kept")
        else:
            job.reporter.begin(stage, item)
            with writing_keyed(path, key) as part:
                text = write(part) or ""
            outcome = Outcome(stage, item, path, "made", text, time.perf_counter() - began)
    except DataError as error:
        outcome = Outcome(stage, item, path, "failed", str(error))
    job.reporter.end(outcome)
    return outcome
