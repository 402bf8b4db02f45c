"""Stages of an experiment, in the order in which they run.

A new stage is a folder beside this module, an entry here, and a field of `gbid.experiment.schema.ExperimentFile`.
"""

from __future__ import annotations

from gbid.experiment.run.stage import Stage
from gbid.experiment.stages.crossval.stage import CROSSVAL
from gbid.experiment.stages.cycle.stage import CYCLE
from gbid.experiment.stages.excite.stage import EXCITE
from gbid.experiment.stages.figures.stage import FIGURES
from gbid.experiment.stages.fit.stage import FIT
from gbid.experiment.stages.impact.stage import IMPACT
from gbid.experiment.stages.importing.stage import IMPORT
from gbid.experiment.stages.loop.cost import LOOP_COST
from gbid.experiment.stages.loop.stage import LOOP
from gbid.experiment.stages.lpv.stage import LPV
from gbid.experiment.stages.nominal.stage import NOMINAL
from gbid.experiment.stages.prefilter.stage import PREFILTER
from gbid.experiment.stages.rig.stage import RIG
from gbid.experiment.stages.static.stage import STATIC
from gbid.experiment.stages.target.stage import TARGET
from gbid.experiment.stages.tune.stage import TUNE

STAGES: tuple[Stage, ...] = (
    *(LOOP, RIG, IMPORT, PREFILTER, FIT),
    *(STATIC, LOOP_COST, CROSSVAL, NOMINAL, LPV, EXCITE, TUNE, TARGET, IMPACT, CYCLE, FIGURES),
)
