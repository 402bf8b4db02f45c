"""Checks of the crossval section: its fits and the recordings for validation exist."""

from __future__ import annotations

from gbid.experiment.experiment import Experiment
from gbid.experiment.problems import Found, nearest
from gbid.experiment.stages.crossval.plan import SPECIAL, validation_pairs


def crossval_has_partners(experiment: Experiment) -> Found:
    """Yield a problem for each cross-validation without a fit or without recordings."""
    for name, section in experiment.spec.crossval.items():
        if name not in experiment.spec.fits:
            yield ("crossval", name), f"no fit of this name; {nearest(name, experiment.spec.fits)}"
            continue
        if f"{name}_summary" in experiment.spec.crossval:
            text = f"its file {name}_summary.csv is that of the summary of {name}; rename one of the two fits"
            yield ("crossval", f"{name}_summary"), text
        special = [word for word in section.on if word in SPECIAL]
        if special and len(section.on) > 1:
            yield ("crossval", name, "on"), f"{special[0]} stands alone; list names or write {special[0]} only"
            continue
        if not special:
            for pattern in section.on:
                if not experiment.matching((pattern,)):
                    yield (
                        ("crossval", name, "on"),
                        f"no recording matches {pattern!r}; {nearest(pattern, (*SPECIAL, *experiment.recordings))}",
                    )
            continue
        if experiment.spec.fits[name].together and special == ["cyclic"]:
            text = "cyclic needs a fit per recording; write others or point, or name recordings"
            yield ("crossval", name, "on"), text
            continue
        pairs = validation_pairs(experiment, name)
        for model in dict.fromkeys(model for model, _ in pairs):
            if not any(m == model and recording for m, recording in pairs):
                where = "" if special == ["others"] else " at its operating point"
                yield ("crossval", name, "on"), f"no other recording for {model!r}{where}; name some"
                break
