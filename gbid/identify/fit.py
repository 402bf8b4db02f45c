"""Fit of a structure to recordings: the problem posed, solved, and judged."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from gbid.core.arrays import one_blas_thread
from gbid.core.option_types import takes_options
from gbid.identify.options import FitArguments
from gbid.identify.pose import Recordings, pose
from gbid.identify.restarts import best_attempt
from gbid.identify.result import FitResult
from gbid.recording.recording import check_order
from gbid.structure import AnyStructure
from gbid.structure.parameter import asked_once


def fitted(structure: AnyStructure, recordings: Recordings, options: FitArguments) -> FitResult:
    """Return the fit of a structure to recordings; see `fit`."""
    began = time.perf_counter()
    check_order(structure, "fit(structure, recordings)")
    with asked_once():
        task = pose(structure, recordings, options)
        # Matrices are small: several BLAS threads would be slower. An unstable start overflows; the status reports it.
        with one_blas_thread(), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            result = best_attempt(task)
    return replace(result, wall_time_s=time.perf_counter() - began)


@takes_options(FitArguments)
def fit(structure: AnyStructure, recordings: Recordings, options: FitArguments) -> FitResult:
    """Return the fit of a structure to recordings by prediction errors (paper, Eq. 15) with multiple shooting.

    Parameters
    ----------
    structure : Structure or NonlinearStructure
        `RotorBearing`, `PiezoPair`, `Plant`, or a user's `LinearStructure` or `NonlinearStructure`; what
        `scheduled` makes of linear ones, for recordings in which scheduling variables change.
    recordings : Recording or sequence of Recording
        Recordings to fit. They share all parameters except those in `local`; each has its own initial state.
    **options

    Returns
    -------
    FitResult
        The result, also when the solver did not converge; see `status` and `success`.

    Raises
    ------
    UsageError
        When a name or option is unknown, bounds exclude a start value, or the matrices of the structure have wrong
        shapes.
    DataError
        When the recordings are not sufficient for the fit, or do not determine a parameter because no input moves.
    KeyboardInterrupt
        After Ctrl-C.
    """
    return fitted(structure, recordings, options)
