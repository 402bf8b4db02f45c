"""Progress on standard error: a bar with rate and time left on a terminal, a few plain lines otherwise."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from gbid.cli.causes import in_short, not_made
from gbid.cli.live import LiveLine
from gbid.cli.progress_line import ProgressLine, outcome_line
from gbid.cli.tally import Tally
from gbid.cli.telling import tell
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.reporter import Reporter, Silent

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
def reporting(quiet: bool = False, verbose: bool = False) -> Iterator[Reporter]:
    """Return a context that gives the reporter for standard error.

    Parameters
    ----------
    quiet : bool
        Whether nothing is shown; errors are still told at the end.
    verbose : bool
        Whether each item and each iteration has a line.
    """
    if quiet:
        yield Silent()
        return
    plain = PlainReporter(verbose)
    if verbose or not sys.stderr.isatty():
        yield plain
        plain.close()
        return
    with LiveLine() as live:
        terminal = TerminalReporter(live)
        yield terminal
        terminal.close()


class _Idle:
    """Results that cannot be made because of earlier failures: told in one line for each stage."""

    def __init__(self) -> None:
        self._failed: list[Outcome] = []
        self._stage, self._count, self._first = "", 0, ""

    def takes(self, outcome: Outcome) -> bool:
        """Keep an outcome; return whether it is one of those that are only counted."""
        if outcome.state == "failed":
            self._failed.append(outcome)
        if outcome.state != "failed" or outcome.cause != "input":
            return False
        self._stage, self._count = outcome.stage, self._count + 1
        self._first = self._first or outcome.text
        return True

    def said(self, stage: str = "") -> str:
        """Return the line on the results counted so far, once another stage begins; empty before."""
        if not self._count or stage == self._stage:
            return ""
        why = in_short(self._failed) or self._first
        text = not_made(self._stage, self._count, why)
        self._stage, self._count, self._first = "", 0, ""
        return text


class PlainReporter:
    """Reporter for logs: one line per result and per ten iterations; for many results, a line at intervals."""

    def __init__(self, verbose: bool = False) -> None:
        self._line, self._tally, self._said, self._searched = ProgressLine(), Tally(), 0.0, 0.0
        self._idle, self._verbose = _Idle(), verbose

    def expect(self, stage: str, todo: int, there: int, failed: int) -> None:
        """Print the numbers of items when there are many."""
        self._flush(stage)
        self._tally, self._said = Tally(stage, todo, there, failed), time.monotonic()
        if self._tally.many:
            tell(self._tally.opening())

    def begin(self, stage: str, item: str) -> None:
        """Store the item to which the iterations belong."""
        self._flush(stage)
        self._line = ProgressLine(f"{stage} {item}")
        self._tally.begin(stage, item)

    def iteration(self, progress: Progress) -> None:
        """Print every tenth iteration."""
        text = self._line.of(progress)
        often = progress.iteration and progress.iteration % EVERY == 0 and not self._tally.many
        if often or self._verbose:
            tell(text)

    def search(self, step: SearchStep) -> None:
        """Print a step of the search, at intervals."""
        now = time.monotonic()
        if self._verbose or (now - self._searched > SEARCH_PAUSE and not self._tally.many):
            self._searched = now
            tell(self._line.of_search(step))

    def end(self, outcome: Outcome) -> None:
        """Print the outcome of an item; for many items only failures."""
        tally = self._tally
        self._flush(outcome.stage)
        tally.end(outcome)
        counted_only = self._idle.takes(outcome)
        if (tally.is_named(outcome) or self._verbose) and not counted_only:
            tell(outcome_line(outcome))
        if not tally.many or outcome.stage != tally.stage:
            return
        now = time.monotonic()
        if outcome.state != "kept" and tally.todo and (tally.done == tally.todo or now - self._said > PAUSE):
            self._said = now
            tell(tally.text())

    def close(self) -> None:
        """Print what is still to be said."""
        self._flush("")

    def _flush(self, stage: str) -> None:
        if text := self._idle.said(stage):
            tell(text)


class TerminalReporter:
    """Reporter for terminals: a bar with the present item, above it the finished items."""

    def __init__(self, live: LiveLine) -> None:
        self._live, self._line, self._tally, self._idle = live, ProgressLine(), Tally(), _Idle()

    def expect(self, stage: str, todo: int, there: int, failed: int) -> None:
        """Print the numbers of items when there are many."""
        self._flush(stage)
        self._tally = Tally(stage, todo, there, failed)
        self._live.begin(todo)
        if self._tally.many:
            self._live.say(self._tally.opening())

    def begin(self, stage: str, item: str) -> None:
        """Show the present item."""
        self._flush(stage)
        self._line = ProgressLine(item)  # without the stage, so that an iteration has room on a line of 80
        self._tally.begin(stage, item)
        if not self._tally.many:
            self._live.show(f"{stage} {item}", self._tally.done, self._tally.pace())
        elif self._tally.running == 1 or not self._tally.done:
            self._live.show(self._tally.text(), self._tally.done)  # else after the outcome of the previous item

    def iteration(self, progress: Progress) -> None:
        """Show the iteration."""
        text = self._line.of(progress)
        if not self._tally.many:
            self._live.show(text, self._tally.done)

    def search(self, step: SearchStep) -> None:
        """Show the step."""
        if not self._tally.many:
            self._live.show(self._line.of_search(step), self._tally.done)

    def end(self, outcome: Outcome) -> None:
        """Print the outcome of an item; for many items only failures."""
        tally = self._tally
        self._flush(outcome.stage)
        tally.end(outcome)
        many = tally.many and outcome.stage == tally.stage
        self._live.show(tally.text() if many else None, tally.done)
        if tally.is_named(outcome) and not self._idle.takes(outcome):
            self._live.say(outcome_line(outcome))
        if many and tally.todo and tally.done == tally.todo:
            self._live.say(tally.text())

    def close(self) -> None:
        """Print what is still to be said."""
        self._flush("")

    def _flush(self, stage: str) -> None:
        if text := self._idle.said(stage):
            self._live.say(text)
