"""Tables, figures and what they are made from.

The figures are imported when first used: nothing but they needs matplotlib.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gbid.report.across import (
        ActuatorParameters,
        Histogram,
        histogram_data,
        plot_actuator_parameters,
        plot_fit_histogram,
    )
    from gbid.report.diagrams import (
        plot_closed_loop,
        plot_differential_pairing,
        plot_identification_flow,
        plot_rotor_bearing_model,
    )
    from gbid.report.eigenvalues import (
        Eigenvalues,
        RootLocus,
        eigenvalues_data,
        plot_eigenvalues,
        plot_root_locus,
        root_locus_data,
    )
    from gbid.report.figures import plot_response, response_figure, save_figure
    from gbid.report.frequency import MagnitudeCurves, bode_curves, plot_magnitudes, sensitivity_curves
    from gbid.report.impact import ImpactCurves, plot_impact
    from gbid.report.impact_loops import ImpactLoops, impact_loops_data, plot_impact_loops
    from gbid.report.of_results import (
        crossval_data,
        fit_over_pressure_data,
        fit_surfaces_data,
        impact_data,
        impact_validation_data,
        nominal_data,
        piezo_data,
        static_map_data,
    )
    from gbid.report.over_pressure import (
        PressurePanel,
        delays_data,
        modes_data,
        plot_over_pressure,
        static_gains_data,
    )
    from gbid.report.piezos import PiezoStaircase, piezo_staircase_data, plot_piezo_hysteresis, plot_piezo_staircase
    from gbid.report.residuals import plot_residuals, residuals_data, residuals_figure
    from gbid.report.static_map import StaticSweep, plot_static_map, static_sweep_data
    from gbid.report.surfaces import Surface, plot_surfaces, surfaces_data
    from gbid.report.tuning import (
        DampingMap,
        ParetoFront,
        damping_map_data,
        designs_pareto_data,
        pareto_data,
        plot_damping_map,
        plot_pareto,
    )

_HOME = {
    "across": (
        "ActuatorParameters",
        "Histogram",
        "histogram_data",
        "plot_actuator_parameters",
        "plot_fit_histogram",
    ),
    "diagrams": (
        "plot_closed_loop",
        "plot_differential_pairing",
        "plot_identification_flow",
        "plot_rotor_bearing_model",
    ),
    "eigenvalues": (
        "Eigenvalues",
        "RootLocus",
        "eigenvalues_data",
        "plot_eigenvalues",
        "plot_root_locus",
        "root_locus_data",
    ),
    "figures": ("plot_response", "response_figure", "save_figure"),
    "frequency": ("MagnitudeCurves", "bode_curves", "plot_magnitudes", "sensitivity_curves"),
    "impact": ("ImpactCurves", "plot_impact"),
    "impact_loops": ("ImpactLoops", "impact_loops_data", "plot_impact_loops"),
    "of_results": (
        "crossval_data",
        "fit_over_pressure_data",
        "fit_surfaces_data",
        "impact_data",
        "impact_validation_data",
        "nominal_data",
        "piezo_data",
        "static_map_data",
    ),
    "over_pressure": ("PressurePanel", "delays_data", "modes_data", "plot_over_pressure", "static_gains_data"),
    "piezos": ("PiezoStaircase", "piezo_staircase_data", "plot_piezo_hysteresis", "plot_piezo_staircase"),
    "residuals": ("plot_residuals", "residuals_data", "residuals_figure"),
    "static_map": ("StaticSweep", "plot_static_map", "static_sweep_data"),
    "surfaces": ("Surface", "plot_surfaces", "surfaces_data"),
    "tuning": (
        "DampingMap",
        "ParetoFront",
        "damping_map_data",
        "designs_pareto_data",
        "pareto_data",
        "plot_damping_map",
        "plot_pareto",
    ),
}
_MODULES = {name: f"gbid.report.{module}" for module, names in _HOME.items() for name in names}

__all__ = [
    "ActuatorParameters",
    "DampingMap",
    "Eigenvalues",
    "Histogram",
    "ImpactCurves",
    "ImpactLoops",
    "MagnitudeCurves",
    "ParetoFront",
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
    "histogram_data",
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
    "static_sweep_data",
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
