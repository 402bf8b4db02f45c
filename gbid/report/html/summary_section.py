"""The top of the page: what to worry about, what there is, what was not done."""

from __future__ import annotations

from collections import Counter

from gbid.report.html.controller_section import Design
from gbid.report.html.explorer import PEAK_SENSITIVITY
from gbid.report.html.fits_section import lost_fits
from gbid.report.html.gather import Gathered
from gbid.report.html.page import Block, Link, Listed, Section, Table, Words
from gbid.report.html.surfaces_section import LACK
from gbid.report.html.tuned_blocks import held_back
from gbid.validate import NominalActuator

KEPT = 0.8
"""Share of its damping that a design should keep when it is sampled."""
_STAGES = {"rig": "recordings", "import": "recordings", "prefilter": "prefiltered", "fit": "fits"}


def warnings(gathered: Gathered, designs: list[Design]) -> list[Link]:
    """List what a reader should know before trusting anything, each with where to look."""
    found = [
        Link(f"{f.stage} {f.item}: {f.text}", "#data")
        for f in gathered.standings
        if f.stage != "fit" and f.state == "failed"
    ]
    lost = Counter(f.state for f in lost_fits(gathered))
    found += [Link(f"{n} {_fits(n)} {_LOST[state]}", "#fits") for state, n in lost.items()]
    problems = sum(len(q.problems) for q in gathered.recordings)
    if problems:
        found.append(Link(f"{problems} problems in the signals of the recordings", "#data"))
    stuck = sum(not q.result.success for q in gathered.fits)
    if stuck:
        found.append(Link(f"{stuck} {_fits(stuck)} did not converge", "#fits"))
    for name, (rows, summary) in gathered.crossval.items():
        missed = sum(row.missed for row in rows)
        if missed:
            found.append(Link(f"{name}: {missed} validations below the minimum asked for", "#validation"))
        coloured = sum(row.residuals_white is False for row in rows)
        if coloured:
            tested = sum(row.residuals_white is not None for row in rows)
            found.append(Link(f"{name}: residuals of {coloured} of {tested} validations are not white", "#validation"))
        found += [Link(f"{name}: {text}", "#validation") for text in summary.failed]
    for name in gathered.experiment.spec.crossval:
        if name not in gathered.crossval:
            found.append(Link(f"{name}: not validated with the present fits", "#validation"))
    if isinstance(gathered.nominal, str):
        found.append(Link(f"no nominal actuator: {gathered.nominal}", "#actuator"))
    if isinstance(gathered.nominal, NominalActuator) and gathered.nominal.outliers:
        found.append(Link(f"{len(gathered.nominal.outliers)} actuator parameters lie off the others", "#actuator"))
    if gathered.experiment.spec.lpv is not None and not gathered.surfaces:
        found.append(Link("no surfaces were drawn with the present fits", "#surfaces"))
    for item, fit in gathered.surfaces.items():
        if (fit.lack_of_fit < LACK).any():
            found.append(Link(f"surfaces {item} miss the means of some parameters by more than chance", "#surfaces"))
        if not fit.success:
            found.append(Link(f"surfaces {item}: {fit.status}", "#surfaces"))
        if fit.outliers:
            found.append(Link(f"surfaces {item}: far off lie {len(fit.outliers)} of the estimates", "#surfaces"))
    for design in designs:
        found += _of_design(design)
    tuned, missing = gathered.tuned
    found += [Link(f"controller {name}: {text}", "#controller") for name, text in missing.items()]
    for name, made in tuned.items():
        found += [Link(f"controller {name}: {text}", "#controller") for text in held_back(made)]
    return found


def _of_design(design: Design) -> list[Link]:
    worst, found = design.assessment.worst, []
    if not design.assessment.stable:
        found.append(Link(f"controller {design.name}: not stable at every operating point", "#controller"))
        return found
    if not all(q.sampled_stable for q in design.assessment.points):
        found.append(Link(f"controller {design.name}: not stable everywhere as it runs, sampled", "#controller"))
    continuous, sampled = worst["damping"][0], worst["sampled_damping"][0]
    if sampled < KEPT * continuous:
        text = f"controller {design.name}: as it runs, sampled, its smallest damping factor is {sampled:.3f}"
        found.append(Link(f"{text}, not {continuous:.3f}", "#controller"))
    peak = worst["peak_output"][0]
    if peak > PEAK_SENSITIVITY * (1 + 1e-4):
        found.append(
            Link(f"controller {design.name}: peak of S_o {peak:.3f}, above {PEAK_SENSITIVITY:g}", "#controller")
        )
    if any(q.exceeds_travel for q in design.assessment.points):
        found.append(
            Link(f"controller {design.name}: the reference impact asks for more travel than a stack has", "#controller")
        )
    return found


_LOST = {"failed": "failed", "missing": "not made yet", "stale": "made with other settings or data"}


def _fits(n: int) -> str:
    return "fit" if n == 1 else "fits"


def summary_section(gathered: Gathered, found: list[Link]) -> Section:
    """Warnings first, then what there is."""
    blocks: list[Block] = []
    if found:
        blocks += [Words(f"{len(found)} {'thing' if len(found) == 1 else 'things'} to look at:", "warn"), Listed(found)]
    else:
        blocks.append(Words("Nothing to warn of.", "good"))
    counts: dict[str, Counter[str]] = {}
    for f in gathered.standings:
        counts.setdefault(_STAGES[f.stage], Counter())[f.state] += 1
    states = ("there", "failed", "missing", "stale")
    rows = [(stage, *(str(count[state]) for state in states)) for stage, count in counts.items()]
    blocks.append(Table("Results", ("stage", "there", "failed", "not made", "of other settings"), rows))
    return Section("summary", "At a glance", blocks)


def not_done(gathered: Gathered, designs: list[Design]) -> list[str]:
    """Say which parts of the method this experiment leaves out."""
    spec = gathered.experiment.spec
    missing = [
        ("prefilter", spec.prefilter is not None, "no run-out, offset or spike was taken out of the recordings"),
        ("static", bool(spec.static), "no static characterisation from staircases"),
        ("crossval", bool(spec.crossval), "no model was put to recordings that it was not fitted to"),
        ("nominal", spec.nominal is not None, "no nominal actuator was chosen"),
        ("lpv", spec.lpv is not None, "no surfaces over pressure and speed"),
    ]
    texts = [f"{text} (no section {name})" for name, there, text in missing if not there]
    if not gathered.designs[0]:
        texts.append("no controller was designed")
    if not designs:
        texts.append("no controller was looked at")
    return texts
