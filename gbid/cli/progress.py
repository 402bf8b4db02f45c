"""Progress on standard error: a living line on a terminal, sparse plain lines otherwise."""

from __future__ import annotations

import math
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
        self._line = _Line()

    def begin(self, stage: str, item: str) -> None:
        """Remember what the iterations belong to."""
        self._line = _Line(f"{stage} {item}")

    def iteration(self, progress: Progress) -> None:
        """Print every tenth iteration."""
        text = self._line.of(progress)
        if progress.iteration and progress.iteration % EVERY == 0:
            _print(text)

    def end(self, outcome: Outcome) -> None:
        """Print what became of the item."""
        _print(_outcome(outcome))


class TerminalReporter:
    """One line that shows the present item and iteration, above it what is done."""

    def __init__(self, console: Any, status: Any) -> None:
        self._console, self._status, self._line = console, status, _Line()

    def begin(self, stage: str, item: str) -> None:
        """Show what is being done."""
        self._line = _Line(item)  # without the stage, so that an iteration has room on a line of 80
        self._status.update(f"{stage} {item}")

    def iteration(self, progress: Progress) -> None:
        """Show the iteration."""
        self._status.update(self._line.of(progress))

    def end(self, outcome: Outcome) -> None:
        """Leave a line with what became of the item."""
        self._console.print(_outcome(outcome), markup=False, soft_wrap=True)


class _Line:
    """The progress of one item; a fit may be tried from several starts or with several windows."""

    def __init__(self, label: str = "") -> None:
        self.label, self._tries = label, 0

    def of(self, progress: Progress) -> str:
        """Say where the solver is."""
        self._tries += progress.iteration == 0
        which = f", try {self._tries}" if self._tries > 1 else ""
        step = f", step {progress.sigma:.1g} std" if math.isfinite(progress.sigma) else ""
        where = f"iteration {progress.iteration}, cost {progress.cost:.5g}, gap {progress.gap:.0e}"
        return f"{self.label}{which}: {where}{step}"


def _outcome(outcome: Outcome) -> str:
    time = f" ({outcome.seconds:.1f} s)" if outcome.state == "made" else ""
    why = f": {outcome.text}" if outcome.text else ""
    return f"{outcome.stage} {outcome.item}: {outcome.state}{time}{why}"


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)  # noqa: T201
