"""Schema of an experiment YAML: keys, types and ranges. Checks across sections are in `checks`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from gbid.experiment.fields import Name, Section, Text, given
from gbid.experiment.stages.crossval.schema import CrossvalSection
from gbid.experiment.stages.cycle.schema import CycleSection
from gbid.experiment.stages.excite.schema import ExciteSection
from gbid.experiment.stages.figures.schema import FigureSection
from gbid.experiment.stages.fit.schema import FitSection
from gbid.experiment.stages.impact.schema import ImpactsSection
from gbid.experiment.stages.importing.schema import ImportSection
from gbid.experiment.stages.lpv.schema import LpvSection
from gbid.experiment.stages.nominal.schema import NominalSection
from gbid.experiment.stages.prefilter.schema import PrefilterSection
from gbid.experiment.stages.rig.schema import RigSection
from gbid.experiment.stages.static.schema import StaticSection
from gbid.experiment.stages.target.schema import TargetSection
from gbid.experiment.stages.tune.schema import ControllerSection


class ExperimentFile(Section):
    """Whole experiment file."""

    format: Literal[1]
    name: Name
    title: str = ""
    results: Text | None = None
    rig: Annotated[RigSection | None, BeforeValidator(given)] = None
    imported: Annotated[ImportSection | None, BeforeValidator(given)] = Field(default=None, alias="import")
    prefilter: Annotated[PrefilterSection | None, BeforeValidator(given)] = None
    static: dict[Name, StaticSection] = Field(default_factory=dict)
    fits: dict[Name, FitSection] = Field(default_factory=dict)
    excite: dict[Name, ExciteSection] = Field(default_factory=dict)
    crossval: dict[Text, CrossvalSection] = Field(default_factory=dict)
    nominal: Annotated[NominalSection | None, BeforeValidator(given)] = None
    lpv: Annotated[LpvSection | None, BeforeValidator(given)] = None
    controller: dict[Name, ControllerSection] = Field(default_factory=dict)
    target: Annotated[TargetSection | None, BeforeValidator(given)] = None
    impacts: Annotated[ImpactsSection | None, BeforeValidator(given)] = None
    cycle: Annotated[CycleSection | None, BeforeValidator(given)] = None
    figures: dict[Text, FigureSection] = Field(default_factory=dict)
