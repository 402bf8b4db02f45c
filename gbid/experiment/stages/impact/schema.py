"""Schema of the impacts section: hammer impacts on the rig, in open and closed loop."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, Strict

from gbid.experiment.fields import Count, CountOrZero, Name, NotNegative, Positive, Section, Text


class ImpactPoint(Section):
    """Operating point at which the rotor is hit."""

    pressure_bar: Positive
    speed_rpm: NotNegative


class HammerTrain(Section):
    """Impacts along each axis, and how their ring-downs are fitted.

    `repeats` is the number of impacts in a recording, `spacing_s` the time between them.
    """

    axes: Annotated[tuple[Literal["x", "y"], ...], Field(min_length=1)] = ("x", "y")
    peak_n: Positive = 12.0
    impact_s: Positive = 2e-3
    repeats: Count = 5
    spacing_s: Positive = 0.4
    harmonics: CountOrZero | None = None
    lags: Annotated[int, Strict(), Field(ge=0, le=6)] | Literal["auto"] = "auto"


class ImpactsSection(HammerTrain):
    """Hammer impacts with and without a controller (paper, Sec. 5.1); see `gbid.fit_ringdown`, `gbid.validate_impact`.

    `controller`: ``paper`` is the controller in the model file of the rig, ``tuned`` the design of the
    section controller (``tuned:NAME`` when there are several), else a controller file.
    `beside`: further closed loops by name, each with a controller written in the same way.
    `model`: model that predicts the modes: a name, a file, or ``lpv`` for the surfaces of this experiment;
    the model of the rig when left out. `repeats` is the number of impacts in a recording, `spacing_s` the time between
    them.
    """

    controller: Text = "paper"
    beside: dict[Name, Text] = Field(default_factory=dict)
    model: Text | None = None
    operating_points: Annotated[tuple[ImpactPoint, ...], Field(min_length=1)]
    loops: Annotated[tuple[Literal["open", "closed"], ...], Field(min_length=1)] = ("open", "closed")
