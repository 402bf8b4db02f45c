"""What a fit gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gbid.structure import LinearModel

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FitResult:
    """Estimates of a fit, their uncertainty, and how they came about.

    Attributes
    ----------
    structure : str
        Name of the structure.
    recordings : tuple of str
        Names of the recordings.
    parameters : dict of str to float
        All parameters: estimated, fixed and unused.
    std : dict of str to float
        Standard deviations; 0 for a fixed parameter, nan for one that has none: on a bound, not seen by the
        focus, or not determined by the data (`notes` says which).
    units : dict of str to str
    free : tuple of str
        The estimated parameters, in the order of `covariance`.
    covariance : (n_free, n_free) array
    initial_states : (n_recordings, n_states) array
    loss : float
        Mean squared error summed over outputs, or the determinant of the errors' mean square for criterion "det".
    error_covariance : (n_outputs, n_outputs) array
        Mean square of the errors.
    fit_percent : (n_recordings, n_outputs) array
        ``100 (1 - |y - yhat| / |y - mean y|)`` for the predictions of the focus.
    status : str
        In words.
    success : bool
    iterations : int
    wall_time_s : float
        Of the whole fit, start values and covariance included.
    start : dict of str to float
        Where the parameters started.
    notes : tuple of str
        What a reader should know: bounds reached, parameters not determined.
    options : dict of str to str
        What was asked: focus, intersample, criterion, window, stop.
    model : LinearModel
        The structure at the estimates, in continuous time.
    sample_time : float
        Time between samples [s].
    """

    structure: str
    recordings: tuple[str, ...]
    parameters: Mapping[str, float]
    std: Mapping[str, float]
    units: Mapping[str, str]
    free: tuple[str, ...]
    covariance: FloatArray
    initial_states: FloatArray
    loss: float
    error_covariance: FloatArray
    fit_percent: FloatArray
    status: str
    success: bool
    iterations: int
    wall_time_s: float
    start: Mapping[str, float]
    notes: tuple[str, ...]
    options: Mapping[str, str]
    model: LinearModel
    sample_time: float
