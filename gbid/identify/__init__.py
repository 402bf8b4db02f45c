"""Identification: start values, predictor, shooting windows, solver, covariance, result."""

from gbid.identify.data import select
from gbid.identify.fit import FitProblem, fit, fit_problem
from gbid.identify.multistart import Minimum, MultiStart, fit_multistart
from gbid.identify.options import FitOptions, SettledOptions
from gbid.identify.problem.solve import Progress
from gbid.identify.result import FitResult, FitStatus, StartsTried, load_fit, save_fit
from gbid.identify.table import FitTable, TableEntry, load_table, save_table, tabulate
from gbid.identify.uncertainty.coloured import Whiteness, correlation, whiteness_test
from gbid.identify.uncertainty.curves import Bode, PoleZero, TimeResponse, bode, pole_zero, time_response
from gbid.identify.uncertainty.spectra import DelayEstimate, MeasuredResponse, estimate_delay, measured_response
from gbid.identify.uncertainty.uncertain_model import ModelLike, ModelSlopes, UncertainModel

__all__ = [
    "Bode",
    "DelayEstimate",
    "FitOptions",
    "FitProblem",
    "FitResult",
    "FitStatus",
    "FitTable",
    "MeasuredResponse",
    "Minimum",
    "ModelLike",
    "ModelSlopes",
    "MultiStart",
    "PoleZero",
    "Progress",
    "SettledOptions",
    "StartsTried",
    "TableEntry",
    "TimeResponse",
    "UncertainModel",
    "Whiteness",
    "bode",
    "correlation",
    "estimate_delay",
    "fit",
    "fit_multistart",
    "fit_problem",
    "load_fit",
    "load_table",
    "measured_response",
    "pole_zero",
    "save_fit",
    "save_table",
    "select",
    "tabulate",
    "time_response",
    "whiteness_test",
]
