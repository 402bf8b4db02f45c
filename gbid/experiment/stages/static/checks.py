"""Checks of the static sections: their recordings exist and have the signals."""

from __future__ import annotations

from gbid.experiment.experiment import Experiment
from gbid.experiment.problems import Found, Location, nearest
from gbid.experiment.stages.static.schema import wanted_signals

ONLY_FOR = {
    "bearing": ("source",),
    "piezo": ("channel", "command_channel", "settle_s", "limits"),
}
"""Keys that only one of the two kinds has."""


def static_makes_sense(experiment: Experiment) -> Found:
    """Yield problems of recordings and signals, and of keys of the other kind."""
    for name, section in experiment.spec.static.items():
        here: Location = ("static", name)
        chosen = experiment.matching(section.recordings)
        for pattern in section.recordings:
            if not experiment.matching((pattern,)):
                known = nearest(pattern, experiment.recordings)
                yield (*here, "recordings"), f"no recording matches {pattern!r}; {known}"
        if section.kind == "piezo" and len(chosen) > 1:
            names = ", ".join(q.name for q in chosen)
            yield (*here, "recordings"), f"a piezo is characterised from one recording, not {names}; name one"
        for kind, keys in ONLY_FOR.items():
            for key in keys:
                if kind != section.kind and getattr(section, key) is not None:
                    yield (*here, key), f"is for kind: {kind}; leave it out for kind: {section.kind}"
        if section.limits is not None and not section.limits[0] < section.limits[1]:
            yield (*here, "limits"), f"{list(section.limits)}: give the lower end first"
        for planned in chosen:
            for key, signal in wanted_signals(section).items():
                if signal not in planned.signals:
                    there = ", ".join(planned.signals)
                    yield (*here, key), f"recording {planned.name!r} has no signal {signal!r}; it has {there}"
