"""Prefilter (paper, Sec. 3.5): map of run-out and unbalance, removal of spikes and offsets, running median."""

from gbid.prefilter.identify_runout import (
    IndexAlignment,
    RunoutComparison,
    RunoutResidual,
    RunoutTrial,
    align_index,
    compare_runout,
    identify_runout,
    runout_residual,
)
from gbid.prefilter.prefilter import (
    Despiked,
    OnlinePrefilter,
    PrefilterFile,
    PrefilterReport,
    prefilter,
    remove_spikes,
)
from gbid.prefilter.runout import RunoutMap, running_median

__all__ = [
    "Despiked",
    "IndexAlignment",
    "OnlinePrefilter",
    "PrefilterFile",
    "PrefilterReport",
    "RunoutComparison",
    "RunoutMap",
    "RunoutResidual",
    "RunoutTrial",
    "align_index",
    "compare_runout",
    "identify_runout",
    "prefilter",
    "remove_spikes",
    "running_median",
    "runout_residual",
]
