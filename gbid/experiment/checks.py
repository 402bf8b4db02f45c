"""Checks of an experiment across its sections: each check is a function that yields the problems it finds."""

from __future__ import annotations

from collections import Counter

from gbid.experiment.experiment import Experiment
from gbid.experiment.plan import planned_recordings
from gbid.experiment.problems import Found, Location
from gbid.experiment.stages import registry


def find_experiment_problems(experiment: Experiment) -> list[tuple[Location, str]]:
    """Return the problems that all checks find.

    A check stays silent about values that another check reports as missing.

    Returns
    -------
    list of (location, text)
        Location in the YAML and text of each problem, without duplicates.
    """
    found: list[tuple[Location, str]] = []
    checks = [check for stage in registry.STAGES for check in stage.checks]
    for check in (has_recordings, names_are_unique, *checks):
        found += check(experiment)
    return list(dict.fromkeys(found))


def has_recordings(experiment: Experiment) -> Found:
    """Yield a problem when the experiment has no recordings."""
    spec = experiment.spec
    if spec.rig is None and spec.imported is None:
        yield (), "no recordings: add a rig section (virtual rig) or an import section (files of your own)"
    elif spec.rig is not None and not (experiment.recordings or spec.impacts or spec.controller):
        yield ("rig",), "makes no recordings; set recordings of prbs or stationary to at least 1"


def names_are_unique(experiment: Experiment) -> Found:
    """Yield a problem for each recording whose name another recording has already."""
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
            continue  # reported above, once for all recordings of the point
        if counts[q.name] > 1 and q.name in seen:
            where = (*q.location, "name") if q.imported and "recordings" in q.location else q.location
            yield where, f"a second recording named {q.name!r}; each needs a name (or operating point) of its own"
        seen.add(q.name)
