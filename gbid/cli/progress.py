"""Progress on standard error: a bar with remaining time on a terminal, otherwise a few plain lines."""

from __future__ import annotations

import logging
import math
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from gbid.cli.printing import tell
from gbid.core.names import printable
from gbid.experiment.fields import Item
from gbid.experiment.run import Outcome, Reporter

if TYPE_CHECKING:
    from gbid.control.tuning.problem import SearchStep
    from gbid.identify import Progress


MANY = 12
"""Largest number of items for which each has a line of its own in the progress."""


NAMED = 10
"""Largest number of failures of a stage with many items that are printed at once; the end lists all."""


@dataclass
class Tally:
    """Counts of the outcomes of one stage.

    Attributes
    ----------
    stage : str
        Name of the stage.
    todo, kept, before : int
        Numbers of items to make, existing, and failed before.
    done, failed, stuck : int
        Numbers of items that ended, failed, and did not converge.
    """

    stage: str = ""
    todo: int = 0
    kept: int = 0
    before: int = 0
    done: int = 0
    failed: int = 0
    stuck: int = 0
    _running: set[Item] = field(default_factory=set)
    _worst: tuple[float, Item | None] = (math.inf, None)
    _began: float = field(default_factory=time.monotonic)

    @property
    def many(self) -> bool:
        """Whether the stage has many items."""
        return self.todo + self.kept + self.before > MANY

    @property
    def running(self) -> int:
        """Number of items in progress."""
        return len(self._running)

    def begin(self, item: Item) -> None:
        """Count the start of an item; a restart counts only once."""
        if item.stage == self.stage:
            self._running.add(item)

    def end(self, outcome: Outcome) -> None:
        """Count the outcome of an item."""
        if outcome.item.stage != self.stage:
            return
        if outcome.item in self._running:  # existing and failed items and those without input were not started
            self._running.remove(outcome.item)
            self.done += 1
            self.failed += is_first_cause(outcome)  # what is left out for lack of input is told apart
        self.stuck += outcome.state != "failed" and not outcome.converged
        if outcome.fit_percent < self._worst[0]:
            self._worst = outcome.fit_percent, outcome.item

    def is_named(self, outcome: Outcome) -> bool:
        """Return whether an outcome gets a separate line: each outcome of short stages, else the first failures."""
        if not self.many or outcome.item.stage != self.stage:
            return True
        listed = outcome.before or outcome.cause == "input"
        return outcome.state == "failed" and not listed and self.failed <= NAMED

    def opening(self) -> str:
        """Return the numbers of planned, existing and previously failed items as text."""
        counts = ((self.kept, "there"), (self.before, "failed already"))
        return ", ".join([f"{self.stage}: {self.todo} to make", *(f"{n} {word}" for n, word in counts if n)])

    def text(self) -> str:
        """Return the state of the stage as text."""
        counts = ((self.running, "running"), (self.failed, "failed"), (self.stuck, "not converged"))
        parts = [f"{self.stage}: {self.done} of {self.todo} done", *(f"{n} {word}" for n, word in counts if n)]
        passed = time.monotonic() - self._began
        if 0 < self.done < self.todo and passed > 0:
            left = _duration(passed / self.done * (self.todo - self.done))
            parts.append(f"{rate(self.done / passed)}, {left} left")
        if self.done == self.todo:
            parts.append(_duration(passed))
        percent, item = self._worst
        if math.isfinite(percent):
            parts.append(f"worst fit {percent:.1f} % ({item})")
        return ", ".join(parts)


def rate(per_second: float) -> str:
    """Return a number of items per second or per minute as text."""
    number, unit = (per_second, "s") if per_second >= 1 else (60 * per_second, "min")
    return f"{number:.{0 if number >= 10 else 1}f}/{unit}"


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def outcome_line(outcome: Outcome) -> str:
    """Return the outcome of an item as text."""
    took = f" ({outcome.seconds:.1f} s)" if outcome.state == "made" else ""
    state = "failed before" if outcome.before else outcome.state
    why = f": {outcome.text}" if outcome.text else ""
    return f"{outcome.item.stage} {outcome.item}: {state}{took}{why}"


_BAR = 16  # characters


class LiveBar:
    """Progress bar of `rich` on standard error with remaining time and current work, below the finished lines.

    Parameters
    ----------
    console : rich.console.Console, optional
        Console to write to; by default standard error. rich leaves the colours out where NO_COLOR is set.

    Attributes
    ----------
    progress : rich.progress.Progress
        The bar, a context; it is shown while one is in it.
    """

    def __init__(self, console: Any = None) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn
        from rich.table import Column

        text = TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis"))
        columns = (SpinnerColumn(), BarColumn(_BAR), TimeRemainingColumn(compact=True), text)
        console = console or Console(stderr=True, highlight=False)
        self.progress = Progress(*columns, console=console, transient=True)
        self._task = self.progress.add_task("", total=None)

    def begin(self, total: int) -> None:
        """Start a bar with a number of items; without a number it only moves."""
        self.progress.reset(self._task, total=total or None, description="")

    def show(self, text: str, done: int) -> None:
        """Show a text and the number of finished items."""
        self.progress.update(self._task, completed=done, description=printable(text))

    def say(self, text: str) -> None:
        """Print a line above the bar."""
        self.progress.console.print(printable(text), markup=False, soft_wrap=True)


_LISTED = 10  # largest number of failures that are listed one by one; all are in the JSON document
_NOUNS = {"rig": "recording", "import": "recording", "prefilter": "recording", "fit": "model", "figure": "figure"}


def is_first_cause(outcome: Outcome) -> bool:
    """Return whether a result failed itself, not because an input was missing."""
    return outcome.state == "failed" and outcome.cause != "input"


def in_short(failed: Iterable[Outcome]) -> str:
    """Return a text on the first causes of failure, such as ``import of 6 recordings failed``; empty without any."""
    counts = Counter(outcome.item.stage for outcome in failed if is_first_cause(outcome))
    return " and ".join(f"{stage} of {counted(stage, count)} failed" for stage, count in counts.items())


def counted(stage: str, count: int) -> str:
    """Return the number of results of a stage as text."""
    return f"{count} {_NOUNS.get(stage, 'result')}{'s' * (count != 1)}"


def not_made(stage: str, count: int, why: str) -> str:
    """Return a line on results of a stage whose inputs failed or are missing."""
    return f"{stage}: {counted(stage, count)} not made: {why}"


def causes_in_words(failed: Sequence[Outcome], code_of: int, codes: Mapping[str, int]) -> list[str]:
    """Return lines on the first causes of failure; the last line is the first failure with the exit code.

    Results whose inputs failed in the same run are left out: the progress has told of them. Where nothing failed by
    itself, the inputs were missing before, and each stage has a line with the first of its reasons, or
    with the name of its only result.

    Parameters
    ----------
    failed : sequence of Outcome
        Failed outcomes, in the order of the run.
    code_of : int
        Exit code of the command.
    codes : dict of str to int
        Exit code by cause; others are bad data.
    """
    roots = [outcome for outcome in failed if is_first_cause(outcome)]
    if not roots:
        counts = Counter(outcome.item.stage for outcome in failed)
        firsts = {outcome.item.stage: outcome for outcome in reversed(failed)}
        return [
            _line(firsts[stage]) if count == 1 else f"error: {not_made(stage, count, firsts[stage].text)}"
            for stage, count in reversed(counts.items())
        ]
    first = next((o for o in roots if codes.get(o.cause) == code_of), roots[0])
    rest = [outcome for outcome in roots if outcome is not first]
    lines = [_line(outcome) for outcome in rest[:_LISTED]]
    if len(rest) > _LISTED:
        lines.append(f"error: {len(rest) - _LISTED} more failed; `--json` lists all")
    return [*lines, _line(first)]


def _line(outcome: Outcome) -> str:
    word = "defect" if outcome.cause == "defect" else "error"
    again = " (failed in an earlier run; use --retry to try again)" if outcome.before else ""
    return f"{word}: {outcome.item.stage} {outcome.item}: {outcome.text}{again}"


EVERY = 10
"""Iterations between plain lines."""

PAUSE = 10.0
"""Seconds between plain lines of a stage with many items."""

SEARCH_PAUSE = 2.0
"""Seconds between plain lines of a search for gains."""


@contextmanager
def reporting(quiet: bool = False, verbose: bool = False) -> Iterator[Reporter]:
    """Return a context with the progress reporter for standard error.

    Parameters
    ----------
    quiet : bool
        Whether nothing is shown; errors are still told at the end.
    verbose : bool
        Whether each item and each iteration has a line.
    """
    if quiet:
        yield Reporter()
        return
    bar = None if verbose or not sys.stderr.isatty() else LiveBar()
    with bar.progress if bar is not None else nullcontext():
        reporter = ProgressReporter(verbose, bar)
        with _compilations_told(tell if bar is None else bar.say):
            yield reporter
        reporter.close()


@contextmanager
def _compilations_told(say: Callable[[str], None]) -> Iterator[None]:
    """Return a context that reports compilations of this process while it waits for the compiler."""
    handler, process, logger = logging.Handler(), os.getpid(), logging.getLogger("gbid.core.compiled")
    handler.emit = lambda record: say(record.getMessage()) if os.getpid() == process else None  # type: ignore[method-assign]
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)


class ProgressReporter(Reporter):
    """Reporter of a verb: a line per result, or for many results periodic lines and failures; then iterations.

    Parameters
    ----------
    verbose : bool
        Whether each item and each iteration has a line.
    bar : LiveBar, optional
        Bar of a terminal that shows what is being done; without it every tenth iteration is a line.
    """

    def __init__(self, verbose: bool = False, bar: LiveBar | None = None) -> None:
        self._verbose, self._bar, self._say = verbose, bar, tell if bar is None else bar.say
        self._tally, self._said, self._searched = Tally(), 0.0, 0.0
        self._label, self._tries, self._began = "", 0, time.monotonic()  # of the item in progress
        self._failed: list[Outcome] = []
        self._idle: list[Outcome] = []  # of one stage, not made because their input is missing; told in one line

    def expect(self, stage: str, todo: int, there: int, failed: int) -> None:
        """Print the numbers of items when there are many."""
        self._flush(stage)
        self._tally, self._said = Tally(stage, todo, there, failed), time.monotonic()
        if self._bar is not None:
            self._bar.begin(todo)
        if self._tally.many:
            self._say(self._tally.opening())

    def begin(self, item: Item) -> None:
        """Store the item to which the next iterations belong."""
        self._flush(item.stage)
        self._label, self._tries, self._began = f"{item.stage} {item}", 0, time.monotonic()
        self._tally.begin(item)
        self._show(self._label)

    def iteration(self, progress: Progress) -> None:
        """Print every tenth iteration; in a bar show every iteration."""
        self._tries += progress.iteration == 0
        which = f", try {self._tries}" if self._tries > 1 else ""  # from several starts, or with several windows
        step = f", step {progress.sigma:.1g} std" if math.isfinite(progress.sigma) else ""
        where = f"iteration {progress.iteration}, cost {progress.cost:.5g}, gap {progress.gap:.0e}"
        often = progress.iteration and progress.iteration % EVERY == 0 and not self._tally.many
        self._step(f"{self._label}{which}: {where}{step}", bool(often))

    def search(self, step: SearchStep) -> None:
        """Print some steps of the search; in a bar show every step."""
        often = time.monotonic() - self._searched > SEARCH_PAUSE and not self._tally.many
        if often:
            self._searched = time.monotonic()
        excess = f", limits exceeded by {100 * step.violation:.2g} %" if step.violation > 0 else ""
        passed = time.monotonic() - self._began
        pace = f" ({rate(step.count / passed)})" if passed > 1 else ""
        text = f"{self._label}: {step.stage}, {step.count} designs{pace}, best {step.value:.5g}{excess}"
        self._step(text, often)

    def lose(self, items: Sequence[Item], count: int) -> None:
        """Print the items that a lost worker was processing."""
        named = ", ".join(f"{item.stage} {item}" for item in items[:NAMED])
        more = f" and {len(items) - NAMED} more" if len(items) > NAMED else ""
        lost = "a Dask worker was lost" if count == 1 else f"{count} Dask workers were lost"
        self._say(f"{lost}; tried again: {named}{more}")

    def end(self, outcome: Outcome) -> None:
        """Print the outcome of an item; for many items only failures."""
        tally = self._tally
        self._flush(outcome.item.stage)
        tally.end(outcome)
        if outcome.state == "failed":
            self._failed.append(outcome)
        if outcome.state == "failed" and outcome.cause == "input":
            self._idle.append(outcome)
        elif tally.is_named(outcome) or self._verbose:
            self._say(outcome_line(outcome))
        self._show(f"{outcome.item.stage} {outcome.item}")
        if not tally.many or outcome.item.stage != tally.stage or outcome.state == "kept" or not tally.todo:
            return
        now = time.monotonic()
        if tally.done == tally.todo or (self._bar is None and now - self._said > PAUSE):
            self._said = now
            self._say(tally.text())

    def close(self) -> None:
        """Print pending messages."""
        self._flush("")

    def _step(self, text: str, often: bool) -> None:
        if self._bar is None and (often or self._verbose):
            tell(text)
        elif not self._tally.many:
            self._show(text)

    def _show(self, text: str) -> None:
        if self._bar is not None:
            self._bar.show(self._tally.text() if self._tally.many else text, self._tally.done)

    def _flush(self, stage: str) -> None:
        """Report results that could not be computed, when the next stage begins."""
        if self._idle and self._idle[0].item.stage != stage:
            why = in_short(self._failed) or self._idle[0].text
            self._say(not_made(self._idle[0].item.stage, len(self._idle), why))
            self._idle.clear()
