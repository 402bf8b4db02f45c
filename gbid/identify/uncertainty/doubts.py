"""Notes on standard deviations that one should not rely on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from gbid.core.arrays import BoolArray, FloatArray
from gbid.core.notes import FitNote
from gbid.identify.data import Record, column_means
from gbid.identify.problem.nlp import Shooting
from gbid.identify.status import FitStatus
from gbid.identify.uncertainty.coloured import ErrorModel
from gbid.identify.uncertainty.covariance import Covariance

_INVOLVED = 0.1  # smallest share of a parameter in a direction, of the largest share, for which it is named
_PEAK = 5.0  # power of the errors at the frequency of a mode, over their mean power, for which they hide its motion
_DECAYS = 25.0  # times that a mode decays in all records, below which its slow errors are seen too seldom
_HARDLY_ONE = 2.0  # times of decay below which the records do not show whether the errors move the mode
_LIGHT = 0.1  # damping factor below which a mode counts as lightly damped
_FREQUENCIES = 2048  # for the mean power
_FAR_BELOW = 1 / 3  # ratio of the standard deviations below which a note says so

_MOST_DIRECTIONS = 3  # largest number of undetermined directions that are listed one by one


def not_determined(directions: FloatArray, names: npt.NDArray[np.str_]) -> list[str]:
    """Return notes on directions (n_directions, n) without information: their parameters, and what is determined."""
    if len(directions) > _MOST_DIRECTIONS:
        text = f"the information is singular in {len(directions)} directions: no standard deviations"
        return [FitNote.NOT_DETERMINED(text)]
    notes = []
    for direction in directions:
        strong = np.flatnonzero(np.abs(direction) > _INVOLVED * np.abs(direction).max())
        involved = ", ".join(names[strong])
        if len(strong) == 1:
            text = f"the data do not determine {involved}: its input or state is not excited; fix it (fixed=...)"
        else:
            text = f"the data do not determine {involved} separately, only a combination; fix one (fixed=...)"
        notes.append(FitNote.NOT_DETERMINED(text))
    return notes


def hardly_determined(values: FloatArray, white: FloatArray, names: npt.NDArray[np.str_]) -> list[str]:
    """Return notes on the directions whose standard deviation for white errors exceeds the size of the parameters.

    Parameters
    ----------
    values : (n,) array
        Estimates.
    white : (n, n) array
        Their covariance for white errors.
    names : (n,) array of str
        Their names.

    Returns
    -------
    list of str
        One note for each direction.

    Notes
    -----
    The directions are the eigenvectors of the covariance relative to the estimates with eigenvalues above one. Along
    such a direction the sign of the estimates is open, however small the errors of the model are.
    """
    sigma = np.sqrt(np.maximum(np.diag(white), 0.0))
    open_sign = np.isfinite(sigma) & (sigma > np.abs(values)) & (values != 0)
    if not open_sign.any():
        return []
    chosen = np.flatnonzero(open_sign)
    size = np.abs(values[chosen])
    _, axes = np.linalg.eigh(white[np.ix_(chosen, chosen)] / np.outer(size, size))
    notes, told = [], np.zeros(len(chosen), bool)
    for direction in axes.T[::-1]:
        strong = np.abs(direction) > _INVOLVED * np.abs(direction).max()
        if told[strong].all():
            continue
        told |= strong
        involved = names[chosen[strong]]
        times = float((sigma[chosen] / size)[strong].max())
        if len(involved) == 1:
            text = (
                f"the data leave even the sign of {involved[0]} open: its standard deviation for white errors is "
                f"{times:.2g} times its size"
            )
        else:
            step = direction[strong] * size[strong]
            along = " : ".join(f"{part:.2g}" for part in step / step[np.argmax(np.abs(direction[strong]))])
            text = (
                f"the data leave even the sign of {', '.join(involved)} open: their standard deviations for white "
                f"errors are up to {times:.2g} times their sizes, along {along}; fix one (fixed=...), or state "
                "what is known (prior=...)"
            )
        notes.append(FitNote.SIGN_OPEN(text))
    return notes


def far_below_white(estimate: Covariance, names: npt.NDArray[np.str_]) -> list[str]:
    """Return a note on parameters with a robust standard deviation far below that for white errors."""
    white, robust = (np.sqrt(np.maximum(np.diag(c), 0.0)) for c in (estimate.white, estimate.robust))
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = robust / white
    low = np.flatnonzero(np.isfinite(ratio) & (white > 0) & (ratio < _FAR_BELOW))
    if not len(low):
        return []
    text = (
        f"standard deviations far below those for white errors (down to {float(ratio[low].min()):.2g} of them): "
        f"{', '.join(names[low])}; they hold only if the errors have hardly any power where these parameters act, as "
        "the residuals say; std_with('white') is the careful choice"
    )
    return [FitNote.FAR_BELOW_WHITE(text)]


def may_cover_less(
    models: Sequence[ErrorModel], modes: Sequence[tuple[float, float]], sample_time: float, n_samples: int
) -> list[str]:
    """Return a note on intervals that contain the truth less often than they state.

    Parameters
    ----------
    models : sequence of ErrorModel
        Model of the errors of each record.
    modes : sequence of (frequency [Hz], damping factor)
        Modes of the structure at the estimate.
    sample_time : float
        Time between samples [s].
    n_samples : int
        Number of samples of all records.

    Notes
    -----
    The study of docs/uncertainty.md has low coverage where two things come together: the errors have a peak at the
    frequency of a lightly damped mode, and the records last few of its times of decay. Then the fit explains a part of
    the errors as motion of the mode, and what is left says little of them. Below about one time of decay hardly a peak
    is left, so that any power above the mean counts.
    """
    grid = np.pi * (np.arange(_FREQUENCIES) + 0.5) / _FREQUENCIES
    coloured = [model for model in models if model.order]
    power = [np.diagonal(model.spectrum(grid), axis1=1, axis2=2).real.mean(axis=0) for model in coloured]
    told = []
    for frequency, damping in modes:
        if not 0 < damping < _LIGHT:
            continue
        decays = 2 * np.pi * frequency * damping * sample_time * n_samples
        turn = np.array([2 * np.pi * frequency * sample_time * np.sqrt(1 - damping**2)])
        peaks = [
            float((np.diagonal(model.spectrum(turn)[0]).real / mean).max())
            for model, mean in zip(coloured, power, strict=True)
        ]
        if decays < _DECAYS and max(peaks, default=0.0) > (1.0 if decays < _HARDLY_ONE else _PEAK):
            text = (
                f"intervals may contain the truth less often than they state: at the mode of {frequency:.3g} Hz the "
                f"errors have {max(peaks):.2g} times their mean power, and the recordings last {decays:.2g} of its "
                "times of decay; record longer, or free a disturbance gain"
            )
            told.append(FitNote.MAY_COVER_LESS(text))
    return told


# ---- Verdict on a fit: whether what the solver calls converged is an estimate.

_WORSE = 0.01  # part by which the loss may exceed that of a constant: its mean takes a little of the noise along
_OF_A_MEAN = 10.0  # the same for short records, over the number of samples


def explains_nothing(problem: Shooting, products: FloatArray, outputs: list[FloatArray]) -> bool:
    """Return whether the fit is worse than the mean of each record.

    Parameters
    ----------
    problem : Shooting
        Problem of the fit, for its criterion.
    products : (n_y, n_y) array
        Sum of the products of the errors.
    outputs : list of (n_samples, n_y) array
        Outputs of each record that are in the cost.
    """
    centred = [y - column_means(y) for y in outputs if len(y)]
    constant = problem.cost(np.asarray(sum(y.T @ y for y in centred)))
    cost = problem.cost(products)
    return not cost <= constant + 0.5 * float(np.log1p(_WORSE + _OF_A_MEAN / problem.n_samples))


def verdict(
    status: FitStatus, *, overflows: bool, worse_than_constant: bool, at_edge: bool, undetermined: BoolArray
) -> FitStatus:
    """Return the status of a fit, which is a success only for an estimate.

    The solver has checked the first-order optimality already (`gbid.identify.problem.solve`).

    Parameters
    ----------
    status : FitStatus
        Status of the solver.
    overflows : bool
        Whether the errors or the parameters are not finite.
    worse_than_constant : bool
        Result of `explains_nothing`.
    at_edge : bool
        Whether the disturbance gain makes a predictor unstable or almost so, see `Shooting.parts_at_edge`.
    undetermined : (n_free,) boolean array
        Free parameters without a finite standard deviation that lie on no bound.
    """
    if overflows:
        return FitStatus.OVERFLOW
    if not status.success:
        return status
    if worse_than_constant:
        return FitStatus.WORSE_THAN_CONSTANT
    if at_edge:
        return FitStatus.UNSTABLE_PREDICTOR
    return FitStatus.NOT_DETERMINED if undetermined.any() else status


# ---- Test whether the errors of a fit come back in its inputs, as through a controller.

_PAST_INPUTS, _PAST_ERRORS = 12, 4  # lags of the regressions
_AT_ONCE = 1024  # rows
_MOST = 8192  # samples of a record that are enough
_SHARE = 0.02  # smallest share of what is new in an input that the errors must explain
_CERTAIN = 50.0  # the same times the number of samples: far beyond chance for a few regressors


def share_of_feedback(record: Record, errors: FloatArray) -> float:
    """Return the share of an input's innovation that past errors explain, the largest of all inputs.

    Parameters
    ----------
    record : Record
        Inputs of the fit.
    errors : (n_samples, n_outputs) array
        Errors of the one-step prediction or of the simulation.

    Returns
    -------
    float
        Between 0 and 1; 0 where nothing is significant.

    Notes
    -----
    Errors of the model depend on past inputs. What is new in an input is therefore tested: the part that past inputs do
    not predict. Without feedback past errors cannot predict it either (Granger, Econometrica 37, 1969).
    """
    n = min(record.n_samples, len(errors), _MOST)
    u, e = record.inputs[:n] - record.inputs[:n].mean(axis=0), errors[:n]
    begin = max(_PAST_INPUTS, _PAST_ERRORS)
    columns = (_PAST_INPUTS * u.shape[1], _PAST_ERRORS * e.shape[1])
    if n - begin < 4 * sum(columns) or not u.any():
        return 0.0
    now = u / np.maximum(u[begin:].std(axis=0), np.finfo(float).tiny)
    past = [(u, lag) for lag in range(1, _PAST_INPUTS + 1)] + [(e, lag) for lag in range(1, _PAST_ERRORS + 1)]
    triangle = np.zeros((0, sum(columns) + u.shape[1]))
    for first in range(begin, n, _AT_ONCE):  # QR decomposition of all rows, some at a time
        last = min(first + _AT_ONCE, n)
        rows = np.hstack([*(signal[first - lag : last - lag] for signal, lag in past), now[first:last]])
        triangle = np.asarray(np.linalg.qr(np.vstack([triangle, rows]), mode="r"))
    # In the columns of an input, the rows below those of some regressors are what these leave of it.
    squares = triangle[:, sum(columns) :] ** 2
    new, left = (squares[above:].sum(axis=0) for above in (columns[0], sum(columns)))
    share = 1 - left / np.where(new > 0, new, 1.0)
    largest = float(np.max(share[new > 1e-9 * (n - begin)], initial=0.0))  # known from its past: left out
    return largest if largest * (n - begin) > _CERTAIN * columns[1] / 8 else 0.0


def feedback_notes(records: Sequence[Record], errors: Sequence[FloatArray]) -> tuple[str, ...]:
    """Return a note when errors that are not white come back in the inputs, none otherwise."""
    share = max((share_of_feedback(record, e) for record, e in zip(records, errors, strict=True)), default=0.0)
    if share < _SHARE:
        return ()
    text = (
        f"past errors explain {100 * share:.0f} % of what is new in an input, as through a controller, and they are "
        "not white: the estimates have a bias; free a disturbance gain (focus='prediction'), or fit a ClosedLoop"
    )
    return (FitNote.FEEDBACK(text),)
