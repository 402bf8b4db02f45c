"""Predictors over several steps."""

from __future__ import annotations

import numpy as np

from gbid.discretise.dual import Dual, constant, side_by_side


def look_ahead(
    parts: tuple[Dual, Dual, Dual, Dual], A: Dual, drive: Dual, C: Dual, feed: Dual, horizon: int
) -> tuple[Dual, Dual, Dual, Dual]:
    """Return a one-step predictor extended to a longer horizon without new measurements.

    ``yhat[k+h-1] = C A^(h-1) x[k] + sum_i C A^(h-2-i) drive z[k+i] + feed z[k+h-1]``.

    Parameters
    ----------
    parts : tuple of Dual
        ``F, G, C, H`` of the one-step predictor.
    A, drive, C, feed : Dual
        The sampled model without feedback of outputs: state, inputs to state, state to output, inputs to output.
    horizon : int
        Number of steps ``h``, at least 2.

    Returns
    -------
    tuple of Dual
        ``F, G, C, H``; regressors of the following samples are further columns.
    """
    F, G, _, _ = parts
    n_p = len(F.slope)
    n_now, n_first = drive.shape[1], G.shape[1]
    output, columns = C, [feed]  # for z[k+h-1], then backwards
    for _ in range(horizon - 1):
        columns.append(output @ drive)
        output = output @ A
    columns.reverse()
    n_y = C.shape[0]
    feedback = [constant(np.zeros((n_y, n_first - n_now)), n_p)] if n_first > n_now else []
    H = side_by_side([columns[0], *feedback, *columns[1:]])
    rest = constant(np.zeros((F.shape[0], (horizon - 1) * n_now)), n_p)
    return F, side_by_side([G, rest]), output, H
