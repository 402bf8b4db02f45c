"""Public names of gbid, and the files that define them: the one list, which Python and type checkers read."""

from . import (
    control as control,
    excite as excite,
    experiment as experiment,
    export as export,
    identify as identify,
    lpv as lpv,
    online as online,
    recording as recording,
    report as report,
    rig as rig,
    structure as structure,
    validate as validate,
)
from ._version import __version__ as __version__
from .control import (
    GainResult as GainResult,
    Uncertainty as Uncertainty,
    close_loop as close_loop,
    compare_designs as compare_designs,
    controller_structure as controller_structure,
    fit_ringdown as fit_ringdown,
    load_controller as load_controller,
    maximise_damping as maximise_damping,
    pareto as pareto,
    save_controller as save_controller,
    sensitivities as sensitivities,
    validate_impact as validate_impact,
)
from .control.assessment import assess as assess
from .control.proof import prove as prove
from .control.tuning.tune import tune as tune
from .core.hdf5 import save as save
from .excite import (
    Excitation as Excitation,
    design_excitation as design_excitation,
)
from .export.matlab import save_mat as save_mat
from .identify import (
    FitResult as FitResult,
    FrequencyData as FrequencyData,
    fit_multistart as fit_multistart,
    measured_response as measured_response,
    profile as profile,
    subspace as subspace,
)
from .identify.fitting import fit as fit
from .lpv import (
    LPVFit as LPVFit,
    LPVModel as LPVModel,
    fit_lpv as fit_lpv,
    fit_lpv_direct as fit_lpv_direct,
    load_model as load_model,
)
from .online import (
    BalanceWhileRunning as BalanceWhileRunning,
    RecursiveFit as RecursiveFit,
)
from .prefilter.runout_identification import (
    align_index as align_index,
    identify_runout as identify_runout,
)
from .prefilter.filtering import OnlinePrefilter as OnlinePrefilter, prefilter as prefilter
from .prefilter.piezo import characterise_piezo as characterise_piezo
from .prefilter.staircase import characterise_staircase as characterise_staircase
from .recording import (
    Recording as Recording,
    import_recording as import_recording,
    load_recording as load_recording,
    save_recording as save_recording,
)
from .stored import load as load
from .structure import (
    ClosedLoop as ClosedLoop,
    LinearModel as LinearModel,
    LinearStructure as LinearStructure,
    MagneticBearing as MagneticBearing,
    NonlinearStructure as NonlinearStructure,
    Parameter as Parameter,
    PiezoPair as PiezoPair,
    Plant as Plant,
    RotorBearing as RotorBearing,
    scheduled as scheduled,
)
from .validate import (
    check_residuals as check_residuals,
    compare as compare,
    cross_validate as cross_validate,
)
