"""Validation: fit percent and cross-validation."""

from gbid.validate.crossval import Validation, cross_validate, estimate_initial_state
from gbid.validate.fit_percent import fit_percent

__all__ = ["Validation", "cross_validate", "estimate_initial_state", "fit_percent"]
