"""Test whether the errors of a fit come back in its inputs, as through a controller."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.data import Record
from gbid.notes.fit_notes import FitNote

_PAST_INPUTS, _PAST_ERRORS = 12, 4  # lags of the regressions
_AT_ONCE = 1024  # rows
_MOST = 8192  # samples of a record that are enough
_SHARE = 0.02  # smallest share of what is new in an input that the errors must explain
_CERTAIN = 50.0  # the same times the number of samples: far beyond chance for a few regressors


def share_of_feedback(record: Record, errors: FloatArray) -> float:
    """Return the share of what is new in the inputs that past errors explain, the largest of all inputs.

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
    found = float(np.max(share[new > 1e-9 * (n - begin)], initial=0.0))  # known from its past: left out
    return found if found * (n - begin) > _CERTAIN * columns[1] / 8 else 0.0


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
