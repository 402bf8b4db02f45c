"""Validation: fit percent, cross-validation and its summary, residual tests, nominal actuator."""

from gbid.validate.central import ActuatorOutlier, NominalActuator, nominal_actuator
from gbid.validate.crossval import Validation, cross_validate, cross_validate_many
from gbid.validate.fit_percent import fit_percent
from gbid.validate.residuals import ResidualTest, check_residuals
from gbid.validate.scores import PointSummary, ValidationScores, ValidationSummary, WorstPair, summarise
from gbid.validate.shaft_lines import ShaftLine, shaft_lines
from gbid.validate.simulator import estimate_initial_state
from gbid.validate.validation_store import (
    load_actuators,
    load_validation_summary,
    save_nominal_actuator,
    save_validation_summary,
)

__all__ = [
    "ActuatorOutlier",
    "NominalActuator",
    "PointSummary",
    "ResidualTest",
    "ShaftLine",
    "Validation",
    "ValidationScores",
    "ValidationSummary",
    "WorstPair",
    "check_residuals",
    "cross_validate",
    "cross_validate_many",
    "estimate_initial_state",
    "fit_percent",
    "load_actuators",
    "load_validation_summary",
    "nominal_actuator",
    "save_nominal_actuator",
    "save_validation_summary",
    "shaft_lines",
    "summarise",
]
