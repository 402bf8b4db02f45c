"""Linear parameter-varying (LPV) models: polynomials over scheduling variables, their fits, and their files."""

from gbid.lpv.direct import fit_lpv_direct
from gbid.lpv.estimates import Estimates
from gbid.lpv.fit import LPVFit, fit_lpv, load_lpv_fit, lpv_of, save_lpv_fit
from gbid.lpv.model import (
    ACTUATOR_PARAMETERS,
    CHARACTERISTICS,
    EXPONENTS,
    TERMS,
    Deviation,
    Domain,
    LPVModel,
    basis,
    characteristics,
    polynomial,
    regressors,
)
from gbid.lpv.model_file import (
    Correction,
    PiezoController,
    PiezoControllers,
    ProportionalDesign,
    PublishedMachine,
    Quantity,
    ReferenceModes,
    load_machine,
    load_model,
    save_model,
)
from gbid.lpv.regression import OrderScore, Outlier

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
    "PublishedMachine",
    "Quantity",
    "ReferenceModes",
    "basis",
    "characteristics",
    "fit_lpv",
    "fit_lpv_direct",
    "load_lpv_fit",
    "load_machine",
    "load_model",
    "lpv_of",
    "polynomial",
    "regressors",
    "save_lpv_fit",
    "save_model",
]
