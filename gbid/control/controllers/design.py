"""Controller design: structure, gains, sampling and provenance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite

from gbid.brief import Brief
from gbid.control.controllers.scheduled import Scheduled, controller_at
from gbid.control.loop.sampling import Method, sample_controller
from gbid.errors import UsageError
from gbid.structure import LinearModel
from gbid.structure.linear import Structure

Point = tuple[float, float]


@dataclass(frozen=True, eq=False)
class ControllerDesign(Brief):
    """Designed controller, as `load_controller` returns it.

    Parameters
    ----------
    name : str
        Name of the design.
    structure : Structure or Scheduled, optional
        Structure of the controller. None for a user-defined structure that was not given when the file was read.
    gains : dict of str to float
        Gains, or coefficients of scheduled gains.
    sample_time : float
        Sample time T_s of the sampled controller [s].
    method : {"tustin", "zoh"}
        Method of discretisation.
    units : dict of str to str
        Unit of each gain.
    plant : str
        Name of the model for which it was designed.
    provenance : dict of str to str or float
        Additional information, such as limits, value reached, program and date.
    models : dict of (pressure_bar, speed_rpm) or None to LinearModel
        Stored continuous models: one under None, or one per operating point of a scheduled controller.
    notes : tuple of str
        What a user should know about the file from which it was loaded: that it was changed by hand.

    Raises
    ------
    UsageError
        When the sample time is not positive, or when the method is unknown.
    """

    name: str
    structure: Structure | Scheduled | None
    gains: Mapping[str, float]
    sample_time: float = 2e-4
    method: Method = "tustin"
    units: Mapping[str, str] = field(default_factory=dict)
    plant: str = ""
    provenance: Mapping[str, str | float] = field(default_factory=dict)
    models: Mapping[Point | None, LinearModel] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not (isfinite(self.sample_time) and self.sample_time > 0):
            raise UsageError(
                f"controller {self.name!r}: sample_time = {self.sample_time} s; give a positive number of seconds"
            )
        if self.method not in ("tustin", "zoh"):
            raise UsageError(f"controller {self.name!r}: method = {self.method!r}; choose 'tustin' or 'zoh'")

    def at(self, pressure_bar: float | None = None, speed_rpm: float | None = None) -> LinearModel:
        """Return the continuous controller.

        Parameters
        ----------
        pressure_bar, speed_rpm : float, optional
            Operating point [bar], [rpm]; required for a scheduled controller, ignored by others.

        Returns
        -------
        LinearModel

        Raises
        ------
        UsageError
            When a scheduled controller gets no point, a point outside its domain, or, without its structure, a point
            that is not stored.
        """
        point = None if pressure_bar is None or speed_rpm is None else (float(pressure_bar), float(speed_rpm))
        if self.structure is None:
            for key in (point, None):
                if key in self.models:
                    return self.models[key]
            raise UsageError(
                f"controller {self.name!r}: no model is stored for operating point {point}; give its structure: "
                "load_controller(path, structure=...)"
            )
        if point is None:
            if isinstance(self.structure, Scheduled):
                raise UsageError(
                    f"controller {self.name!r}: its gains follow the operating point; give pressure_bar and speed_rpm"
                )
            point = (0.0, 0.0)
        return controller_at(self.structure, self.gains, *point)

    def sampled_at(self, pressure_bar: float | None = None, speed_rpm: float | None = None) -> LinearModel:
        """Return the controller discretised by its own method at its own sample time; see `at`.

        Parameters
        ----------
        pressure_bar, speed_rpm : float, optional
            As for `at`.
        """
        return sample_controller(self.at(pressure_bar, speed_rpm), self.sample_time, self.method)
