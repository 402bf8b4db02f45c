"""Results that the paper needs, with the reason why one is missing, and its figures (Figs. 3 to 27, A.28, A.29)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Literal, TypeVar

import numpy as np
import numpy.typing as npt

from gbid import lpv, report, validate
from gbid.control import p_controller
from gbid.control.assessment import TunedDesign
from gbid.control.impact.study import ImpactStudy
from gbid.control.loop.sensitivity import sensitivity_data
from gbid.core.arrays import point_label
from gbid.core.errors import DataError
from gbid.experiment.experiment import fit_models, recordings_of
from gbid.experiment.machine import rig_machine
from gbid.experiment.recordings import load_made
from gbid.experiment.schema import wanted_signals
from gbid.experiment.stages.crossval import validate_pair
from gbid.experiment.stages.fit import fit_result
from gbid.experiment.stages.impact import planned_impacts, recording_result
from gbid.lpv.model_file import ProportionalDesign, PublishedMachine
from gbid.prefilter import PiezoCurve, StaticMap
from gbid.recording import Recording
from gbid.recording.recording import load_recording
from gbid.report.canvas import TWO_COLUMNS, Drawn, legend_above, letter, panels, series, styled
from gbid.report.impact_pictures import validation_along
from gbid.report.measured_pictures import piezo_data
from gbid.report.read import Results
from gbid.report.surface_pictures import Quantity
from gbid.structure import LinearModel

Value = TypeVar("Value")
Kind = TypeVar("Kind", StaticMap, PiezoCurve)

# ---- Controller of the paper on its machine, and the operating point of its figures.

POINT = (6.0, 0.0)
"""Operating point of static map, controller and impacts in the paper: pressure [bar], speed [rpm]."""


def published_gains(machine: PublishedMachine) -> ProportionalDesign:
    """Return the published gains and low-pass of a machine.

    Raises
    ------
    DataError
        When the machine has none.
    """
    if machine.controller is None:
        raise DataError(f"machine {machine.model.name!r} comes with no controller; add one to its model file")
    return machine.controller


def published_controller(machine: PublishedMachine) -> LinearModel:
    """Return the controller of `published_gains`."""
    d = published_gains(machine)
    return p_controller(d.kappa_x, d.kappa_y, d.lowpass_hz, d.lowpass_order)


# ---- Results of an experiment like that of the paper.


class PaperResults(Results):
    """Stored results of an experiment; a property of one result raises `DataError` when it is missing."""

    @property
    def published_machine(self) -> PublishedMachine:
        """Machine file of the rig, which must exist: the model, and what its source publishes beside it."""
        if self.experiment.spec.rig is None:
            raise DataError("this experiment has no virtual rig, so there is no description of the machine")
        return rig_machine(self.experiment)

    @property
    def machine(self) -> lpv.LPVModel:
        """Model behind the rig, which must exist."""
        return self.published_machine.model

    @property
    def published(self) -> bool:
        """Whether the machine is that of the paper."""
        return self.rig is not None and self.rig.name == "theisen2016"

    def fit_with(self, structure: str) -> str:
        """Return the name of the first fit with a structure."""
        names = (name for name, section in self.experiment.spec.fits.items() if section.structure == structure)
        return _first(names, f"no fit with structure {structure!r}; add one to section 'fits'")

    def summary(self, structure: str) -> validate.ValidationSummary:
        """Return the cross-validation of the first fit with a structure."""
        name = self.fit_with(structure)
        if name not in self.experiment.spec.crossval:
            raise DataError(f"no cross-validation of fit {name!r}; add it to section 'crossval'")
        if name not in self.crossval:
            raise DataError(f"the cross-validation of fit {name!r} is missing; run `gbid crossval` or `gbid run`")
        return self.crossval[name][1]

    @property
    def surface_fit(self) -> lpv.LPVFit:
        """Surfaces fitted to the fits."""
        if self.experiment.spec.lpv is None:
            raise DataError("no section 'lpv'; add one")
        return _first(self.surfaces.values(), "there are no surfaces of the present fits; run `gbid lpv` or `gbid run`")

    @property
    def identified(self) -> lpv.LPVModel:
        """Identified model of bearing and actuators."""
        model = self.surface_fit.model
        if not model.actuators:
            raise DataError("the surfaces have no actuators; write `actuators: nominal` into section 'lpv'")
        return model

    @property
    def static_map(self) -> StaticMap:
        """First static characterisation of the bearing."""
        return next(iter(self._statics("bearing", StaticMap).values()))

    @property
    def piezos(self) -> list[tuple[PiezoCurve, Recording, str, str | None]]:
        """Characterised piezos with recording, and signal and channel of the command."""
        piezos = []
        for name, curve in self._statics("piezo", PiezoCurve).items():
            section = self.experiment.spec.static[name]
            recording = load_made(self.job, self.experiment.matching(section.recordings)[0])
            piezos.append((curve, recording, wanted_signals(section)["command"], section.command_channel))
        return piezos

    def _statics(self, kind: str, result: type[Kind]) -> dict[str, Kind]:
        """Return all characterisations of a kind; at least one must be planned, and all must exist."""
        planned = [name for name, section in self.experiment.spec.static.items() if section.kind == kind]
        if not planned:
            raise DataError(f"no static characterisation with kind: {kind}; add one to section 'static'")
        _all_there({name: why for name, why in self.statics.missing.items() if name in planned})
        return {name: q for name, q in self.statics.complete.items() if isinstance(q, result)}

    @property
    def tuned(self) -> Mapping[str, TunedDesign]:
        """Tuned designs by name, at least one."""
        if not self.experiment.spec.controller:
            raise DataError("no section 'controller'; add one")
        if not self.designs.complete:
            raise DataError("; ".join(f"design {name}: {why}" for name, why in self.designs.missing.items()))
        return self.designs.complete

    def impacts_at(self, rotating: bool) -> dict[str, ImpactStudy]:
        """Return the impact studies of both loops at the first operating point at rest, or with a turning shaft."""
        points = [loops for loops in self.loops if {"open", "closed"} <= set(loops)]
        return self._loops_at(points, rotating, "in open and closed loop ")

    def beside_at(self, rotating: bool) -> dict[str, ImpactStudy]:
        """Return the impact studies with further controllers at such a point, by their labels in figures."""
        return self._loops_at(self.beside, rotating, "")

    @property
    def beside(self) -> list[dict[str, ImpactStudy]]:
        """Impact studies of the points with further controllers, by their labels in figures."""
        self._need_impacts()
        points = [self.labelled(loops) for loops in self.loops if set(loops) - {"open", "closed"}]
        if not points:
            raise DataError("no impacts with further controllers; name some under 'beside' in section 'impacts'")
        return points

    def _loops_at(self, points: list[dict[str, ImpactStudy]], rotating: bool, what: str) -> dict[str, ImpactStudy]:
        self._need_impacts()
        matching = (q for q in points if bool(next(iter(q.values())).conditions["speed_rpm"]) == rotating)
        why = "".join(f"; {text}" for text in self.studies.missing.values())
        return _first(matching, f"no impacts {what}{'with a turning shaft' if rotating else 'at rest'}{why}")

    def _need_impacts(self) -> None:
        if self.experiment.spec.impacts is None:
            raise DataError("no section 'impacts'; add one")
        if not self.studies.complete:
            _all_there(self.studies.missing)


def _first(values: Iterable[Value], otherwise: str) -> Value:
    for value in values:
        return value
    raise DataError(otherwise)


def _all_there(missing: Mapping[str, str]) -> None:
    if missing:
        raise DataError("; ".join(missing.values()))


# ---- Figures from these results, by name.


@styled
def _plot_both_loops(axis: Literal["x", "y"], rotating: bool, results: PaperResults) -> npt.NDArray[np.object_]:
    """Draw the responses to an impact, in the middle the control signals or what does not turn with the shaft."""
    loops, j = results.impacts_at(rotating), "xy".index(axis)
    data = report.impact_data(loops["open"], loops["closed"], axis)
    figure, axes = panels(
        None, 3, 1, size=(TWO_COLUMNS, 5.2), sharex=True, height_ratios=[2, 2 if rotating else 1.2, 1]
    )
    report.plot_impact(data, [axes[0], axes[2]])
    axes[0].get_legend().remove()
    for k, (label, loop) in enumerate(zip(data.responses, ("open", "closed"), strict=True)):
        v = validation_along(loops[loop], axis)
        if rotating:
            signal = v.measured[:, j] - v.stationary[:, j]
        else:
            planned = planned_impacts(results.experiment)[v.recording]
            signal = load_recording(recording_result(results.experiment, planned).require()).signal("r")[:, j]
        part = slice(v.shown.start, v.shown.start + len(data.time))
        axes[1].plot(1e3 * data.time, 1e6 * signal[part], label=label, **series(k, marker=None, linewidth=1.1))
    axes[1].set_ylabel(f"$p_{axis}$ less what\nturns with the shaft [µm]" if rotating else f"$r_{axis}$ [µm]")
    letter(axes)
    legend_above(figure, axes, title=data.title)
    return axes


def _plot_validation(axis: Literal["x", "y"], results: PaperResults) -> npt.NDArray[np.object_]:
    return report.plot_impact(report.impact_validation_data(results.impacts_at(False)["closed"], axis))


def _plot_published_loop(curves: Literal["sensitivity", "bode"], results: PaperResults) -> npt.NDArray[np.object_]:
    """Draw curves of the identified model in the loop with the published controller."""
    point = POINT if results.identified.domain.contains(*POINT) else results.identified.operating_points[0]
    plant, d = results.identified.plant_at(*point), published_gains(results.published_machine)
    gains = f"$\\kappa_x$ = {d.kappa_x:g}, $\\kappa_y$ = {d.kappa_y:g} m/m, low-pass {d.lowpass_hz:g} Hz"
    data = sensitivity_data(plant, published_controller(results.published_machine))
    return report.plot_magnitudes(data, curves=curves, title=f"{point_label(*point)}; {gains}")


def _plot_quantity(what: Quantity, results: PaperResults, only: str = "") -> npt.NDArray[np.object_]:
    rig = results.experiment.spec.rig
    data = report.fit_over_pressure_data(results.surface_fit, what, sample_time=rig.sample_time_s if rig else 2e-4)
    return report.plot_over_pressure([panel for panel in data if panel.name.startswith(only)])


_ZOOM = (1.2, 1.4)  # part of the recording that Fig. 7 shows [s]


def _response_of_bearing(results: PaperResults) -> npt.NDArray[np.object_]:
    """Draw a bearing model on its own recording, at the paper's operating point or the first (Fig. 7)."""
    name = results.fit_with("rotor_bearing")
    made = [
        model
        for model in fit_models(results.experiment, name)
        if fit_result(results.experiment, name, model).path.is_file()
    ]
    if not made:
        raise DataError(f"no model of fit {name!r} is there; run `gbid fit` or `gbid run`")
    model = next((m for m in made if m.startswith("p5_n6000_")), made[0])
    validation = validate_pair(results.job, name, model, recordings_of(results.experiment, name, model)[0])
    from_s, to_s = _ZOOM if validation.time[-1] >= _ZOOM[1] else (None, None)
    return report.plot_response(validation, from_s=from_s, to_s=to_s)


FIGURES: Mapping[str, Callable[[PaperResults], Drawn]] = {
    "cycle": lambda r: report.plot_cycle(r.cycle),
    "designs_impacts": lambda r: report.plot_impact_loops(report.impact_loops_data(r.beside_at(False))),
    "designs_impacts_turning": lambda r: report.plot_impact_loops(report.impact_loops_data(r.beside_at(True))),
    "designs_pareto": lambda r: report.plot_pareto(report.designs_pareto_data(r.tuned)),
    "designs_robust": lambda r: report.plot_robustness_price(r.tuned),
    "fig03_differential_pairing": lambda _: report.plot_differential_pairing(),
    "fig04_identification_flow": lambda _: report.plot_identification_flow(),
    "fig05_static_map": lambda r: report.plot_static_map(r.static_map),
    "fig06_rotor_bearing_model": lambda _: report.plot_rotor_bearing_model(),
    "fig07_identification": _response_of_bearing,
    "fig08_actuator_parameters": lambda r: report.plot_actuator_parameters(r.nominal),
    "fig09_crossval_bearing": lambda r: report.plot_fit_histogram(r.summary("rotor_bearing")),
    "fig10_crossval_actuators": lambda r: report.plot_fit_histogram(r.summary("piezo_pair")),
    "fig11_stiffness": lambda r: report.plot_surfaces(report.fit_surfaces_data(r.surface_fit, "k")),
    "fig12_damping": lambda r: report.plot_surfaces(report.fit_surfaces_data(r.surface_fit, "d")),
    "fig13_input_gain": lambda r: report.plot_surfaces(report.fit_surfaces_data(r.surface_fit, "b")),
    "fig14_delay_x": partial(_plot_quantity, "delay", only="tau_x"),
    "fig15_delay_y": partial(_plot_quantity, "delay", only="tau_y"),
    "fig16_natural_frequencies": partial(_plot_quantity, "frequency"),
    "fig17_damping_factors": partial(_plot_quantity, "damping"),
    "fig18_static_gains": partial(_plot_quantity, "gain"),
    "fig19_closed_loop": lambda _: report.plot_closed_loop(),
    "fig20_sensitivities": partial(_plot_published_loop, "sensitivity"),
    "fig21_bode": partial(_plot_published_loop, "bode"),
    "fig22_impact_x": partial(_plot_both_loops, "x", False),
    "fig23_impact_y": partial(_plot_both_loops, "y", False),
    "fig24_impact_model_x": partial(_plot_validation, "x"),
    "fig25_impact_model_y": partial(_plot_validation, "y"),
    "fig26_impact_turning_x": partial(_plot_both_loops, "x", True),
    "fig27_impact_turning_y": partial(_plot_both_loops, "y", True),
    "figA28_piezo_hysteresis": lambda r: report.plot_piezo_hysteresis([piezo_data(*q) for q in r.piezos]),
    "figA29_piezo_staircase": lambda r: report.plot_piezo_staircase([piezo_data(*q) for q in r.piezos]),
}
