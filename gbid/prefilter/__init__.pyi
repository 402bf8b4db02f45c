"""Public names of `gbid.prefilter`, and the files that define them: the one list."""

from .runout_identification import (
    align_index as align_index,
    compare_runout as compare_runout,
    identify_runout as identify_runout,
    runout_residual as runout_residual,
)
from .filtering import (
    OnlinePrefilter as OnlinePrefilter,
    prefilter as prefilter,
    remove_spikes as remove_spikes,
)
from .runout import (
    RunoutMap as RunoutMap,
)
from .piezo import (
    PiezoCurve as PiezoCurve,
    characterise_piezo as characterise_piezo,
)
from .staircase import (
    StaticMap as StaticMap,
    characterise_staircase as characterise_staircase,
)
