"""Progress on standard error: an updated line on a terminal, a few plain lines otherwise."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from gbid.cli.tally import Tally
from gbid.cli.telling import tell
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.reporter import Reporter
from gbid.naming.escape import printable

if TYPE_CHECKING:
    from gbid.control.tuning.search.step import SearchStep
    from gbid.identify import Progress

EVERY = 10
"""Iterations between plain lines."""

PAUSE = 10.0
"""Seconds between plain lines of a stage with many items."""

SEARCH_PAUSE = 2.0
"""Seconds between plain lines of a search for gains."""


@contextmanager
def reporting() -> Iterator[Reporter]:
    """Return a context that gives the reporter for standard error."""
    if not sys.stderr.isatty():
        yield PlainReporter()
        return
    from rich.console import Console

    console = Console(stderr=True, highlight=False)
    with console.status("") as status:
        yield TerminalReporter(console, status)


class PlainReporter:
    """Reporter for logs: one line per result and per ten iterations; for many results, a line at intervals."""

    def __init__(self) -> None:
        self._line, self._tally, self._said, self._searched = _Line(), Tally(), 0.0, 0.0

    def expect(self, stage: str, todo: int, there: int, failed: int) -> None:
        """Print the numbers of items when there are many."""
        self._tally, self._said = Tally(stage, todo, there, failed), time.monotonic()
        if self._tally.many:
            tell(self._tally.opening())

    def begin(self, stage: str, item: str) -> None:
        """Store the item to which the iterations belong."""
        self._line = _Line(f"{stage} {item}")
        self._tally.begin(stage, item)

    def iteration(self, progress: Progress) -> None:
        """Print every tenth iteration."""
        text = self._line.of(progress)
        if progress.iteration and progress.iteration % EVERY == 0 and not self._tally.many:
            tell(text)

    def search(self, step: SearchStep) -> None:
        """Print a step of the search, at intervals."""
        now = time.monotonic()
        if now - self._searched > SEARCH_PAUSE and not self._tally.many:
            self._searched = now
            tell(self._line.of_search(step))

    def end(self, outcome: Outcome) -> None:
        """Print the outcome of an item; for many items only failures."""
        tally = self._tally
        tally.end(outcome)
        if tally.is_named(outcome):
            tell(_outcome(outcome))
        if not tally.many or outcome.stage != tally.stage:
            return
        now = time.monotonic()
        if outcome.state != "kept" and tally.todo and (tally.done == tally.todo or now - self._said > PAUSE):
            self._said = now
            tell(tally.text())


class TerminalReporter:
    """Reporter for terminals: one line shows the present item and iteration, above it the finished items."""

    def __init__(self, console: Any, status: Any) -> None:
        self._console, self._status, self._line, self._tally = console, status, _Line(), Tally()

    def expect(self, stage: str, todo: int, there: int, failed: int) -> None:
        """Print the numbers of items when there are many."""
        self._tally = Tally(stage, todo, there, failed)
        if self._tally.many:
            self._say(self._tally.opening())

    def begin(self, stage: str, item: str) -> None:
        """Show the present item."""
        self._line = _Line(item)  # without the stage, so that an iteration has room on a line of 80
        self._tally.begin(stage, item)
        if not self._tally.many:
            self._show(f"{stage} {item}")
        elif self._tally.running == 1 or not self._tally.done:
            self._show(self._tally.text())  # else after the outcome of the previous item, which follows

    def iteration(self, progress: Progress) -> None:
        """Show the iteration."""
        text = self._line.of(progress)
        if not self._tally.many:
            self._show(text)

    def search(self, step: SearchStep) -> None:
        """Show the step."""
        if not self._tally.many:
            self._show(self._line.of_search(step))

    def end(self, outcome: Outcome) -> None:
        """Print the outcome of an item; for many items only failures."""
        tally = self._tally
        tally.end(outcome)
        counted = tally.many and outcome.stage == tally.stage
        if counted:
            self._show(tally.text())
        if tally.is_named(outcome):
            self._say(_outcome(outcome))
        if counted and tally.todo and tally.done == tally.todo:
            self._say(tally.text())

    def _say(self, text: str) -> None:
        self._console.print(printable(text), markup=False, soft_wrap=True)

    def _show(self, text: str) -> None:
        """Show a text in the line that is updated; the status would read a string as markup."""
        from rich.text import Text

        self._status.update(Text(printable(text)))


class _Line:
    """Progress of one item; a fit may be tried from several starts or with several windows."""

    def __init__(self, label: str = "") -> None:
        self.label, self._tries = label, 0

    def of(self, progress: Progress) -> str:
        """Return iteration, cost and step of the solver as text."""
        self._tries += progress.iteration == 0
        which = f", try {self._tries}" if self._tries > 1 else ""
        step = f", step {progress.sigma:.1g} std" if math.isfinite(progress.sigma) else ""
        where = f"iteration {progress.iteration}, cost {progress.cost:.5g}, gap {progress.gap:.0e}"
        return f"{self.label}{which}: {where}{step}"

    def of_search(self, step: SearchStep) -> str:
        """Return stage and best value of a search for gains as text."""
        excess = f", limits exceeded by {100 * step.violation:.2g} %" if step.violation > 0 else ""
        return f"{self.label}: {step.stage}, {step.count} designs, best {step.value:.5g}{excess}"


def _outcome(outcome: Outcome) -> str:
    took = f" ({outcome.seconds:.1f} s)" if outcome.state == "made" else ""
    state = "failed before" if outcome.before else outcome.state
    why = f": {outcome.text}" if outcome.text else ""
    return f"{outcome.stage} {outcome.item}: {state}{took}{why}"
