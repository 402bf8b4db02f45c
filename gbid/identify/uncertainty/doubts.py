"""Notes on standard deviations that one should not rely on."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.identify.uncertainty.covariance import Covariance

_INVOLVED = 0.1  # smallest share of a parameter in a direction, of the largest share, for which it is named
_FAR_BELOW = 1 / 3  # ratio of the standard deviations below which a note says so


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
    own = np.flatnonzero(open_sign)
    size = np.abs(values[own])
    _, axes = np.linalg.eigh(white[np.ix_(own, own)] / np.outer(size, size))
    notes, told = [], np.zeros(len(own), bool)
    for direction in axes.T[::-1]:
        strong = np.abs(direction) > _INVOLVED * np.abs(direction).max()
        if told[strong].all():
            continue
        told |= strong
        involved = names[own[strong]]
        times = float((sigma[own] / size)[strong].max())
        if len(involved) == 1:
            notes.append(
                f"the data leave even the sign of {involved[0]} open: its standard deviation for white errors is "
                f"{times:.2g} times its size"
            )
        else:
            step = direction[strong] * size[strong]
            along = " : ".join(f"{part:.2g}" for part in step / step[np.argmax(np.abs(direction[strong]))])
            notes.append(
                f"the data leave even the sign of {', '.join(involved)} open: their standard deviations for white "
                f"errors are up to {times:.2g} times their sizes, along {along}; fix one (fixed=...), or state "
                "what is known (prior=...)"
            )
    return notes


def far_below_white(found: Covariance, names: npt.NDArray[np.str_]) -> list[str]:
    """Return a note on parameters whose robust standard deviation is far below the one for white errors."""
    white, robust = (np.sqrt(np.maximum(np.diag(c), 0.0)) for c in (found.white, found.robust))
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = robust / white
    low = np.flatnonzero(np.isfinite(ratio) & (white > 0) & (ratio < _FAR_BELOW))
    if not len(low):
        return []
    return [
        f"standard deviations far below those for white errors (down to {float(ratio[low].min()):.2g} of them): "
        f"{', '.join(names[low])}; they hold only if the errors have hardly any power where these parameters act, as "
        "the residuals say; std_with('white') is the careful choice"
    ]
