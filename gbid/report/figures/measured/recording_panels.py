"""Signals of a recording over time, a panel for each signal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from gbid.errors import UsageError
from gbid.recording import Recording
from gbid.report.figures.canvas import TWO_COLUMNS, panels, series, styled
from gbid.report.figures.save import symbol
from gbid.tables.numbers import shown_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@styled
def plot_recording(
    recording: Recording,
    ax: Axes | npt.ArrayLike | None = None,
    *,
    signals: Sequence[str] = (),
    from_s: float = 0.0,
    to_s: float | None = None,
) -> npt.NDArray[np.object_]:
    """Draw the signals of a recording over time, a panel for each signal.

    Parameters
    ----------
    recording : Recording
        The recording.
    ax : array of matplotlib Axes, optional
        Axes, one for each signal; a new figure when left out.
    signals : sequence of str
        Signals to draw; by default all.
    from_s, to_s : float
        Time range [s]; to the end when left out.

    Returns
    -------
    (n_signals,) array of matplotlib Axes
        The axes; ``axes[0].figure`` is the figure.

    Raises
    ------
    DataError
        When the recording has no such signal.
    UsageError
        When the range holds no samples, or when there are too few axes.
    """
    names = list(signals) or list(recording.signals)
    shown = (recording.time >= from_s) & (recording.time <= (recording.duration if to_s is None else to_s))
    if not shown.any():
        raise UsageError(f"from_s = {from_s:g} to to_s = {to_s}: no samples of recording {recording.name!r} in there")
    size = (TWO_COLUMNS, 0.6 + 1.2 * len(names))
    figure, given = panels(ax, len(names), 1, size=size, sharex=True)  # type: ignore[arg-type]  # arrays are flattened
    time = recording.time[shown]
    for axes, name in zip(given, names, strict=False):
        values, channels = recording.signal(name)[shown], recording.channels[name]
        factor, unit = shown_unit(recording.units[name])
        for i, channel in enumerate(channels):
            axes.plot(time, factor * values[:, i], label=channel, **series(i, marker=None, linewidth=0.9))
        axes.set_ylabel(f"{symbol(name)} [{unit or '-'}]")
        axes.margins(x=0)
        if len(channels) > 1:  # beside the panel, where it covers no curve
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=2.2)
    given[len(names) - 1].set_xlabel("time [s]")
    if ax is None:
        figure.align_ylabels(given)
    return np.array(given[: len(names)], dtype=object)
