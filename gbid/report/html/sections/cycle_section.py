"""Section on the identification-for-control cycle: its rounds."""

from __future__ import annotations

from gbid.report.html.page import PageSection, Words
from gbid.report.reader import Results
from gbid.report.tables.loop_tables import cycle_documents, cycle_summary

_INCOMPLETE = "the cycle is not complete; run `gbid cycle` or `gbid run`"


def cycle_section(results: Results) -> PageSection | None:
    """Return the section with the rounds of the cycle; None when the experiment has none."""
    if results.experiment.spec.cycle is None:
        return None
    rows = results.cycle
    if not rows:
        asked = not results.experiment.spec.cycle.in_run
        text = "`gbid cycle` runs the rounds; `gbid run` leaves them out" if asked else _INCOMPLETE
        return PageSection("cycle", "Cycle", [Words(text, "" if asked else "warn")])
    return PageSection("cycle", "Cycle", [cycle_summary(cycle_documents(rows))])
