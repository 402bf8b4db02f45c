"""What an experiment means together: each check is a small function that gives the problems it finds."""

from __future__ import annotations

from collections import Counter

from gbid.experiment.experiment import Check, Experiment
from gbid.experiment.plan import planned_recordings
from gbid.experiment.problems import Found, Location
from gbid.experiment.stages.crossval.checks import crossval_has_partners
from gbid.experiment.stages.figures.checks import figures_show_fits
from gbid.experiment.stages.fit.checks import FIT_CHECKS
from gbid.experiment.stages.fit.option_checks import OPTION_CHECKS
from gbid.experiment.stages.impact.checks import impacts_can_be_made
from gbid.experiment.stages.importing.checks import data_can_be_read
from gbid.experiment.stages.lpv.checks import surfaces_can_be_drawn
from gbid.experiment.stages.nominal.checks import nominal_is_an_actuator
from gbid.experiment.stages.prefilter.checks import runout_maps_can_be_made
from gbid.experiment.stages.rig.checks import RIG_CHECKS
from gbid.experiment.stages.static.checks import static_makes_sense
from gbid.experiment.stages.tune.checks import designs_can_be_tuned


def find_experiment_problems(experiment: Experiment) -> list[tuple[Location, str]]:
    """Run all checks; one that needs what another found missing stays silent.

    Returns
    -------
    list of (location, text)
        Where in the YAML, and what is wrong; each once.
    """
    found: list[tuple[Location, str]] = []
    for check in CHECKS:
        found += check(experiment)
    return list(dict.fromkeys(found))


def has_recordings(experiment: Experiment) -> Found:
    """There is something to work on."""
    spec = experiment.spec
    if spec.rig is None and spec.imported is None:
        yield (), "no recordings: add a rig section (virtual rig) or an import section (files of your own)"
    elif spec.rig is not None and not (experiment.recordings or spec.impacts or spec.controller):
        yield ("rig",), "makes no recordings; set recordings of prbs or stationary to at least 1"


def names_are_unique(experiment: Experiment) -> Found:
    """No two recordings share a name."""
    planned = list(planned_recordings(experiment.spec, experiment.imports.files))
    counts = Counter(q.name for q in planned)
    seen: set[str] = set()
    rig = experiment.spec.rig
    points = [(q.pressure_bar, q.speed_rpm) for q in rig.operating_points] if rig else []
    twice: dict[Location, int] = {
        ("rig", "operating_points", i): points.index(point) for i, point in enumerate(points) if points.index(point) < i
    }
    for here, first in twice.items():
        yield here, f"the same operating point as operating_points[{first}]; delete one of the two"
    for q in planned:
        if q.location in twice:
            continue  # told above, once for all recordings of the point
        if counts[q.name] > 1 and q.name in seen:
            where = (*q.location, "name") if q.imported and "recordings" in q.location else q.location
            yield where, f"a second recording named {q.name!r}; each needs a name (or operating point) of its own"
        seen.add(q.name)


CHECKS: tuple[Check, ...] = (
    has_recordings,
    names_are_unique,
    *RIG_CHECKS,
    data_can_be_read,
    runout_maps_can_be_made,
    static_makes_sense,
    *FIT_CHECKS,
    *OPTION_CHECKS,
    crossval_has_partners,
    nominal_is_an_actuator,
    surfaces_can_be_drawn,
    designs_can_be_tuned,
    impacts_can_be_made,
    figures_show_fits,
)
"""All checks, in the order of the file's sections."""
