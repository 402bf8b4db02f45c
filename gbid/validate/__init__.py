"""Validation: fit percent, cross-validation, residual tests."""

from gbid.validate.crossval import Validation, cross_validate, estimate_initial_state
from gbid.validate.fit_percent import fit_percent
from gbid.validate.residuals import ResidualTest, check_residuals

__all__ = [
    "ResidualTest",
    "Validation",
    "check_residuals",
    "cross_validate",
    "estimate_initial_state",
    "fit_percent",
]
