"""Summary at the top of the page: warnings, numbers of results, and parts that were not done."""

from __future__ import annotations

from collections import Counter

from gbid.errors import GbidError
from gbid.report.html.page import Block, Link, Listed, PageSection, Words
from gbid.report.html.sections.fits_section import lost_fits
from gbid.report.html.sections.surfaces_section import LACK
from gbid.report.html.sections.tuned_blocks import held_back
from gbid.report.reader import Results
from gbid.tables.table import Column, Entry, Table

_STAGES = {"rig": "recordings", "import": "recordings", "prefilter": "prefiltered", "fit": "fits"}


def warnings(results: Results) -> list[Link]:
    """Return the warnings of all results, each with a link to its section."""
    found = [
        Link(f"{f.stage} {f.item}: {f.text}", "#data")
        for f in results.standings
        if f.stage != "fit" and f.state == "failed"
    ]
    lost = Counter(f.state for f in lost_fits(results))
    found += [Link(f"{n} {_fits(n)} {_LOST[state]}", "#fits") for state, n in lost.items()]
    problems = sum(len(q.problems) for q in results.recordings)
    if problems:
        found.append(Link(f"{problems} problems in the signals of the recordings", "#data"))
    stuck = sum(not q.result.success for q in results.fits)
    if stuck:
        found.append(Link(f"{stuck} {_fits(stuck)} did not converge", "#fits"))
    for name, (rows, summary) in results.crossval.items():
        missed = sum(row.missed for row in rows)
        if missed:
            found.append(Link(f"{name}: {missed} validations below the minimum asked for", "#validation"))
        coloured = sum(row.residuals_white is False for row in rows)
        if coloured:
            tested = sum(row.residuals_white is not None for row in rows)
            found.append(Link(f"{name}: residuals of {coloured} of {tested} validations are not white", "#validation"))
        found += [Link(f"{name}: {text}", "#validation") for text in summary.failed]
    for name in results.experiment.spec.crossval:
        if name not in results.crossval:
            found.append(Link(f"{name}: not validated with the present fits", "#validation"))
    if results.experiment.spec.nominal is not None:
        found += _of_nominal(results)
    if results.experiment.spec.lpv is not None and not results.surfaces:
        found.append(Link("no surfaces were drawn with the present fits", "#surfaces"))
    for item, fit in results.surfaces.items():
        if (fit.lack_of_fit < LACK).any():
            found.append(Link(f"surfaces {item} miss the means of some parameters by more than chance", "#surfaces"))
        if not fit.success:
            found.append(Link(f"surfaces {item}: {fit.status}", "#surfaces"))
        if fit.outliers:
            found.append(Link(f"surfaces {item}: far off lie {len(fit.outliers)} of the estimates", "#surfaces"))
    for design in results.assessed:
        found += [Link(f"controller {design.name}: {text}", "#controller") for text in design.warnings()]
    found += [Link(f"controller {name}: {text}", "#controller") for name, text in results.designs.missing.items()]
    for name, made in results.designs.found.items():
        found += [Link(f"controller {name}: {text}", "#controller") for text in held_back(made)]
    return found


def _of_nominal(results: Results) -> list[Link]:
    try:
        outliers = results.nominal.outliers
    except GbidError as error:
        return [Link(f"no nominal actuator: {error}", "#actuator")]
    return [Link(f"{len(outliers)} actuator parameters lie off the others", "#actuator")] if outliers else []


_LOST = {"failed": "failed", "missing": "not made yet", "stale": "made with other settings or data"}


def _fits(n: int) -> str:
    return "fit" if n == 1 else "fits"


def summary_section(results: Results, found: list[Link]) -> PageSection:
    """Return the section with warnings first, then the numbers of results."""
    blocks: list[Block] = []
    if found:
        blocks += [Words(f"{len(found)} {'thing' if len(found) == 1 else 'things'} to look at:", "warn"), Listed(found)]
    else:
        blocks.append(Words("Nothing to warn of.", "good"))
    counts: dict[str, Counter[str]] = {}
    for f in results.standings:
        counts.setdefault(_STAGES[f.stage], Counter())[f.state] += 1
    states = ("there", "failed", "missing", "stale")
    rows: list[tuple[Entry, ...]] = [(stage, *(count[state] for state in states)) for stage, count in counts.items()]
    heads = ("there", "failed", "not made", "of other settings")
    blocks.append(Table("Results", [Column("stage"), *(Column(head, format="d") for head in heads)], rows))
    return PageSection("summary", "At a glance", blocks)


def not_done(results: Results) -> list[str]:
    """Return the parts of the method that the experiment does not use."""
    spec = results.experiment.spec
    missing = [
        ("prefilter", spec.prefilter is not None, "run-out, offset and spikes were not removed from the recordings"),
        ("static", bool(spec.static), "no static characterisation from staircases"),
        ("crossval", bool(spec.crossval), "no model was validated on recordings to which it was not fitted"),
        ("nominal", spec.nominal is not None, "no nominal actuator was chosen"),
        ("lpv", spec.lpv is not None, "no surfaces over pressure and speed"),
    ]
    texts = [f"{text} (no section {name})" for name, there, text in missing if not there]
    if not results.designs.found:
        texts.append("no controller was designed")
    if not results.assessed:
        texts.append("no controller was assessed")
    return texts
