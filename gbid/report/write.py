"""Report of an experiment as a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gbid.core.errors import DataError, UsageError
from gbid.experiment.fields import Result, content_key, stored_key
from gbid.experiment.run import Job, Outcome, produce
from gbid.report.control_sections import (
    controller_section,
    cycle_section,
    impacts_section,
    loops_section,
    surfaces_section,
)
from gbid.report.named import named_figures
from gbid.report.page import PageSection, Pictures, Shown, Words, render
from gbid.report.read import Results
from gbid.report.sections import (
    fits_section,
    nominal_section,
    not_done,
    origin_section,
    quality_section,
    static_section,
    summary_section,
    validation_section,
    warnings,
)

NAME = "report.html"
_FOLDERS = ("static", "crossval", "lpv", "nominal", "impacts", "controller", "cycle", "loops")


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
    path = job.experiment.results / NAME if path is None else path
    results = Results(job)
    key = report_key(results)
    mine = bool(stored_key(path))
    job = replace(job, overwrite=job.overwrite or mine)

    def write(part: Path) -> None:
        part.write_text(report_text(results, key), encoding="utf-8")

    return produce(job, Result("report", path.name, path, key), write)


def report_text(results: Results, key: str = "") -> str:
    """Return the report as HTML text."""
    pictures = Pictures()
    links = warnings(results)
    middle: list[PageSection | None] = [
        summary_section(results, links),
        quality_section(results),
        static_section(results, pictures),
        fits_section(results, pictures),
        loops_section(results),
        validation_section(results, pictures),
        nominal_section(results, pictures),
        surfaces_section(results, pictures),
        controller_section(results, pictures),
        impacts_section(results, pictures),
        cycle_section(results),
        origin_section(results),
    ]
    spec = results.experiment.spec
    sections = [_with_named(section, results, pictures) for section in middle if section is not None]
    return render(spec.title, spec.name, sections, not_done(results), key)


def _with_named(section: PageSection, results: Results, pictures: Pictures) -> PageSection:
    """Return a section with the figures appended that name it."""
    blocks = list(section.blocks)
    for figure in named_figures().values():
        if figure.section == section.id:
            try:
                blocks.append(Shown(pictures.picture(figure.make(results), figure.words)))
            except (DataError, UsageError) as error:
                blocks.append(Words(f"{figure.words}: {error}", "warn"))
    return replace(section, blocks=blocks)


def report_key(results: Results) -> str:
    """Return the content key of the report: the states of all results and the keys of their files."""
    experiment = results.experiment
    standings = [[f.stage, f.item, f.state, f.text] for f in results.standings]
    made = [stored_key(path) for folder in _FOLDERS for path in sorted((experiment.results / folder).glob("*.*"))]
    fits = [stored_key(results.job.path("fits", f.item)) for f in results.standings if f.stage == "fit"]
    spec = {**experiment.spec.model_dump(mode="json", exclude={"rig", "imported"}), "standings": standings}
    return content_key("report", spec, [*fits, *made])
