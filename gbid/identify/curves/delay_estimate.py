"""Delay between two signals, from the correlation of the output with the whitened input."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.brief import Brief, Description, brief
from gbid.errors import DataError, UsageError
from gbid.identify.data import select
from gbid.recording import Recording

_ORDER = 30  # largest order of the whitening filter
_LEVEL = 4.0  # smallest correlation that counts, in standard deviations: by chance one in 16 000 lags


@dataclass(frozen=True, eq=False)
class DelayEstimate(Brief):
    """Delay from an input to an output, by correlation.

    Attributes
    ----------
    delay_s : float
        Largest delay that the correlation allows [s]: the output has not begun to move before.
    lag : int
        First lag at which the output follows the input [samples]. An input that is held between samples reaches the
        next sample at the earliest, so that ``delay_s`` is ``lag - 1`` samples.
    lags : (n,) array
        Lags [samples].
    correlation : (n,) array
        Correlation of the whitened input with the output that was filtered in the same way. It has the shape of the
        impulse response.
    limit : float
        Absolute value above which a correlation counts.
    input_name, output_name : str
        Names of the channels.
    """

    delay_s: float
    lag: int
    lags: FloatArray
    correlation: FloatArray
    limit: float
    input_name: str
    output_name: str

    def _brief(self) -> Description:
        about = f"{self.input_name} to {self.output_name}, {self.delay_s:.6g} s ({self.lag - 1} samples)"
        return brief(self, about, lag=self.lag, limit=self.limit)


def estimate_delay(
    recording: Recording, input: str = "u", output: str = "y", *, longest_s: float | None = None
) -> DelayEstimate:
    """Return the delay from an input to an output, by the correlation of the output with the whitened input.

    Parameters
    ----------
    recording : Recording
        Recording in open loop, in which the input moves.
    input, output : str
        One signal or channel (``"p.x"``) each.
    longest_s : float, optional
        Longest delay that is looked for [s]; by default a tenth of the recording.

    Returns
    -------
    DelayEstimate
        Delay in whole samples. The delay lies in the sample that begins there, or earlier when the output begins so
        slowly that its beginning is lost in the noise. A fit with an exact delay (``B_delayed`` and ``delay``) gives
        the rest.

    Raises
    ------
    DataError
        When the recording lacks a signal or the output does not follow the input.
    UsageError
        When a name stands for several channels, or the longest delay is not positive.

    Notes
    -----
    An autoregression makes the input white, and the same filter is applied to the output. Their correlation is then the
    impulse response up to a factor (Box and Jenkins, Time Series Analysis, Sec. 11.2). Without a connection its
    standard deviation is one over the root of the number of samples.
    """
    (u, u_name), (y, y_name) = (_one_channel(recording, name) for name in (input, output))
    n = len(u)
    most = n // 10 if longest_s is None else round(longest_s / recording.sample_time)
    if most < 1 or most > n // 2:
        half = n * recording.sample_time / 2
        raise UsageError(f"longest_s = {longest_s}: choose between one sample and half of the recording, {half:g} s")
    order = min(_ORDER, n // 20)
    past = np.column_stack([u[order - i : n - i] for i in range(1, order + 1)])
    weights = np.linalg.lstsq(past, u[order:], rcond=1e-8)[0]
    white = u[order:] - past @ weights
    follow = y[order:] - np.column_stack([y[order - i : n - i] for i in range(1, order + 1)]) @ weights
    white, follow = white - white.mean(), follow - follow.mean()
    size = float(np.linalg.norm(white) * np.linalg.norm(follow))
    if size == 0:
        raise DataError(f"recording {recording.name!r}: {u_name!r} or {y_name!r} does not move")
    correlation = np.array([white[: len(white) - k] @ follow[k:] for k in range(most + 1)]) / size
    limit = _LEVEL / np.sqrt(len(white))
    above = np.flatnonzero(np.abs(correlation) > limit)
    if not len(above):
        raise DataError(
            f"recording {recording.name!r}: {y_name!r} does not follow {u_name!r} within "
            f"{most * recording.sample_time:g} s; look further (longest_s), or excite more"
        )
    lag = int(above[0])
    return DelayEstimate(
        delay_s=max(lag - 1, 0) * recording.sample_time,
        lag=lag,
        lags=np.arange(most + 1, dtype=float),
        correlation=correlation,
        limit=float(limit),
        input_name=u_name,
        output_name=y_name,
    )


def _one_channel(recording: Recording, name: str) -> tuple[FloatArray, str]:
    values, labels, _ = select(recording, (name,))
    if len(labels) != 1:
        raise UsageError(f"{name!r} has {len(labels)} channels, {', '.join(labels)}; name one, as '{name}.x'")
    return values[:, 0] - values[:, 0].mean(), labels[0]
