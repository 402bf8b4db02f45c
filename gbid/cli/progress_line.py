"""Lines of progress in words: an iteration of a fit, a step of a search, the outcome of an item."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

from gbid.cli.tally import rate
from gbid.experiment.run.outcome import Outcome

if TYPE_CHECKING:
    from gbid.control.tuning.search.step import SearchStep
    from gbid.identify import Progress


class ProgressLine:
    """Progress of one item; a fit may be tried from several starts or with several windows.

    Parameters
    ----------
    label : str
        Name of the item.
    """

    def __init__(self, label: str = "") -> None:
        self.label, self._tries, self._began = label, 0, time.monotonic()

    def of(self, progress: Progress) -> str:
        """Return iteration, cost and step of the solver as text."""
        self._tries += progress.iteration == 0
        which = f", try {self._tries}" if self._tries > 1 else ""
        step = f", step {progress.sigma:.1g} std" if math.isfinite(progress.sigma) else ""
        where = f"iteration {progress.iteration}, cost {progress.cost:.5g}, gap {progress.gap:.0e}"
        return f"{self.label}{which}: {where}{step}"

    def of_search(self, step: SearchStep) -> str:
        """Return stage, evaluations and best value of a search for gains as text."""
        excess = f", limits exceeded by {100 * step.violation:.2g} %" if step.violation > 0 else ""
        passed = time.monotonic() - self._began
        pace = f" ({rate(step.count / passed)})" if passed > 1 else ""
        return f"{self.label}: {step.stage}, {step.count} designs{pace}, best {step.value:.5g}{excess}"


def outcome_line(outcome: Outcome) -> str:
    """Return the outcome of an item as text."""
    took = f" ({outcome.seconds:.1f} s)" if outcome.state == "made" else ""
    state = "failed before" if outcome.before else outcome.state
    why = f": {outcome.text}" if outcome.text else ""
    return f"{outcome.stage} {outcome.item}: {state}{took}{why}"
