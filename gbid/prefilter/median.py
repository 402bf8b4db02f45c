"""Running median (paper, Sec. 3.5)."""

from __future__ import annotations

import numpy as np
import scipy

from gbid.arrays import FloatArray
from gbid.errors import UsageError


def running_median(values: FloatArray, size: int) -> FloatArray:
    """Return the median over `size` neighbouring samples of each channel (paper, Sec. 3.5: size 3).

    The median removes spikes of one sample, but it has two side effects. Of white noise, size 3 leaves 45 % of the
    variance and colours it: the correlation of neighbours is 0.55, that of samples two apart is 0.26. Each crest of a
    wave of amplitude a and angular frequency w is reduced by up to a (w T)^2 / 2, which is 0.12 um of 10 um at 125 Hz
    and T = 0.2 ms. Residual tests that assume white noise detect both effects. Size 1 switches the filter off.

    Parameters
    ----------
    values : (n_samples, n_channels) array
        The signal.
    size : int
        Number of samples, odd; 1 changes nothing.

    Returns
    -------
    (n_samples, n_channels) array
        Filtered signal; the ``size // 2`` samples at each end are unchanged.

    Raises
    ------
    UsageError
        When `size` is not odd and positive, or when it is longer than the signal.
    """
    if size < 1 or size % 2 == 0:
        raise UsageError(f"median = {size}; give an odd number of samples, 1 for none")
    if size > len(values):
        raise UsageError(f"median = {size} is longer than the {len(values)} samples of the signal")
    half = size // 2
    filtered = np.array(values, dtype=float)
    if half:
        filtered[half:-half] = scipy.ndimage.median_filter(values, size=(size, 1))[half:-half]
    return filtered
