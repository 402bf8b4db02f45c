"""Manner of a verb: how much it says, and whether it does anything."""

from __future__ import annotations

from dataclasses import dataclass

from gbid.cli.next_step import next_step
from gbid.experiment.experiment import Experiment


@dataclass(frozen=True)
class Manner:
    """Options of a verb that do not change its results.

    Attributes
    ----------
    verb : str
        Name of the verb.
    as_json : bool
        Whether the results are printed as one JSON document.
    quiet, verbose : bool
        Whether there is no progress and no advice, or a line for each item and iteration.
    dry_run : bool
        Whether it only says what would be made.
    """

    verb: str
    as_json: bool = False
    quiet: bool = False
    verbose: bool = False
    dry_run: bool = False

    def advice(self, experiment: Experiment) -> str:
        """Return the command that one would sensibly give next; empty when nothing is to be said."""
        return "" if self.quiet else next_step(experiment, self.verb)
