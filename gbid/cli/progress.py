"""Progress on standard error: a living line on a terminal, sparse plain lines otherwise."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from gbid.experiment.stages.common import Outcome, Reporter

if TYPE_CHECKING:
    from gbid.identify import Progress

EVERY = 10
"""Iterations between plain lines."""


@contextmanager
def reporting() -> Iterator[Reporter]:
    """Give the reporter that suits standard error."""
    if not sys.stderr.isatty():
        yield PlainReporter()
        return
    from rich.console import Console

    console = Console(stderr=True, highlight=False)
    with console.status("") as status:
        yield TerminalReporter(console, status)


class PlainReporter:
    """Lines for a log: one per result, and one per so many iterations."""

    def __init__(self) -> None:
        self._label = ""

    def begin(self, stage: str, item: str) -> None:
        """Remember what the iterations belong to."""
        self._label = f"{stage} {item}"

    def iteration(self, progress: Progress) -> None:
        """Print every tenth iteration."""
        if progress.iteration and progress.iteration % EVERY == 0:
            _line(f"{self._label}: {_iteration(progress)}")

    def end(self, outcome: Outcome) -> None:
        """Print what became of the item."""
        _line(_outcome(outcome))


class TerminalReporter:
    """One line that shows the present item and iteration, above it what is done."""

    def __init__(self, console: Any, status: Any) -> None:
        self._console, self._status, self._label = console, status, ""

    def begin(self, stage: str, item: str) -> None:
        """Show what is being done."""
        self._label = f"{stage} {item}"
        self._status.update(self._label)

    def iteration(self, progress: Progress) -> None:
        """Show the iteration."""
        self._status.update(f"{self._label}: {_iteration(progress)}")

    def end(self, outcome: Outcome) -> None:
        """Leave a line with what became of the item."""
        self._console.print(_outcome(outcome), markup=False, soft_wrap=True)


def _iteration(progress: Progress) -> str:
    return f"iteration {progress.iteration}, cost {progress.cost:.5g}, gap {progress.gap:.0e}"


def _outcome(outcome: Outcome) -> str:
    time = f" ({outcome.seconds:.1f} s)" if outcome.state == "made" else ""
    why = f": {outcome.text}" if outcome.state == "failed" else ""
    return f"{outcome.stage} {outcome.item}: {outcome.state}{time}{why}"


def _line(text: str) -> None:
    print(text, file=sys.stderr, flush=True)  # noqa: T201
