"""Grey-box identification and damping control of rotors on controllable gas bearings.

The public names below are imported when first used, so that ``import gbid`` costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gbid._version import __version__

if TYPE_CHECKING:
    from gbid.control import close_loop
    from gbid.identify import FitResult, MultiStart, Progress, fit_multistart, load_fit, save_fit
    from gbid.identify.fit import fit
    from gbid.lpv import LPVModel, load_model
    from gbid.prefilter.identify_runout import identify_runout
    from gbid.prefilter.prefilter import prefilter
    from gbid.recording import Recording, import_recording, load_recording, save_recording
    from gbid.structure import LinearModel, LinearStructure, Parameter, PiezoPair, Plant, RotorBearing, with_pade
    from gbid.validate import ResidualTest, check_residuals, cross_validate

__all__ = [
    "FitResult",
    "LPVModel",
    "LinearModel",
    "LinearStructure",
    "MultiStart",
    "Parameter",
    "PiezoPair",
    "Plant",
    "Progress",
    "Recording",
    "ResidualTest",
    "RotorBearing",
    "__version__",
    "check_residuals",
    "close_loop",
    "cross_validate",
    "fit",
    "fit_multistart",
    "identify_runout",
    "import_recording",
    "load_fit",
    "load_model",
    "load_recording",
    "prefilter",
    "save_fit",
    "save_recording",
    "with_pade",
]

_HOME = {
    "control": ("close_loop",),
    "identify": ("FitResult", "MultiStart", "Progress", "fit", "fit_multistart", "load_fit", "save_fit"),
    "lpv": ("LPVModel", "load_model"),
    "prefilter": ("identify_runout", "prefilter"),
    "recording": ("Recording", "import_recording", "load_recording", "save_recording"),
    "structure": ("LinearModel", "LinearStructure", "Parameter", "PiezoPair", "Plant", "RotorBearing", "with_pade"),
    "validate": ("ResidualTest", "check_residuals", "cross_validate"),
}
_MODULES = {name: f"gbid.{package}" for package, names in _HOME.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for (PEP 562)."""
    if name not in _MODULES:
        raise AttributeError(f"module 'gbid' has no attribute {name!r}")
    module = import_module(_MODULES[name])
    if name == "prefilter":
        return module  # the package of that name, which can be called like the function
    value = globals()[name] = getattr(module, name)  # the next time it is found without this function
    return value


def __dir__() -> list[str]:
    """List the public names."""
    return sorted(__all__)
