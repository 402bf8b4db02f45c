"""What an experiment YAML may say of hammer impacts on the rig, open and closed loop."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, Strict

from gbid.experiment.fields import Count, CountOrZero, Name, NotNegative, Positive, Section, Text


class ImpactPoint(Section):
    """Where the machine is hit."""

    pressure_bar: Positive
    speed_rpm: NotNegative


class ImpactsSection(Section):
    """Hammer impacts with and without a controller (paper, Sec. 5.1); see `gbid.fit_ringdown`, `gbid.validate_impact`.

    `controller`: ``paper`` is the one in the rig's model file, ``tuned`` the design of the
    section controller (``tuned:NAME`` of several), else a controller file.
    `beside`: further closed loops by name, each with a controller in the same words.
    `model`: what the modes are expected from: a model's name or file, or ``lpv`` for the surfaces of this experiment;
    the rig's own when left out. `repeats` is the number of impacts in a recording, `spacing_s` the time between them.
    """

    controller: Text = "paper"
    beside: dict[Name, Text] = Field(default_factory=dict)
    model: Text | None = None
    operating_points: Annotated[tuple[ImpactPoint, ...], Field(min_length=1)]
    loops: Annotated[tuple[Literal["open", "closed"], ...], Field(min_length=1)] = ("open", "closed")
    axes: Annotated[tuple[Literal["x", "y"], ...], Field(min_length=1)] = ("x", "y")
    peak_n: Positive = 12.0
    impact_s: Positive = 2e-3
    repeats: Count = 5
    spacing_s: Positive = 0.4
    harmonics: CountOrZero | None = None
    lags: Annotated[int, Strict(), Field(ge=0, le=6)] | Literal["auto"] = "auto"
