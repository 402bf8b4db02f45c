"""Grey-box identification and damping control of rotors on controllable gas bearings.

The public names below are imported when first used, so that ``import gbid`` costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Any

from gbid._version import __version__

if TYPE_CHECKING:
    from gbid.characterise import PiezoCurve, StaticMap, characterise_piezo, characterise_staircase
    from gbid.control import (
        GainResult,
        ParetoFront,
        Uncertainty,
        close_loop,
        compare_designs,
        controller_structure,
        fit_ringdown,
        load_controller,
        maximise_damping,
        pareto,
        save_controller,
        sensitivities,
        validate_impact,
    )
    from gbid.control.assess import assess
    from gbid.control.tuning.tune import tune
    from gbid.excite import Excitation, ExcitationLimits, KnownModel, design_excitation
    from gbid.export.matlab import save_mat
    from gbid.export.ross import from_ross
    from gbid.export.tables import save_csv
    from gbid.identify import (
        DelayEstimate,
        FitProblem,
        FitResult,
        FitTable,
        MeasuredResponse,
        MultiStart,
        Progress,
        estimate_delay,
        fit_multistart,
        fit_problem,
        load_fit,
        load_table,
        measured_response,
        save_fit,
    )
    from gbid.identify.fit import fit
    from gbid.lpv import LPVFit, LPVModel, fit_lpv, fit_lpv_direct, load_lpv_fit, load_model, lpv_of, save_lpv_fit
    from gbid.prefilter.identify_runout import align_index, compare_runout, identify_runout
    from gbid.prefilter.prefilter import OnlinePrefilter, prefilter
    from gbid.recording import Recording, import_recording, load_recording, save_recording, with_unbalance
    from gbid.structure import (
        ClosedLoop,
        LinearModel,
        LinearStructure,
        NonlinearModel,
        NonlinearStructure,
        Parameter,
        PiezoPair,
        Plant,
        RotorBearing,
        ScheduledStructure,
        casadi_functions,
        scheduled,
        with_pade,
    )
    from gbid.validate import (
        NominalActuator,
        ResidualTest,
        ValidationScores,
        ValidationSummary,
        check_residuals,
        cross_validate,
        cross_validate_many,
        nominal_actuator,
        summarise,
    )

__all__ = [
    "ClosedLoop",
    "DelayEstimate",
    "Excitation",
    "ExcitationLimits",
    "FitProblem",
    "FitResult",
    "FitTable",
    "GainResult",
    "KnownModel",
    "LPVFit",
    "LPVModel",
    "LinearModel",
    "LinearStructure",
    "MeasuredResponse",
    "MultiStart",
    "NominalActuator",
    "NonlinearModel",
    "NonlinearStructure",
    "OnlinePrefilter",
    "Parameter",
    "ParetoFront",
    "PiezoCurve",
    "PiezoPair",
    "Plant",
    "Progress",
    "Recording",
    "ResidualTest",
    "RotorBearing",
    "ScheduledStructure",
    "StaticMap",
    "Uncertainty",
    "ValidationScores",
    "ValidationSummary",
    "__version__",
    "align_index",
    "assess",
    "casadi_functions",
    "characterise_piezo",
    "characterise_staircase",
    "check_residuals",
    "close_loop",
    "compare_designs",
    "compare_runout",
    "controller_structure",
    "cross_validate",
    "cross_validate_many",
    "design_excitation",
    "estimate_delay",
    "fit",
    "fit_lpv",
    "fit_lpv_direct",
    "fit_multistart",
    "fit_problem",
    "fit_ringdown",
    "from_ross",
    "identify_runout",
    "import_recording",
    "load_controller",
    "load_fit",
    "load_lpv_fit",
    "load_model",
    "load_recording",
    "load_table",
    "lpv_of",
    "maximise_damping",
    "measured_response",
    "nominal_actuator",
    "pareto",
    "prefilter",
    "save_controller",
    "save_csv",
    "save_fit",
    "save_lpv_fit",
    "save_mat",
    "save_recording",
    "scheduled",
    "sensitivities",
    "summarise",
    "tune",
    "validate_impact",
    "with_pade",
    "with_unbalance",
]

_HOME = {
    "characterise": ("PiezoCurve", "StaticMap", "characterise_piezo", "characterise_staircase"),
    "control": (
        *("fit_ringdown", "validate_impact"),
        *("assess", "close_loop", "compare_designs", "controller_structure"),
        *("load_controller", "save_controller", "sensitivities"),
        *("GainResult", "ParetoFront", "Uncertainty", "maximise_damping", "pareto", "tune"),
    ),
    "excite": ("Excitation", "ExcitationLimits", "KnownModel", "design_excitation"),
    "identify": (
        *("FitProblem", "FitResult", "FitTable", "MultiStart", "Progress", "fit", "fit_multistart", "fit_problem"),
        *(
            "load_fit",
            "load_table",
            "save_fit",
            "MeasuredResponse",
            "measured_response",
            "DelayEstimate",
            "estimate_delay",
        ),
    ),
    "export": ("from_ross", "save_csv", "save_mat"),
    "lpv": (
        *("LPVFit", "LPVModel", "fit_lpv", "fit_lpv_direct"),
        *("load_lpv_fit", "load_model", "lpv_of", "save_lpv_fit"),
    ),
    "prefilter": ("OnlinePrefilter", "align_index", "compare_runout", "identify_runout", "prefilter"),
    "recording": ("Recording", "import_recording", "load_recording", "save_recording", "with_unbalance"),
    "structure": (
        *("LinearModel", "LinearStructure", "NonlinearModel", "NonlinearStructure", "Parameter"),
        *("ClosedLoop", "PiezoPair", "Plant", "RotorBearing", "ScheduledStructure"),
        *("casadi_functions", "scheduled", "with_pade"),
    ),
    "validate": (
        *("NominalActuator", "ResidualTest", "ValidationScores", "ValidationSummary"),
        *("check_residuals", "cross_validate", "cross_validate_many", "nominal_actuator", "summarise"),
    ),
}
_PACKAGES = frozenset(found.name for found in iter_modules(__path__) if found.ispkg and not found.name.startswith("_"))
"""Packages that can be used as ``gbid.control.sampled_loop`` after ``import gbid``."""
_MODULES = {name: f"gbid.{package}" for package, names in _HOME.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a public name or a package when it is first asked for (PEP 562)."""
    if name in _PACKAGES:
        return import_module(f"gbid.{name}")
    if name not in _MODULES:
        raise AttributeError(f"module 'gbid' has no attribute {name!r}")
    module = import_module(_MODULES[name])
    if name == "prefilter":
        return module  # the package of that name, which can be called like the function
    value = globals()[name] = getattr(module, name)  # the next time it is found without this function
    return value


def __dir__() -> list[str]:
    """List the public names and packages."""
    return sorted({*__all__, *_PACKAGES})
