"""From results to the numbers of figures: one function for each kind of result, for the `plot_...` function beside."""

from __future__ import annotations

from typing import Literal

import numpy as np

from gbid.characterise import PiezoCurve, StaticMap
from gbid.control.impact.study import ImpactStudy
from gbid.control.impact.validation import ImpactValidation
from gbid.errors import UsageError
from gbid.lpv import CHARACTERISTICS, LPVFit
from gbid.operating_point import point_label
from gbid.recording import Recording
from gbid.report.across import ActuatorParameters, Histogram
from gbid.report.figures import symbol
from gbid.report.impact import ImpactCurves
from gbid.report.over_pressure import PressurePanel, delays_data, modes_data, static_gains_data
from gbid.report.piezos import PiezoStaircase, piezo_staircase_data
from gbid.report.static_map import StaticSweep
from gbid.report.surfaces import Surface, surfaces_data
from gbid.structure import KEY_PARAMETERS
from gbid.validate import NominalActuator, ValidationSummary

_BEFORE = 25  # samples shown before an impact
_PAIRS = ("xx", "xy", "yx", "yy")
_MODES = {"frequency": "omega", "damping": "zeta"}


def static_map_data(result: StaticMap) -> list[StaticSweep]:
    """Give the panels of a static map, a sweep for each input, for `plot_static_map` (Fig. 5).

    Parameters
    ----------
    result : StaticMap
        Of two outputs; positions are those about the equilibrium, and the lines those of the result.

    Returns
    -------
    list of StaticSweep
        Of inputs that moved.
    """
    sweeps = []
    for j, source in enumerate(result.input_names):
        if not np.isfinite(result.gain[:, j]).all():
            continue
        panels = [result.panel(i, j) for i in range(len(result.output_names))]
        u, p = panels[0]["input"], np.column_stack([panel["output"] for panel in panels])
        rising = panels[0]["direction"] >= 0
        sweeps.append(StaticSweep(source[-1], u, p, rising, result.gain[:, j], np.zeros(len(panels))))
    return sweeps


def crossval_data(summary: ValidationSummary) -> list[Histogram]:
    """Give the histograms of a cross-validation, for `plot_fit_histogram` (Figs. 9, 10).

    Parameters
    ----------
    summary : ValidationSummary

    Returns
    -------
    list of Histogram
        One for each output; pairs below the first bin are said in its label.
    """
    found = []
    for j, name in enumerate(summary.output_names):
        label = f"{symbol(name)}" + (f", {summary.below[j]} more to the left" if summary.below[j] else "")
        edges, counts = (np.asarray(values[j]) for values in (summary.edges, summary.counts))
        found.append(Histogram(label, edges, counts, float(summary.mean[j]), float(summary.std[j])))
    return found


def nominal_data(nominal: NominalActuator) -> ActuatorParameters:
    """Give the actuators of all recordings, for `plot_actuator_parameters` (Fig. 8).

    Parameters
    ----------
    nominal : NominalActuator
    """
    values = dict(zip(nominal.parameter_names, nominal.values.T, strict=True))
    off = {(o.model, o.parameter) for o in nominal.outliers}
    outliers = {name: np.array([(model, name) in off for model in nominal.models]) for name in values}
    return ActuatorParameters(values, outliers, nominal.models.index(nominal.name))


def fit_surfaces_data(fit: LPVFit, letter: Literal["k", "d", "b"]) -> list[Surface]:
    """Give stiffness, damping or input gain with the estimates, for `plot_surfaces` (Figs. 11 to 13).

    Parameters
    ----------
    fit : LPVFit
    letter : {"k", "d", "b"}
    """
    names = [f"{letter}_{pair}" for pair in _PAIRS]
    estimates = dict(zip(KEY_PARAMETERS, fit.estimates.values.T, strict=True))
    return surfaces_data(fit.model, names, points=fit.estimates.points, estimates=estimates)


def fit_over_pressure_data(
    fit: LPVFit, what: Literal["delay", "frequency", "damping", "gain"], *, sample_time: float = 2e-4
) -> list[PressurePanel]:
    """Give delays, modes or static gains with the estimates, for `plot_over_pressure` (Figs. 14 to 18).

    Parameters
    ----------
    fit : LPVFit
    what : {"delay", "frequency", "damping", "gain"}
    sample_time : float
        For delays [s].
    """
    found = dict(zip(CHARACTERISTICS, fit.characteristics[0].T, strict=True))
    points = fit.estimates.points
    speeds = [float(speed) for speed in np.unique(points[:, 1])]
    if what == "delay":
        estimates = {name: found[name] for name in ("tau_x", "tau_y")}
        return delays_data(fit.model, sample_time=sample_time, speeds_rpm=speeds, points=points, estimates=estimates)
    if what == "gain":
        estimates = {f"g_{pair}": found[f"g_{pair}"] for pair in _PAIRS}
        return static_gains_data(fit.model, speeds_rpm=speeds, points=points, estimates=estimates)
    estimates = {f"{what}_{i}": found[f"{_MODES[what]}_{i}"] for i in (1, 2)}
    return modes_data(fit.model, what, speeds_rpm=speeds, points=points, estimates=estimates)


def impact_data(open_loop: ImpactStudy, closed_loop: ImpactStudy, axis: Literal["x", "y"]) -> ImpactCurves:
    """Lay the first impact of either loop over each other, for `plot_impact` (Figs. 22, 23, 26, 27).

    Parameters
    ----------
    open_loop, closed_loop : ImpactStudy
        At the same operating point.
    axis : {"x", "y"}

    Returns
    -------
    ImpactCurves
        Positions as measured, less their offset: unbalance and run-out are in them. Time counts from the impact.

    Raises
    ------
    UsageError
        When a loop was not hit along this axis.
    """
    found = {"open loop": validation_along(open_loop, axis), "closed loop": validation_along(closed_loop, axis)}
    j = "xy".index(axis)
    starts = {label: max(0, v.windows[0][0] - _BEFORE) for label, v in found.items()}
    first = found["open loop"]
    length = min(first.windows[0][1] - starts["open loop"], *(_until_next(v) - starts[k] for k, v in found.items()))
    parts = {label: slice(start, start + length) for label, start in starts.items()}
    return ImpactCurves(
        first.time[parts["open loop"]] - first.time[first.windows[0][0]],
        {label: v.measured[parts[label], j] for label, v in found.items()},
        {label: v.force[parts[label], j] for label, v in found.items()},
        axis,
        point_label(open_loop.conditions["pressure_bar"], open_loop.conditions["speed_rpm"]),
    )


def impact_validation_data(study: ImpactStudy, axis: Literal["x", "y"]) -> ImpactCurves:
    """Lay measured and simulated response to the first impact over each other, for `plot_impact` (Figs. 24, 25).

    Parameters
    ----------
    study : ImpactStudy
    axis : {"x", "y"}

    Returns
    -------
    ImpactCurves
        Without what turns with the shaft.

    Raises
    ------
    UsageError
        When nothing hit along this axis.
    """
    v, j = validation_along(study, axis), "xy".index(axis)
    part = slice(max(0, v.windows[0][0] - _BEFORE), v.windows[0][1])
    place = point_label(study.conditions["pressure_bar"], study.conditions["speed_rpm"])
    measured = v.measured[part, j] - v.stationary[part, j]
    return ImpactCurves(
        v.time[part] - v.time[v.windows[0][0]],
        {"measured": measured, "simulated": v.simulated[part, j]},
        {},
        axis,
        f"{place}, {study.loop} loop, fit over all impacts {v.along_percent:.1f} %",
    )


def validation_along(study: ImpactStudy, axis: str) -> ImpactValidation:
    """Return the recording of a study that was hit along an axis.

    Raises
    ------
    UsageError
        When there is none.
    """
    for validation in study.validations:
        if validation.axis == axis:
            return validation
    there = ", ".join(v.axis for v in study.validations) or "none"
    raise UsageError(f"no impact along {axis} in {study.loop} loop; there is {there}")


def piezo_data(
    curve: PiezoCurve, recording: Recording, command: str, command_channel: str | None = None
) -> PiezoStaircase:
    """Give a staircase of a piezo with its time course, for the figures A.28 and A.29.

    Parameters
    ----------
    curve : PiezoCurve
    recording : Recording
        That it was made from.
    command : str
        Signal with the voltage or the reference.
    command_channel : str, optional
        That of the position when left out.
    """
    position, _, channel = curve.channel.rpartition("_")
    source = recording.channels[command].index(command_channel or channel)
    y = recording.signal(position)[:, recording.channels[position].index(channel)]
    label = "open loop" if curve.units[0] == "V" else "PD control"
    x = recording.signal(command)[:, source]
    return piezo_staircase_data(label, recording.time, x, y, curve.units[0])


def _until_next(validation: ImpactValidation) -> int:
    """Sample at which the second impact begins, or the end."""
    return validation.windows[1][0] if len(validation.windows) > 1 else len(validation.time)
