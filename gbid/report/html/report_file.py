"""Report of an experiment as a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gbid.errors import DataError, UsageError
from gbid.experiment.keys import content_key, stored_key
from gbid.experiment.run.job import Job
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.perform import produce
from gbid.report.figures.named import named_figures
from gbid.report.html.page import PageSection, Shown, Words
from gbid.report.html.pictures import Pictures
from gbid.report.html.render import render
from gbid.report.html.sections.controller_section import controller_section
from gbid.report.html.sections.cycle_section import cycle_section
from gbid.report.html.sections.fits_section import fits_section
from gbid.report.html.sections.impacts_section import impacts_section
from gbid.report.html.sections.loops_section import loops_section
from gbid.report.html.sections.quality_section import quality_section
from gbid.report.html.sections.static_section import static_section
from gbid.report.html.sections.summary_section import not_done, summary_section, warnings
from gbid.report.html.sections.surfaces_section import surfaces_section
from gbid.report.html.sections.validation_section import nominal_section, validation_section
from gbid.report.reader import Results

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

    return produce(job, "report", path.name, path, key, write)


def report_text(results: Results, key: str = "") -> str:
    """Return the report as HTML text."""
    pictures = Pictures()
    found = warnings(results)
    middle: list[PageSection | None] = [
        summary_section(results, found),
        quality_section(results),
        static_section(results, pictures),
        fits_section(results),
        loops_section(results),
        validation_section(results, pictures),
        nominal_section(results, pictures),
        surfaces_section(results, pictures),
        controller_section(results, pictures),
        impacts_section(results, pictures),
        cycle_section(results),
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
