"""Who is told how a run gets on."""

from __future__ import annotations

from typing import Protocol

from gbid.control.tuning.search.step import SearchStep
from gbid.experiment.run.outcome import Outcome
from gbid.identify import Progress


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
