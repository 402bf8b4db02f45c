"""Progress of a stage with many items: done, running, failed, time left, worst fit so far."""

from __future__ import annotations

import math
import time

from gbid.experiment.run.outcome import Outcome

MANY = 12
"""Largest number of items for which each has a line of its own in the progress."""


NAMED = 10
"""Largest number of failures of a stage with many items that are printed at once; the end lists all."""


class Tally:
    """Counts of the outcomes of one stage.

    Parameters
    ----------
    stage : str
        Name of the stage.
    todo, there, failed : int
        Numbers of items to make, existing, and failed before.
    """

    def __init__(self, stage: str = "", todo: int = 0, there: int = 0, failed: int = 0) -> None:
        self.stage, self.todo, self.there, self.before = stage, todo, there, failed
        self.done = self.failed = self.stuck = 0
        self._running: set[str] = set()
        self.worst, self.worst_item = math.inf, ""
        self._began = time.monotonic()

    @property
    def many(self) -> bool:
        """Whether the stage has many items."""
        return self.todo + self.there + self.before > MANY

    @property
    def running(self) -> int:
        """Number of items in progress."""
        return len(self._running)

    def begin(self, stage: str, item: str) -> None:
        """Count the start of an item, once also when it starts again."""
        if stage == self.stage:
            self._running.add(item)

    def end(self, outcome: Outcome) -> None:
        """Count the outcome of an item."""
        if outcome.stage != self.stage:
            return
        if outcome.item in self._running:  # existing and failed items and those without input were not started
            self._running.remove(outcome.item)
            self.done += 1
            self.failed += outcome.state == "failed"
        self.stuck += outcome.state != "failed" and not outcome.converged
        if outcome.fit_percent < self.worst:
            self.worst, self.worst_item = outcome.fit_percent, outcome.item

    def is_named(self, outcome: Outcome) -> bool:
        """Return whether an outcome gets its own line: the first failures of a stage, or all when it has few items."""
        if not self.many or outcome.stage != self.stage:
            return True
        listed = outcome.before or outcome.cause == "input"
        return outcome.state == "failed" and not listed and self.failed <= NAMED

    def opening(self) -> str:
        """Return the numbers of items to make, existing, and failed before, as text."""
        parts = [f"{self.todo} to make"]
        parts += [f"{self.there} there"] if self.there else []
        parts += [f"{self.before} failed already"] if self.before else []
        return f"{self.stage}: {', '.join(parts)}"

    def pace(self) -> str:
        """Return the rate and the time left as text; empty before the first item is done."""
        passed = time.monotonic() - self._began
        if not 0 < self.done < self.todo or passed <= 0:
            return ""
        return f"{rate(self.done / passed)}, {_duration(passed / self.done * (self.todo - self.done))} left"

    def text(self) -> str:
        """Return the state of the stage as text."""
        parts = [f"{self.stage}: {self.done} of {self.todo} done"]
        parts += [f"{self.running} running"] if self.running else []
        parts += [f"{self.failed} failed"] if self.failed else []
        parts += [f"{self.stuck} not converged"] if self.stuck else []
        if 0 < self.done < self.todo:
            parts.append(self.pace())
        if self.done == self.todo:
            parts.append(_duration(time.monotonic() - self._began))
        if math.isfinite(self.worst):
            parts.append(f"worst fit {self.worst:.1f} % ({self.worst_item})")
        return ", ".join(parts)


def rate(per_second: float) -> str:
    """Return a number of items in a second or a minute as text."""
    number, unit = (per_second, "s") if per_second >= 1 else (60 * per_second, "min")
    return f"{number:.{0 if number >= 10 else 1}f}/{unit}"


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"
