"""Reporter: receiver of the progress of a run."""

from __future__ import annotations

from typing import Protocol

from gbid.control.tuning.search.step import SearchStep
from gbid.experiment.run.outcome import Outcome
from gbid.identify import Progress


class Reporter(Protocol):
    """Receiver of the progress of stages."""

    def expect(self, stage: str, todo: int, there: int, failed: int) -> None:
        """Receive the numbers of items of a stage to make, existing, and failed before; their outcomes follow."""
        ...

    def begin(self, stage: str, item: str) -> None:
        """Receive the start of work on an item."""
        ...

    def iteration(self, progress: Progress) -> None:
        """Receive an iteration of the solver."""
        ...

    def search(self, step: SearchStep) -> None:
        """Receive a step of a search for gains."""
        ...

    def end(self, outcome: Outcome) -> None:
        """Receive the outcome of an item."""
        ...


class Silent:
    """Reporter that ignores all progress."""

    def expect(self, stage: str, todo: int, there: int, failed: int) -> None:
        """Ignore the numbers of items."""

    def begin(self, stage: str, item: str) -> None:
        """Ignore the start of an item."""

    def iteration(self, progress: Progress) -> None:
        """Ignore an iteration."""

    def search(self, step: SearchStep) -> None:
        """Ignore a step of the search."""

    def end(self, outcome: Outcome) -> None:
        """Ignore an outcome."""
