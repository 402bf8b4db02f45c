"""Linear parameter-varying (LPV) models: polynomials over scheduling variables, their fits, and their files."""

from gbid.lpv.basis import EXPONENTS, TERMS, basis, polynomial, regressors
from gbid.lpv.characteristics import CHARACTERISTICS, Deviation, characteristics
from gbid.lpv.direct.fit_lpv_direct import fit_lpv_direct
from gbid.lpv.domain import Domain
from gbid.lpv.load import load_model, save_model
from gbid.lpv.machine_data import (
    Correction,
    PiezoController,
    PiezoControllers,
    ProportionalDesign,
    Quantity,
    ReferenceModes,
)
from gbid.lpv.model import ACTUATOR_PARAMETERS, LPVModel
from gbid.lpv.scheduled_model import ScheduledModel
from gbid.lpv.surface_fit.estimates import Estimates
from gbid.lpv.surface_fit.fit_lpv import fit_lpv
from gbid.lpv.surface_fit.from_schedule import lpv_of
from gbid.lpv.surface_fit.lpv_fit import LPVFit
from gbid.lpv.surface_fit.lpv_fit_store import load_lpv_fit, save_lpv_fit
from gbid.lpv.surface_fit.order import OrderScore
from gbid.lpv.surface_fit.outliers import Outlier
from gbid.lpv.surface_fit.scheduled_fit import ScheduledFit

__all__ = [
    "ACTUATOR_PARAMETERS",
    "CHARACTERISTICS",
    "EXPONENTS",
    "TERMS",
    "Correction",
    "Deviation",
    "Domain",
    "Estimates",
    "LPVFit",
    "LPVModel",
    "OrderScore",
    "Outlier",
    "PiezoController",
    "PiezoControllers",
    "ProportionalDesign",
    "Quantity",
    "ReferenceModes",
    "ScheduledFit",
    "ScheduledModel",
    "basis",
    "characteristics",
    "fit_lpv",
    "fit_lpv_direct",
    "load_lpv_fit",
    "load_model",
    "lpv_of",
    "polynomial",
    "regressors",
    "save_lpv_fit",
    "save_model",
]
