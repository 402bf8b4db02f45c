"""The stages of an experiment: each reads what the one before wrote, and writes files with content keys."""

from gbid.experiment.stages.characterising import load_made_static, run_static, static_tasks
from gbid.experiment.stages.common import Engine, InTurn, Job, Made, Outcome, Reporter, Silent, Task
from gbid.experiment.stages.crossvalidating import CrossvalRow, run_crossval
from gbid.experiment.stages.fitting import fit_path, fit_tasks, load_made_fit, run_fits
from gbid.experiment.stages.impacting import made_impacts, run_impacts
from gbid.experiment.stages.nominating import choose_nominal
from gbid.experiment.stages.pairing import drawn_pairs, pair_keys, residuals_of_pair, validate_pair
from gbid.experiment.stages.performing import InputError, fail, perform, produce, run_tasks, standing
from gbid.experiment.stages.prefiltering import map_tasks, prefilter_recordings, prefilter_tasks
from gbid.experiment.stages.recordings import (
    find_import_problems,
    import_recordings,
    import_tasks,
    make_rig_recordings,
    read_import,
    rig_tasks,
)
from gbid.experiment.stages.surfaces import draw_surfaces, made_surfaces
from gbid.experiment.stages.tuning import made_designs, read_designs, run_tuning

__all__ = [
    "CrossvalRow",
    "Engine",
    "InTurn",
    "InputError",
    "Job",
    "Made",
    "Outcome",
    "Reporter",
    "Silent",
    "Task",
    "choose_nominal",
    "draw_surfaces",
    "drawn_pairs",
    "fail",
    "find_import_problems",
    "fit_path",
    "fit_tasks",
    "import_recordings",
    "import_tasks",
    "load_made_fit",
    "load_made_static",
    "made_designs",
    "made_impacts",
    "made_surfaces",
    "make_rig_recordings",
    "map_tasks",
    "pair_keys",
    "perform",
    "prefilter_recordings",
    "prefilter_tasks",
    "produce",
    "read_designs",
    "read_import",
    "residuals_of_pair",
    "rig_tasks",
    "run_crossval",
    "run_fits",
    "run_impacts",
    "run_static",
    "run_tasks",
    "run_tuning",
    "standing",
    "static_tasks",
    "validate_pair",
]
