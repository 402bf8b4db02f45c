"""Present results of an experiment, read anew when they change."""

from __future__ import annotations

import threading
from collections import Counter
from pathlib import Path
from typing import Any

from gbid.errors import UsageError
from gbid.experiment.load import load_experiment
from gbid.experiment.run.job import Job
from gbid.report.html.report_file import report_key, report_text
from gbid.report.reader import Results
from gbid.report.reader.designs import AssessedDesign


class Live:
    """Pages of one experiment, for several threads of a server.

    Parameters
    ----------
    experiment : path
        The experiment YAML; it is read again with each page.
    results : path, optional
        Folder of the results, instead of the one in the YAML.

    Raises
    ------
    UsageError
        When the YAML has problems.
    """

    def __init__(self, experiment: Path, results: Path | None = None) -> None:
        self._where = experiment, results
        self._lock = threading.Lock()  # matplotlib draws in one thread at a time
        self._page: tuple[str, str] = ("", "")
        self._designs: tuple[str, dict[str, AssessedDesign]] = ("", {})
        self.name = self._read().experiment.spec.name

    def _read(self) -> Results:
        return Results(Job(load_experiment(*self._where)))

    def state(self) -> dict[str, Any]:
        """Return how far the campaign is: the key of the present results, and counts of results by stage and state."""
        with self._lock:
            results = self._read()
            stages: dict[str, Counter[str]] = {}
            for standing in results.standings:
                stages.setdefault(standing.stage, Counter())[standing.state] += 1
            return {"key": report_key(results), "stages": {stage: dict(count) for stage, count in stages.items()}}

    def page(self) -> str:
        """Return the report of the present results; drawn anew only when they changed."""
        with self._lock:
            results = self._read()
            key = report_key(results)
            if self._page[0] != key:
                self._page = key, report_text(results, key)
            return self._page[1]

    def designs(self) -> dict[str, AssessedDesign]:
        """Return the designs by name: the tuned ones and the published controllers.

        Raises
        ------
        UsageError
            When there is no design.
        """
        with self._lock:
            results = self._read()
            key = report_key(results)
            if self._designs[0] != key:
                self._designs = key, {design.name: design for design in results.assessed}
            if not self._designs[1]:
                raise UsageError("no controller yet; run `gbid tune` or `gbid run`")
            return self._designs[1]

    def known_designs(self) -> dict[str, AssessedDesign]:
        """Return the designs as the explorer last read them: a slider asks often, and reading takes time."""
        return self._designs[1] or self.designs()
