"""Identification: start values, predictor, shooting windows, solver, covariance, result."""

from gbid.identify.curves.bode import Bode, bode
from gbid.identify.curves.delay_estimate import DelayEstimate, estimate_delay
from gbid.identify.curves.measured_response import MeasuredResponse, measured_response
from gbid.identify.curves.pole_zero import PoleZero, pole_zero
from gbid.identify.curves.time_response import TimeResponse, time_response
from gbid.identify.curves.uncertain_model import ModelLike, ModelSlopes, UncertainModel
from gbid.identify.data import select
from gbid.identify.fit import fit
from gbid.identify.fit_store import load_fit, save_fit
from gbid.identify.multistart import Minimum, MultiStart, fit_multistart
from gbid.identify.nlp.watch import Progress
from gbid.identify.options import FitOptions
from gbid.identify.problem.fit_problem import FitProblem, fit_problem
from gbid.identify.result import FitResult, StartsTried
from gbid.identify.status import FitStatus
from gbid.identify.table.fit_table import FitTable
from gbid.identify.table.table_store import load_table, save_table
from gbid.identify.table.tabulate import TableEntry, tabulate
from gbid.identify.uncertainty.whiteness import Whiteness, correlation, whiteness_test

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
