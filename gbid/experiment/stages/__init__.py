"""The stages of an experiment: each reads what the one before wrote, and writes files with content keys."""

from gbid.experiment.stages.common import Job, Outcome, Reporter, Silent, produce
from gbid.experiment.stages.crossvalidating import (
    CrossvalRow,
    drawn_pairs,
    pair_keys,
    residuals_of_pair,
    run_crossval,
    validate_pair,
)
from gbid.experiment.stages.fitting import fit_path, load_made_fit, run_fits
from gbid.experiment.stages.prefiltering import prefilter_recordings
from gbid.experiment.stages.recordings import import_recordings, make_rig_recordings, read_import

__all__ = [
    "CrossvalRow",
    "Job",
    "Outcome",
    "Reporter",
    "Silent",
    "drawn_pairs",
    "fit_path",
    "import_recordings",
    "load_made_fit",
    "make_rig_recordings",
    "pair_keys",
    "prefilter_recordings",
    "produce",
    "read_import",
    "residuals_of_pair",
    "run_crossval",
    "run_fits",
    "validate_pair",
]
