"""Prefilter (paper, Sec. 3.5): map of run-out and unbalance, removal of spikes and offsets, running median."""

import sys
from types import ModuleType
from typing import Any

from gbid.prefilter.align import IndexAlignment, align_index
from gbid.prefilter.compare import RunoutComparison, RunoutTrial, compare_runout
from gbid.prefilter.identify_runout import identify_runout
from gbid.prefilter.median import running_median
from gbid.prefilter.online import OnlinePrefilter
from gbid.prefilter.prefilter import PrefilterReport, prefilter
from gbid.prefilter.prefilter_store import load_prefilter, save_prefilter
from gbid.prefilter.residual import RunoutResidual, runout_residual
from gbid.prefilter.runout import RunoutMap
from gbid.prefilter.spikes import Despiked, remove_spikes

__all__ = [
    "Despiked",
    "IndexAlignment",
    "OnlinePrefilter",
    "PrefilterReport",
    "RunoutComparison",
    "RunoutMap",
    "RunoutResidual",
    "RunoutTrial",
    "align_index",
    "compare_runout",
    "identify_runout",
    "load_prefilter",
    "prefilter",
    "remove_spikes",
    "running_median",
    "runout_residual",
    "save_prefilter",
]


class _CallablePackage(ModuleType):
    """Package type that can be called, because `gbid.prefilter` is both this package and the public function in it."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return prefilter(*args, **kwargs)


sys.modules[__name__].__class__ = _CallablePackage
