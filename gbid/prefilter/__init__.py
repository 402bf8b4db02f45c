"""Prefilter (paper, Sec. 3.5): map of run-out and unbalance, removal of spikes and offsets, running median."""

import sys
from types import ModuleType
from typing import Any

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
    PrefilterReport,
    load_prefilter,
    prefilter,
    remove_spikes,
    save_prefilter,
)
from gbid.prefilter.runout import RunoutMap, running_median

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
