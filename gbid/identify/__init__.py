"""Identification: start values, predictor, shooting windows, solver, covariance, result."""

from gbid.identify.data import select
from gbid.identify.fit import fit
from gbid.identify.multistart import MultiStart, fit_multistart
from gbid.identify.result import FitResult
from gbid.identify.store import load_fit, save_fit
from gbid.identify.watch import Progress
from gbid.identify.whiteness import Whiteness, correlation, whiteness_test

__all__ = [
    "FitResult",
    "MultiStart",
    "Progress",
    "Whiteness",
    "correlation",
    "fit",
    "fit_multistart",
    "load_fit",
    "save_fit",
    "select",
    "whiteness_test",
]
