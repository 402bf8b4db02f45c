"""Write the report of an experiment."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gbid.experiment.keys import content_key, stored_key
from gbid.experiment.run.job import Job
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.perform import produce
from gbid.report.html.controller_section import controller_section
from gbid.report.html.fits_section import fits_section
from gbid.report.html.gather import DESIGNS, Gathered
from gbid.report.html.impacts_section import impacts_section
from gbid.report.html.page import Section
from gbid.report.html.pictures import Pictures
from gbid.report.html.quality_section import quality_section
from gbid.report.html.render import render
from gbid.report.html.static_section import static_section
from gbid.report.html.summary_section import not_done, summary_section, warnings
from gbid.report.html.surfaces_section import surfaces_section
from gbid.report.html.validation_section import nominal_section, validation_section

NAME = "report.html"
_FOLDERS = ("static", "crossval", "lpv", "nominal", "impacts", DESIGNS)


def write_report(job: Job, path: Path | None = None) -> Outcome:
    """Write one self-contained HTML file on the results that are there; nothing else is made.

    Parameters
    ----------
    job : Job
    path : path, optional
        ``report.html`` in the folder of the results when not given. A report of an earlier state is replaced, any
        other file only with `Job.overwrite`.

    Returns
    -------
    Outcome

    Raises
    ------
    UsageError
        When another file stands there.
    DataError
        When it cannot be written.
    """
    path = job.experiment.results / NAME if path is None else path
    gathered = Gathered(job)
    key = _key(gathered)
    mine = bool(stored_key(path))
    job = replace(job, overwrite=job.overwrite or mine)

    def write(part: Path) -> None:
        part.write_text(report_text(gathered, key), encoding="utf-8")

    return produce(job, "report", path.name, path, key, write)


def report_text(gathered: Gathered, key: str = "") -> str:
    """Return the report as HTML text."""
    pictures = Pictures()
    controller, designs = controller_section(gathered, pictures)
    found = warnings(gathered, designs)
    middle: list[Section | None] = [
        summary_section(gathered, found),
        quality_section(gathered),
        static_section(gathered, pictures),
        fits_section(gathered),
        validation_section(gathered, pictures),
        nominal_section(gathered, pictures),
        surfaces_section(gathered, pictures),
        controller,
        impacts_section(gathered, pictures),
    ]
    spec = gathered.experiment.spec
    sections = [section for section in middle if section is not None]
    return render(spec.title, spec.name, sections, not_done(gathered, designs), key)


def _key(gathered: Gathered) -> str:
    """Content key: how everything stands, and the keys of the files that are there."""
    experiment = gathered.experiment
    standings = [[f.stage, f.item, f.state, f.text] for f in gathered.standings]
    made = [stored_key(path) for folder in _FOLDERS for path in sorted((experiment.results / folder).glob("*.*"))]
    fits = [stored_key(gathered.job.path("fits", f.item)) for f in gathered.standings if f.stage == "fit"]
    spec = {**experiment.spec.model_dump(mode="json", exclude={"rig", "imported"}), "standings": standings}
    return content_key("report", spec, [*fits, *made])
