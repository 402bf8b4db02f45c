"""Identification: start values, predictor, shooting windows, solver, covariance, result."""

from gbid.identify.data import select
from gbid.identify.fit import fit
from gbid.identify.result import FitResult
from gbid.identify.solver import Progress
from gbid.identify.store import load_fit, save_fit

__all__ = ["FitResult", "Progress", "fit", "load_fit", "save_fit", "select"]
