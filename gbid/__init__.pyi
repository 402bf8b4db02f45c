"""Public names of gbid, and the files that define them: the one list, which Python and type checkers read."""

from . import (
    control as control,
    core as core,
    discretise as discretise,
    excite as excite,
    experiment as experiment,
    export as export,
    identify as identify,
    lpv as lpv,
    recording as recording,
    report as report,
    rig as rig,
    structure as structure,
    validate as validate,
)
from ._version import __version__ as __version__
from .control import (
    GainResult as GainResult,
    ParetoFront as ParetoFront,
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
from .control.tuning.tune import tune as tune
from .core.hdf5 import load as load, save as save
from .excite import (
    Excitation as Excitation,
    ExcitationLimits as ExcitationLimits,
    KnownModel as KnownModel,
    design_excitation as design_excitation,
)
from .export.data_files import save_data as save_data
from .export.matlab import save_mat as save_mat
from .export.ross import from_ross as from_ross
from .export.tables import save_csv as save_csv
from .identify import (
    DelayEstimate as DelayEstimate,
    FitProblem as FitProblem,
    FitResult as FitResult,
    FitTable as FitTable,
    FrequencyData as FrequencyData,
    MeasuredResponse as MeasuredResponse,
    MultiStart as MultiStart,
    Profile as Profile,
    Progress as Progress,
    estimate_delay as estimate_delay,
    fit_multistart as fit_multistart,
    fit_problem as fit_problem,
    load_fit as load_fit,
    load_table as load_table,
    measured_response as measured_response,
    profile as profile,
    save_fit as save_fit,
    subspace as subspace,
    subspace_orders as subspace_orders,
)
from .identify.fitting import fit as fit
from .lpv import (
    LPVFit as LPVFit,
    LPVModel as LPVModel,
    fit_lpv as fit_lpv,
    fit_lpv_direct as fit_lpv_direct,
    load_lpv_fit as load_lpv_fit,
    load_model as load_model,
    lpv_of as lpv_of,
    save_lpv_fit as save_lpv_fit,
)
from .prefilter.runout_identification import (
    align_index as align_index,
    compare_runout as compare_runout,
    identify_runout as identify_runout,
)
from .prefilter.filtering import OnlinePrefilter as OnlinePrefilter, prefilter as prefilter
from .prefilter.piezo import PiezoCurve as PiezoCurve, characterise_piezo as characterise_piezo
from .prefilter.staircase import StaticMap as StaticMap, characterise_staircase as characterise_staircase
from .recording import (
    Recording as Recording,
    import_recording as import_recording,
    load_iddata as load_iddata,
    load_recording as load_recording,
    save_recording as save_recording,
    with_unbalance as with_unbalance,
)
from .structure import (
    ClosedLoop as ClosedLoop,
    LinearModel as LinearModel,
    LinearStructure as LinearStructure,
    MagneticBearing as MagneticBearing,
    NonlinearModel as NonlinearModel,
    NonlinearStructure as NonlinearStructure,
    Parameter as Parameter,
    PiezoPair as PiezoPair,
    Plant as Plant,
    RigidRotor as RigidRotor,
    RotorBearing as RotorBearing,
    ScheduledStructure as ScheduledStructure,
    casadi_functions as casadi_functions,
    scheduled as scheduled,
    with_pade as with_pade,
)
from .validate import (
    ModelComparison as ModelComparison,
    NominalActuator as NominalActuator,
    ResidualTest as ResidualTest,
    ValidationScores as ValidationScores,
    ValidationSummary as ValidationSummary,
    check_residuals as check_residuals,
    compare as compare,
    cross_validate as cross_validate,
    cross_validate_many as cross_validate_many,
    nominal_actuator as nominal_actuator,
    summarise as summarise,
)
