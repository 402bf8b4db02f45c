"""The paper's figures and those of tuned designs, one function each: results in, figure out."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

from matplotlib.figure import Figure

from gbid.control import sensitivity_data
from gbid.errors import DataError
from gbid.experiment.stages.crossval.pairing import validate_pair
from gbid.experiment.stages.fit.plan import fit_models, recordings_of
from gbid.experiment.stages.fit.stage import fit_path
from gbid.operating_point import point_label
from gbid.report.across import plot_actuator_parameters, plot_fit_histogram
from gbid.report.diagrams import (
    plot_closed_loop,
    plot_differential_pairing,
    plot_identification_flow,
    plot_rotor_bearing_model,
)
from gbid.report.figures import response_figure
from gbid.report.frequency import bode_curves, plot_magnitudes, sensitivity_curves
from gbid.report.impact import plot_impact
from gbid.report.impact_loops import impact_loops_data, plot_impact_loops
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
from gbid.report.over_pressure import plot_over_pressure
from gbid.report.paper.published import published_controller, published_gains, shown_point
from gbid.report.piezos import plot_piezo_hysteresis, plot_piezo_staircase
from gbid.report.reader import Results
from gbid.report.static_map import plot_static_map
from gbid.report.surfaces import plot_surfaces
from gbid.report.tuning import designs_pareto_data, plot_pareto

Draw = Callable[[Results], Figure]
_ZOOM = (1.2, 1.4)  # part of the recording that Fig. 7 shows [s]


def _static_map(results: Results) -> Figure:
    found = results.static_map
    known = {"pressure_bar", "speed_rpm"} <= set(found.conditions)
    title = point_label(found.conditions["pressure_bar"], found.conditions["speed_rpm"]) if known else ""
    return plot_static_map(static_map_data(found), title=title)


def _identification(results: Results) -> Figure:
    fit, model = _shown_fit(results)
    validation = validate_pair(results.job, fit, model, recordings_of(results.experiment, fit, model)[0])
    from_s, to_s = _ZOOM if validation.time[-1] >= _ZOOM[1] else (None, None)
    return response_figure(validation, from_s=from_s, to_s=to_s)


def _shown_fit(results: Results) -> tuple[str, str]:
    """Fit of the bearing and model that Fig. 7 shows: of the paper's operating point, or the first."""
    name = results.fit_with("rotor_bearing")
    there = [model for model in fit_models(results.experiment, name) if fit_path(results.job, name, model).is_file()]
    if not there:
        raise DataError(f"no model of fit {name!r} is there; run `gbid fit` or `gbid run`")
    return name, next((m for m in there if m.startswith("p5_n6000_")), there[0])


def _actuators(results: Results) -> Figure:
    return plot_actuator_parameters(nominal_data(results.nominal))


def _histogram(structure: str, results: Results) -> Figure:
    return plot_fit_histogram(crossval_data(results.summary(structure)))


def _surfaces(letter: Literal["k", "d", "b"], results: Results) -> Figure:
    return plot_surfaces(fit_surfaces_data(results.surface_fit, letter))


def _over_pressure(
    what: Literal["delay", "frequency", "damping", "gain"], results: Results, only: str | None = None
) -> Figure:
    rig = results.experiment.spec.rig
    panels = fit_over_pressure_data(results.surface_fit, what, sample_time=rig.sample_time_s if rig else 2e-4)
    return plot_over_pressure([panel for panel in panels if only in (None, panel.name)])


def _loop(what: Literal["sensitivity", "bode"], results: Results) -> Figure:
    point = shown_point(results.identified)
    plant, d = results.identified.plant_at(*point), published_gains(results.machine)
    gains = f"$\\kappa_x$ = {d.kappa_x:g}, $\\kappa_y$ = {d.kappa_y:g} m/m, low-pass {d.lowpass_hz:g} Hz"
    data, title = sensitivity_data(plant, published_controller(results.machine)), f"{point_label(*point)}; {gains}"
    return plot_magnitudes((sensitivity_curves if what == "sensitivity" else bode_curves)(data, title))


def _impact(axis: Literal["x", "y"], rotating: bool, results: Results) -> Figure:
    loops = results.impacts_at(rotating)
    return plot_impact(impact_data(loops["open"], loops["closed"], axis))


def _impact_validation(axis: Literal["x", "y"], results: Results) -> Figure:
    return plot_impact(impact_validation_data(results.impacts_at(False)["closed"], axis))


def _loops(rotating: bool, results: Results) -> Figure:
    return plot_impact_loops(impact_loops_data(results.beside_at(rotating)))


def _pareto(results: Results) -> Figure:
    return plot_pareto(designs_pareto_data(results.tuned))


def _piezo(plot: Callable[..., Figure], results: Results) -> Figure:
    return plot([piezo_data(*found) for found in results.piezos])


def _diagram(plot: Callable[[], Figure], _results: Results) -> Figure:
    return plot()


FIGURES: dict[str, Draw] = {
    "fig03_differential_pairing": partial(_diagram, plot_differential_pairing),
    "fig04_identification_flow": partial(_diagram, plot_identification_flow),
    "fig05_static_map": _static_map,
    "fig06_rotor_bearing_model": partial(_diagram, plot_rotor_bearing_model),
    "fig07_identification": _identification,
    "fig08_actuator_parameters": _actuators,
    "fig09_crossval_bearing": partial(_histogram, "rotor_bearing"),
    "fig10_crossval_actuators": partial(_histogram, "piezo_pair"),
    "fig11_stiffness": partial(_surfaces, "k"),
    "fig12_damping": partial(_surfaces, "d"),
    "fig13_input_gain": partial(_surfaces, "b"),
    "fig14_delay_x": partial(_over_pressure, "delay", only="tau_x"),
    "fig15_delay_y": partial(_over_pressure, "delay", only="tau_y"),
    "fig16_natural_frequencies": partial(_over_pressure, "frequency"),
    "fig17_damping_factors": partial(_over_pressure, "damping"),
    "fig18_static_gains": partial(_over_pressure, "gain"),
    "fig19_closed_loop": partial(_diagram, plot_closed_loop),
    "fig20_sensitivities": partial(_loop, "sensitivity"),
    "fig21_bode": partial(_loop, "bode"),
    "fig22_impact_x": partial(_impact, "x", False),
    "fig23_impact_y": partial(_impact, "y", False),
    "fig24_impact_model_x": partial(_impact_validation, "x"),
    "fig25_impact_model_y": partial(_impact_validation, "y"),
    "fig26_impact_turning_x": partial(_impact, "x", True),
    "fig27_impact_turning_y": partial(_impact, "y", True),
    "figA28_piezo_hysteresis": partial(_piezo, plot_piezo_hysteresis),
    "figA29_piezo_staircase": partial(_piezo, plot_piezo_staircase),
    "designs_impacts": partial(_loops, False),
    "designs_impacts_turning": partial(_loops, True),
    "designs_pareto": _pareto,
}
"""Figures by name: number in the paper and what they show; past the paper those of tuned designs.

Each raises `DataError` when its results are not there.
"""
