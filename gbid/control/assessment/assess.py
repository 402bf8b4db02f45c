"""Assessment of a control design: performance figures at each operating point and their worst values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gbid.brief import Brief, Description, brief
from gbid.control.assessment.point_assessment import FIGURES, LOWEST_IS_WORST, PointAssessment, assess_point
from gbid.control.controllers.scheduled import Scheduled
from gbid.control.controllers.structures import controller_structure
from gbid.control.impact.half_sine import HalfSine
from gbid.control.loop.sampling import Method
from gbid.errors import UsageError
from gbid.extras import data_frame
from gbid.lpv import LPVModel
from gbid.operating_point import point_label
from gbid.structure.linear import Structure


@dataclass(frozen=True)
class Assessment(Brief):
    """Performance figures of a design over its operating points.

    Attributes
    ----------
    name : str
        Name of the design.
    structure : str
        Name of the structure of the controller.
    gains : dict of str to float
        Gains by name.
    points : tuple of PointAssessment
        Figures at each operating point, in the given order.
    sample_time : float
        Sample time of the sampled loop [s].
    computation_s : float
        Computation time of the sampled loop [s].
    method : str
        Method by which the controller was discretised.
    impact : HalfSine
        The reference impact, applied along x and along y.
    """

    name: str
    structure: str
    gains: Mapping[str, float]
    points: tuple[PointAssessment, ...]
    sample_time: float
    computation_s: float
    method: str
    impact: HalfSine

    def _brief(self) -> Description:
        worst = {
            name: f"{value:.5g} at {point_label(point.pressure_bar, point.speed_rpm)}"
            for name, (value, point) in self.worst.items()
        }
        about = (
            f"{self.name or self.structure}, {len(self.points)} operating points, {'' if self.stable else 'not '}stable"
        )
        return brief(self, about, gains=self.gains, **worst)

    def to_frame(self) -> Any:
        """Return the figures as a data frame, a row for each operating point.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        rows = [{"pressure_bar": p.pressure_bar, "speed_rpm": p.speed_rpm, **p.figures()} for p in self.points]
        return data_frame({name: [row[name] for row in rows] for name in rows[0]})

    @property
    def stable(self) -> bool:
        """Whether the continuous loop is stable at all operating points."""
        return all(point.stable for point in self.points)

    @property
    def worst(self) -> dict[str, tuple[float, PointAssessment]]:
        """Worst value of each of `FIGURES`, and the point where it occurs."""
        found = {}
        for name in FIGURES:
            entries = [(point.figures()[name], point) for point in self.points]
            found[name] = (min if name in LOWEST_IS_WORST else max)(entries, key=lambda entry: entry[0])
        return found


def assess(
    lpv: LPVModel,
    controller: str | Structure,
    gains: Mapping[str, float],
    points: Sequence[tuple[float, float]] | None = None,
    *,
    name: str = "",
    sample_time: float = 2e-4,
    computation_s: float | None = None,
    method: Method = "tustin",
    impact: HalfSine | None = None,
    piezo_travel_m: float | None = None,
) -> Assessment:
    """Return the performance figures of a design over operating points.

    Parameters
    ----------
    lpv : LPVModel
        Model with actuators.
    controller : str or Structure
        ``"P"``, ``"PD"`` or ``"biquad"`` with default options, or a structure from `controller_structure` or
        `scheduled`, or your own.
    gains : dict of str to float
        A value for every parameter of the structure.
    points : sequence of (pressure_bar, speed_rpm), optional
        Operating points; by default those of the model.
    name : str
        Name of the design, for tables; by default that of the structure.
    sample_time : float
        Sample time of the sampled loop [s].
    computation_s : float, optional
        Time from the sample of p to the change of r [s]; one sample when not given.
    method : {"tustin", "zoh"}
        Method by which the controller is discretised.
    impact : HalfSine, optional
        Reference impact, along x and along y; by default that of `HalfSine`.
    piezo_travel_m : float, optional
        Whole travel of one stack [m]; by default that in the model, or 45 um when the model does not give it.

    Returns
    -------
    Assessment
        Figures of the continuous loop with the Pade delays of the model, and of the sampled loop with exact delays.

    Raises
    ------
    UsageError
        When the model has no actuators or no points, when a point lies outside its domain, or when gains do not fit.
    """
    structure = controller if isinstance(controller, Scheduled) else controller_structure(controller)
    chosen = tuple(lpv.operating_points if points is None else points)
    if not chosen:
        raise UsageError(f"assess: no operating points; give points=[(pressure_bar, speed_rpm), ...] for {lpv.name!r}")
    impact = impact or HalfSine()
    computation = sample_time if computation_s is None else computation_s
    if piezo_travel_m is None:
        piezo_travel_m = lpv.rig["piezo_travel"].to("m") if "piezo_travel" in lpv.rig else 45e-6
    conditions = sample_time, computation, method, impact, piezo_travel_m
    results = tuple(assess_point(lpv, structure, gains, (float(bar), float(rpm)), *conditions) for bar, rpm in chosen)
    return Assessment(
        name or structure.name, structure.name, dict(gains), results, sample_time, computation, method, impact
    )
