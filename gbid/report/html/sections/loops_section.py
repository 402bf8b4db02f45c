"""Section on recordings in closed loop: what the loop costs in precision."""

from __future__ import annotations

from gbid.report.html.page import PageSection, Words
from gbid.report.reader import Results
from gbid.report.tables.loop_tables import loop_documents, loop_tables


def loops_section(results: Results) -> PageSection | None:
    """Return the section with standard deviations in the loop and without; None when no fit stands beside another."""
    fits = results.experiment.spec.fits.values()
    if not any(fit.loop is not None and fit.loop.beside for fit in fits):
        return None
    tables = loop_tables(loop_documents(results.loop_costs))
    if not tables:
        return PageSection("loops", "Loops", [Words("the comparison is not made yet; run `gbid run`", "warn")])
    return PageSection("loops", "Loops", tables)
