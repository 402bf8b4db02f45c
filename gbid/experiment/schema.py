"""What an experiment YAML may say: keys, types and ranges. What the parts mean together is in `checks`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, Strict

from gbid.experiment.fields import (
    Count,
    Name,
    Names,
    NotNegative,
    Number,
    Positive,
    Section,
    Switch,
    Text,
)
from gbid.experiment.schema_control import ControllerSection
from gbid.experiment.schema_fits import FitSection
from gbid.experiment.schema_impacts import ImpactsSection
from gbid.experiment.schema_import import ImportSection
from gbid.experiment.schema_lpv import LpvSection
from gbid.experiment.schema_rig import RigSection, given
from gbid.experiment.schema_static import StaticSection


class PrefilterSection(Section):
    """What is taken out of the excited recordings before the fits (paper, Sec. 3.5)."""

    method: Literal["harmonics", "bins", "auto", "none"] = "harmonics"
    align_index: Switch = False
    harmonics: Count = 10
    bins: Annotated[int, Strict(), Field(ge=4)] = 100
    median: Count = 3
    remove_mean: Switch = True


class CrossvalSection(Section):
    """On which recordings the models of a fit are validated (paper, Sec. 3.8).

    `on`: ``cyclic`` is model j on recording j + 1 of its operating point, the last on the first; ``others`` each model
    on all other excited recordings; ``point`` on those of its own operating point; else names of recordings.
    `residuals` are tested for all ``pairs``, for the first pair of each of the ``models``, or not at all (``none``);
    by default for all pairs when there are at most 200 of them, else once for each model.
    """

    on: Names = ("cyclic",)
    minimum_percent: Number | None = None
    residuals: Literal["pairs", "models", "none"] | None = None


class NominalSection(Section):
    """Fit whose most central model is the nominal actuator; see `gbid.nominal_actuator`."""

    fit: Name


class FigureSection(Section):
    """The part of the recording that the picture shows, and whether one of the residuals is drawn beside it."""

    from_s: NotNegative | None = None
    to_s: Positive | None = None
    residuals: Switch = False


class ExperimentFile(Section):
    """A whole experiment."""

    format: Literal[1]
    name: Name
    title: str = ""
    results: Text | None = None
    rig: Annotated[RigSection | None, BeforeValidator(given)] = None
    imported: Annotated[ImportSection | None, BeforeValidator(given)] = Field(default=None, alias="import")
    prefilter: Annotated[PrefilterSection | None, BeforeValidator(given)] = None
    static: dict[Name, StaticSection] = Field(default_factory=dict)
    fits: dict[Name, FitSection] = Field(default_factory=dict)
    crossval: dict[Text, CrossvalSection] = Field(default_factory=dict)
    nominal: Annotated[NominalSection | None, BeforeValidator(given)] = None
    lpv: Annotated[LpvSection | None, BeforeValidator(given)] = None
    controller: dict[Name, ControllerSection] = Field(default_factory=dict)
    impacts: Annotated[ImpactsSection | None, BeforeValidator(given)] = None
    figures: dict[Text, FigureSection] = Field(default_factory=dict)
