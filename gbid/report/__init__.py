"""Report: tables, figures and the data behind them.

Figures are imported at their first use, because only they need matplotlib.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_MODULES = (
    "diagrams",
    "loop_pictures",
    "impact_pictures",
    "measured_pictures",
    "model_pictures",
    "pictures",
    "canvas",
    "surface_pictures",
)
"""Modules of `gbid.report` with the public names."""

__all__ = [
    "ActuatorParameters",
    "DampingMap",
    "Eigenvalues",
    "Histogram",
    "ImpactCurves",
    "ImpactLoops",
    "MagnitudeCurves",
    "ParetoCurves",
    "PiezoStaircase",
    "PressurePanel",
    "RootLocus",
    "StaticSweep",
    "Surface",
    "bode_curves",
    "bode_data",
    "campbell_data",
    "crossval_data",
    "damping_map_data",
    "delays_data",
    "designs_pareto_data",
    "eigenvalues_data",
    "fit_over_pressure_data",
    "fit_surfaces_data",
    "impact_data",
    "impact_loops_data",
    "impact_validation_data",
    "modes_data",
    "nominal_data",
    "orbit_data",
    "pareto_data",
    "piezo_data",
    "piezo_staircase_data",
    "plot",
    "plot_actuator_parameters",
    "plot_bode",
    "plot_campbell",
    "plot_closed_loop",
    "plot_cycle",
    "plot_damping_map",
    "plot_differential_pairing",
    "plot_eigenvalues",
    "plot_fit_histogram",
    "plot_identification_flow",
    "plot_impact",
    "plot_impact_loops",
    "plot_impulse",
    "plot_iso_zones",
    "plot_magnitudes",
    "plot_orbit",
    "plot_over_pressure",
    "plot_pareto",
    "plot_piezo_hysteresis",
    "plot_piezo_staircase",
    "plot_poles",
    "plot_recording",
    "plot_residuals",
    "plot_response",
    "plot_robustness_price",
    "plot_root_locus",
    "plot_rotor_bearing_model",
    "plot_static_map",
    "plot_step",
    "plot_surfaces",
    "pole_data",
    "residuals_data",
    "residuals_figure",
    "response_data",
    "response_figure",
    "root_locus_data",
    "save_figure",
    "sensitivity_curves",
    "static_gains_data",
    "static_map_data",
    "surfaces_data",
]


def __getattr__(name: str) -> Any:
    """Import the figures at the first use of one (PEP 562)."""
    if name in __all__:
        for module in _MODULES:
            found = getattr(import_module(f"gbid.report.{module}"), name, None)
            if found is not None:
                globals()[name] = found
                return found
    raise AttributeError(f"module 'gbid.report' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted(__all__)
