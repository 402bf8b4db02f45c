"""Stages of an experiment, in the order in which they run.

A new stage is a file beside this module, an entry here, and a field of `gbid.experiment.schema.ExperimentFile`.
"""

from __future__ import annotations

from gbid.experiment.run import Stage
from gbid.experiment.stages.crossval import CROSSVAL, FIGURES, NOMINAL
from gbid.experiment.stages.cycle import CYCLE
from gbid.experiment.stages.excite import EXCITE
from gbid.experiment.stages.fit import FIT
from gbid.experiment.stages.impact import IMPACT, TARGET
from gbid.experiment.stages.importing import IMPORT
from gbid.experiment.stages.loop import LOOP, LOOP_COST
from gbid.experiment.stages.lpv import LPV
from gbid.experiment.stages.prefilter import PREFILTER
from gbid.experiment.stages.rig import RIG
from gbid.experiment.stages.static import STATIC
from gbid.experiment.stages.tune import TUNE

STAGES: tuple[Stage, ...] = (
    *(LOOP, RIG, IMPORT, PREFILTER, FIT),
    *(STATIC, LOOP_COST, CROSSVAL, NOMINAL, LPV, EXCITE, TUNE, TARGET, IMPACT, CYCLE, FIGURES),
)
