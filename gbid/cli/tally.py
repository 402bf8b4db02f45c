"""How far a stage with many items is: done, running, failed, time left, worst fit so far."""

from __future__ import annotations

import math
import time

from gbid.experiment.run.outcome import Outcome

MANY = 12
"""With more items than this, progress is a sum and no longer a line for each."""


NAMED = 10
"""So many failures of a stage with many items are told at once; all of them are listed at the end."""


class Tally:
    """Counts the outcomes of one stage.

    Parameters
    ----------
    stage : str
    todo, there, failed : int
        Items to be made, there already, and failed before.
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
        """Number of items that are worked on."""
        return len(self._running)

    def begin(self, stage: str, item: str) -> None:
        """Count an item that work begins on, once however often it is begun."""
        if stage == self.stage:
            self._running.add(item)

    def end(self, outcome: Outcome) -> None:
        """Count what became of an item."""
        if outcome.stage != self.stage:
            return
        if outcome.item in self._running:  # what was there, failed before or has no input is not to be made
            self._running.remove(outcome.item)
            self.done += 1
            self.failed += outcome.state == "failed"
        self.stuck += outcome.state != "failed" and not outcome.converged
        if outcome.fit_percent < self.worst:
            self.worst, self.worst_item = outcome.fit_percent, outcome.item

    def is_named(self, outcome: Outcome) -> bool:
        """Whether an outcome gets a line of its own: the first failures of a stage, or all when it has few items."""
        if not self.many or outcome.stage != self.stage:
            return True
        told = outcome.before or outcome.cause == "input"
        return outcome.state == "failed" and not told and self.failed <= NAMED

    def opening(self) -> str:
        """Say what there is to do."""
        parts = [f"{self.todo} to make"]
        parts += [f"{self.there} there"] if self.there else []
        parts += [f"{self.before} failed already"] if self.before else []
        return f"{self.stage}: {', '.join(parts)}"

    def text(self) -> str:
        """Say how far the stage is."""
        parts = [f"{self.stage}: {self.done} of {self.todo} done"]
        parts += [f"{self.running} running"] if self.running else []
        parts += [f"{self.failed} failed"] if self.failed else []
        parts += [f"{self.stuck} not converged"] if self.stuck else []
        if 0 < self.done < self.todo:
            parts.append(f"{_duration((time.monotonic() - self._began) / self.done * (self.todo - self.done))} left")
        if self.done == self.todo:
            parts.append(_duration(time.monotonic() - self._began))
        if math.isfinite(self.worst):
            parts.append(f"worst fit {self.worst:.1f} % ({self.worst_item})")
        return ", ".join(parts)


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"
