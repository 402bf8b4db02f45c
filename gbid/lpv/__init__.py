"""The linear parameter-varying model: polynomials over pressure and speed, and its files."""

from gbid.lpv.basis import EXPONENTS, TERMS, basis, polynomial, regressors
from gbid.lpv.domain import Domain
from gbid.lpv.load import load_model, save_model
from gbid.lpv.model import ACTUATOR_PARAMETERS, LPVModel
from gbid.lpv.tables import (
    Correction,
    PiezoController,
    PiezoControllers,
    ProportionalDesign,
    Quantity,
    ReferenceModes,
)

__all__ = [
    "ACTUATOR_PARAMETERS",
    "EXPONENTS",
    "TERMS",
    "Correction",
    "Domain",
    "LPVModel",
    "PiezoController",
    "PiezoControllers",
    "ProportionalDesign",
    "Quantity",
    "ReferenceModes",
    "basis",
    "load_model",
    "polynomial",
    "regressors",
    "save_model",
]
