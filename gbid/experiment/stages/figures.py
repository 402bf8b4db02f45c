"""Checks of the figures section."""

from __future__ import annotations

from gbid.experiment.experiment import Experiment
from gbid.experiment.fields import Found, nearest
from gbid.experiment.run import Stage


def figures_show_fits(experiment: Experiment) -> Found:
    """Yield a problem for each figure of an unknown fit or of an empty time range."""
    for name, section in experiment.spec.figures.items():
        if name not in experiment.spec.fits:
            yield ("figures", name), f"no fit of this name; {nearest(name, experiment.spec.fits)}"
        begin = section.from_s or 0.0
        if section.to_s is not None and section.to_s <= begin:
            yield ("figures", name, "to_s"), f"{section.to_s:g} s is not after from_s = {begin:g} s; make it larger"
        rig = experiment.spec.rig
        if rig is not None and experiment.spec.imported is None and begin >= rig.duration_s:
            yield (
                ("figures", name, "from_s"),
                f"{begin:g} s lies beyond the end of the recordings, {rig.duration_s:g} s; make it smaller",
            )


# ---- Stage of the figures of fits; `gbid.report` draws them from the results of the other stages.

FIGURES = Stage("figure", "figures", (figures_show_fits,), lambda _: ())
