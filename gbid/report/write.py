"""Report of an experiment, and comparison of models, as HTML pages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from gbid.experiment.fields import Item, Result, content_key, stored_key
from gbid.experiment.run import Job, Outcome, produce
from gbid.identify.start.black_box import SubspaceOrders
from gbid.report.control_sections import (
    controller_section,
    cycle_section,
    impacts_section,
    loops_section,
)
from gbid.report.page import Block, Fold, PageSection, Pictures, Shown, render
from gbid.report.pictures import drawn, plot
from gbid.report.read import REPORT, Results, made_keys, report_key
from gbid.report.sections import (
    Cache,
    curves_script,
    drawn_once,
    fits_section,
    nominal_section,
    not_done,
    origin_section,
    quality_section,
    static_section,
    summary_section,
    surfaces_section,
    validation_section,
    warnings,
    with_curves,
)
from gbid.validate import ModelComparison


def write_report(job: Job, path: Path | None = None) -> Outcome:
    """Write one self-contained HTML file with the stored results; nothing else is computed.

    Parameters
    ----------
    job : Job
        The job.
    path : path, optional
        The file; by default ``report.html`` in the folder of the results. A report of an earlier state is replaced, any
        other file only with `Job.overwrite`.

    Returns
    -------
    Outcome
        Outcome of the file.

    Raises
    ------
    UsageError
        When the file exists and is not a report.
    DataError
        When the file cannot be written.
    """
    path = job.experiment.results / REPORT if path is None else path
    results = Results(job)
    key = report_key(results)
    has_key = bool(stored_key(path))
    job = replace(job, overwrite=job.overwrite or has_key)

    def write(part: Path) -> None:
        part.write_text(report_text(results, key, f"{path.stem}_curves"), encoding="utf-8")

    return produce(job, Result(Item("report", path.name), path, key), write)


def write_curves(job: Job, report: Path) -> list[Outcome]:
    """Write the curves that are not in the report to a folder next to it; unchanged files stay.

    Parameters
    ----------
    job : Job
        The job.
    report : path
        File of the report.

    Returns
    -------
    list of Outcome
        Outcome of each file: a script that the report loads when a reader asks for the fit.
    """
    results, outcomes = Results(job), []
    in_page = set(with_curves(results))
    for q in (q for q in results.fits if q.name not in in_page):
        path = report.with_name(f"{report.stem}_curves") / q.fit / f"{q.model}.js"
        shown = results.experiment.spec.figures.get(q.fit)
        sources = [stored_key(job.path("fits", q.fit, q.model))]
        key = content_key("curves", {"from_s": shown.from_s if shown else None}, sources)
        curves_job = replace(job, overwrite=job.overwrite or bool(stored_key(path)))
        text = partial(curves_script, results, q.name, key)
        outcomes.append(
            produce(curves_job, Result(Item("curves", q.fit, q.model), path, key), partial(_write_text, text))
        )
    return outcomes


def _write_text(text_of: Callable[[], str], part: Path) -> None:
    part.write_text(text_of(), encoding="utf-8")


_LATE = (static_section, surfaces_section, controller_section, impacts_section)


def report_text(results: Results, key: str = "", beside: str = "report_curves", cache: Cache | None = None) -> str:
    """Return the report as HTML text.

    Parameters
    ----------
    results : Results
        What is shown.
    key : str
        Content key of the report.
    beside : str
        Folder of the curves that the page does not have.
    kept : dict, optional
        Parts of the page before, which are used again where what they stand on is the same; updated.
    """
    pictures, cache = Pictures(), {} if cache is None else cache
    static, surfaces, controller, impacts = _late_sections(results, cache)
    middle: list[PageSection | None] = [
        summary_section(results, warnings(results), pictures),
        quality_section(results),
        static,
        fits_section(results, pictures, beside, cache),
        loops_section(results),
        validation_section(results, pictures),
        nominal_section(results, pictures),
        surfaces,
        controller,
        impacts,
        cycle_section(results, pictures),
        origin_section(results),
    ]
    spec = results.experiment.spec
    sections = [section for section in middle if section is not None]
    return render(spec.title, spec.name, sections, not_done(results), key)


def _late_sections(results: Results, cache: Cache) -> list[PageSection | None]:
    """Return the sections with slow pictures; a campaign computes their results after the fits."""
    lacking = (results.statics, results.designs, results.studies)
    reasons = [item for stage in lacking for item in stage.missing.items()]
    stand = (results.experiment, *made_keys(results), *results.designs.complete, *results.surfaces, *reasons)
    pictures = Pictures("late")
    sections: list[PageSection | None] = drawn_once(
        cache, "late", stand, lambda: [section(results, pictures) for section in _LATE]
    )
    return sections


def comparison_text(comparison: ModelComparison, orders: SubspaceOrders | None = None) -> str:
    """Return a comparison of models as an HTML page: table, frequency responses, and choice of the order."""
    pictures = Pictures()
    shown = [Shown(pictures.picture(drawn(figure), figure.caption)) for figure in comparison.figures()]
    blocks: list[Block] = [comparison.table(), *shown]
    if orders is not None:
        caption = f"Singular values, and errors on samples that were not used, by order; chosen: {orders.order}"
        blocks += [
            Shown(pictures.picture(plot(orders), caption)),
            Fold("Orders of the subspace model", [orders.table()]),
        ]
    section = PageSection("comparison", f"Models on {', '.join(comparison.recordings)}", blocks)
    return render("Comparison of models", "", [section], [], "")
