"""Checks of the prefilter section."""

from __future__ import annotations

from gbid.experiment.experiment import Experiment
from gbid.experiment.plan import NO_POINT
from gbid.experiment.problems import Found
from gbid.experiment.stages.loop.plan import answered


def runout_maps_can_be_made(experiment: Experiment) -> Found:
    """Yield a problem for each operating point without a stationary recording, position or angle."""
    section = experiment.spec.prefilter
    if section is None:
        return
    if section.median % 2 == 0:
        yield ("prefilter", "median"), f"{section.median} is even; give an odd size, 1 for no median"
    for planned in experiment.recordings.values():
        if planned.excited and "p" not in planned.signals:
            text = f"recording {planned.name!r} has no signal p, which the prefilter works on"
            yield planned.location, f"{text}; name one so, or remove the section prefilter"
    if section.method == "none":
        return
    still = {q.point for q in experiment.recordings.values() if q.stationary}
    if section.slow_roll is not None:
        if not any(q.stationary for q in experiment.matching(section.slow_roll)):
            yield ("prefilter", "slow_roll"), f"no stationary recording matches {', '.join(section.slow_roll)}"
        still.add(NO_POINT)
    reported: set[str] = set()
    for planned in experiment.recordings.values():
        if planned.excited and not answered(experiment, planned) and planned.point not in still | reported:
            reported.add(planned.point)
            yield (
                ("prefilter",),
                f"no stationary recording at {planned.point} (as {planned.name!r}), so no run-out map; "
                "add one, or write method: none",
            )
