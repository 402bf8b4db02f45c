"""Command that one would sensibly give next, from the sections that an experiment has."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from gbid.experiment.experiment import Experiment

_ORDER: Mapping[str, Callable[[Any], object]] = {
    "check": lambda _: True,
    "rig": lambda spec: spec.rig,
    "import": lambda spec: spec.imported,
    "static": lambda spec: spec.static,
    "fit": lambda spec: spec.fits,
    "crossval": lambda spec: spec.crossval,
    "lpv": lambda spec: spec.lpv,
    "excite": lambda spec: spec.excite,
    "tune": lambda spec: spec.controller,
    "impact": lambda spec: spec.impacts,
    "cycle": lambda spec: spec.cycle,
    "report": lambda _: True,
    "export": lambda spec: spec.fits or spec.lpv or spec.controller,
}
"""Verbs in the order of the work, with what an experiment must have for them."""
_LIKE = {"batch": "fit", "run": "report", "figures": "cycle", "reproduce": "cycle"}


def next_step(experiment: Experiment, verb: str) -> str:
    """Return the command that follows a verb; empty after the last one.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    verb : str
        The verb that has just ended well.
    """
    path = experiment.file.path
    if verb == "check":
        return f"gbid run {path}"
    if verb == "run" and experiment.spec.cycle is not None and not experiment.spec.cycle.in_run:
        return f"gbid cycle {path}"
    verbs = list(_ORDER)
    for later in verbs[verbs.index(_LIKE.get(verb, verb)) + 1 :]:
        if _ORDER[later](experiment.spec):
            target = " --to c" if experiment.spec.controller else " --to matlab"
            return f"gbid {later} {path}{target if later == 'export' else ''}"
    return ""
