"""Tables, figures and what they are made from.

The figures are imported when first used: nothing but they needs matplotlib.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gbid.report.figures.diagrams import (
        plot_closed_loop,
        plot_differential_pairing,
        plot_identification_flow,
        plot_rotor_bearing_model,
    )
    from gbid.report.figures.loop.damping_map import DampingMap, damping_map_data, plot_damping_map
    from gbid.report.figures.loop.eigenvalues import (
        Eigenvalues,
        RootLocus,
        eigenvalues_data,
        plot_eigenvalues,
        plot_root_locus,
        root_locus_data,
    )
    from gbid.report.figures.loop.impact_bands import ImpactLoops, impact_loops_data, plot_impact_loops
    from gbid.report.figures.loop.impact_curves import ImpactCurves, impact_data, impact_validation_data, plot_impact
    from gbid.report.figures.loop.magnitudes import MagnitudeCurves, bode_curves, plot_magnitudes, sensitivity_curves
    from gbid.report.figures.loop.pareto_curves import ParetoCurves, designs_pareto_data, pareto_data, plot_pareto
    from gbid.report.figures.measured.actuator_scatter import ActuatorParameters, nominal_data, plot_actuator_parameters
    from gbid.report.figures.measured.fit_histogram import Histogram, crossval_data, plot_fit_histogram
    from gbid.report.figures.measured.piezo_staircases import (
        PiezoStaircase,
        piezo_data,
        piezo_staircase_data,
        plot_piezo_hysteresis,
        plot_piezo_staircase,
    )
    from gbid.report.figures.measured.residual_panels import plot_residuals, residuals_data, residuals_figure
    from gbid.report.figures.measured.response import plot_response, response_figure
    from gbid.report.figures.measured.staircase_map import StaticSweep, plot_static_map, static_map_data
    from gbid.report.figures.save import save_figure
    from gbid.report.figures.surfaces.over_pressure import (
        PressurePanel,
        delays_data,
        fit_over_pressure_data,
        modes_data,
        plot_over_pressure,
        static_gains_data,
    )
    from gbid.report.figures.surfaces.surface_panels import Surface, fit_surfaces_data, plot_surfaces, surfaces_data

_HOME = {
    "diagrams": (
        "plot_closed_loop",
        "plot_differential_pairing",
        "plot_identification_flow",
        "plot_rotor_bearing_model",
    ),
    "loop.damping_map": (
        "DampingMap",
        "damping_map_data",
        "plot_damping_map",
    ),
    "loop.eigenvalues": (
        "Eigenvalues",
        "RootLocus",
        "eigenvalues_data",
        "plot_eigenvalues",
        "plot_root_locus",
        "root_locus_data",
    ),
    "loop.impact_bands": (
        "ImpactLoops",
        "impact_loops_data",
        "plot_impact_loops",
    ),
    "loop.impact_curves": (
        "ImpactCurves",
        "impact_data",
        "impact_validation_data",
        "plot_impact",
    ),
    "loop.magnitudes": (
        "MagnitudeCurves",
        "bode_curves",
        "plot_magnitudes",
        "sensitivity_curves",
    ),
    "loop.pareto_curves": (
        "ParetoCurves",
        "designs_pareto_data",
        "pareto_data",
        "plot_pareto",
    ),
    "measured.actuator_scatter": (
        "ActuatorParameters",
        "nominal_data",
        "plot_actuator_parameters",
    ),
    "measured.fit_histogram": (
        "Histogram",
        "crossval_data",
        "plot_fit_histogram",
    ),
    "measured.piezo_staircases": (
        "PiezoStaircase",
        "piezo_data",
        "piezo_staircase_data",
        "plot_piezo_hysteresis",
        "plot_piezo_staircase",
    ),
    "measured.residual_panels": (
        "plot_residuals",
        "residuals_data",
        "residuals_figure",
    ),
    "measured.response": (
        "plot_response",
        "response_figure",
    ),
    "measured.staircase_map": (
        "StaticSweep",
        "plot_static_map",
        "static_map_data",
    ),
    "save": ("save_figure",),
    "surfaces.over_pressure": (
        "PressurePanel",
        "delays_data",
        "fit_over_pressure_data",
        "modes_data",
        "plot_over_pressure",
        "static_gains_data",
    ),
    "surfaces.surface_panels": (
        "Surface",
        "fit_surfaces_data",
        "plot_surfaces",
        "surfaces_data",
    ),
}
_MODULES = {name: f"gbid.report.figures.{module}" for module, names in _HOME.items() for name in names}

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
    "pareto_data",
    "piezo_data",
    "piezo_staircase_data",
    "plot_actuator_parameters",
    "plot_closed_loop",
    "plot_damping_map",
    "plot_differential_pairing",
    "plot_eigenvalues",
    "plot_fit_histogram",
    "plot_identification_flow",
    "plot_impact",
    "plot_impact_loops",
    "plot_magnitudes",
    "plot_over_pressure",
    "plot_pareto",
    "plot_piezo_hysteresis",
    "plot_piezo_staircase",
    "plot_residuals",
    "plot_response",
    "plot_root_locus",
    "plot_rotor_bearing_model",
    "plot_static_map",
    "plot_surfaces",
    "residuals_data",
    "residuals_figure",
    "response_figure",
    "root_locus_data",
    "save_figure",
    "sensitivity_curves",
    "static_gains_data",
    "static_map_data",
    "surfaces_data",
]


def __getattr__(name: str) -> Any:
    """Import a figure when it is first asked for (PEP 562)."""
    if name not in _MODULES:
        raise AttributeError(f"module 'gbid.report' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    """List the public names."""
    return sorted(__all__)
