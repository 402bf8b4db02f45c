"""Validation: fit percent, cross-validation and its summary, residual tests, nominal actuator."""

from gbid.validate.central import (
    ActuatorOutlier,
    NominalActuator,
    load_actuators,
    nominal_actuator,
    save_nominal_actuator,
)
from gbid.validate.crossval import (
    PointSummary,
    Validation,
    ValidationScores,
    ValidationSummary,
    WorstPair,
    cross_validate,
    cross_validate_many,
    summarise,
)
from gbid.validate.residuals import ResidualTest, ShaftLine, check_residuals, shaft_lines
from gbid.validate.simulate import estimate_initial_state, fit_percent

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
    "nominal_actuator",
    "save_nominal_actuator",
    "shaft_lines",
    "summarise",
]
