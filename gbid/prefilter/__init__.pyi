"""Public names of `gbid.prefilter`, and the files that define them: the one list."""

from .runout_identification import (
    IndexAlignment as IndexAlignment,
    RunoutComparison as RunoutComparison,
    RunoutResidual as RunoutResidual,
    RunoutTrial as RunoutTrial,
    align_index as align_index,
    compare_runout as compare_runout,
    identify_runout as identify_runout,
    runout_residual as runout_residual,
)
from .filtering import (
    Despiked as Despiked,
    OnlinePrefilter as OnlinePrefilter,
    PrefilterFile as PrefilterFile,
    PrefilterReport as PrefilterReport,
    prefilter as prefilter,
    remove_spikes as remove_spikes,
)
from .runout import (
    RunoutMap as RunoutMap,
    running_median as running_median,
)
from .piezo import (
    PiezoCurve as PiezoCurve,
    characterise_piezo as characterise_piezo,
)
from .staircase import (
    StaticMap as StaticMap,
    characterise_staircase as characterise_staircase,
)
