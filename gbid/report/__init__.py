"""Tables, figures and what they are made from.

The figures are imported when first used: nothing but they needs matplotlib.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gbid.report.figures import plot_response, response_figure, save_figure
    from gbid.report.residuals import plot_residuals, residuals_data, residuals_figure

__all__ = [
    "plot_residuals",
    "plot_response",
    "residuals_data",
    "residuals_figure",
    "response_figure",
    "save_figure",
]

_HOME = {
    "figures": ("plot_response", "response_figure", "save_figure"),
    "residuals": ("plot_residuals", "residuals_data", "residuals_figure"),
}
_MODULES = {name: f"gbid.report.{module}" for module, names in _HOME.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a figure when it is first asked for (PEP 562)."""
    if name not in _MODULES:
        raise AttributeError(f"module 'gbid.report' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    """List the public names."""
    return sorted(__all__)
