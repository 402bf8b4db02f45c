"""Orbit of a shaft: its two displacements against each other, and the mean over its revolutions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gbid.arrays import FloatArray
from gbid.brief import Brief
from gbid.errors import UsageError
from gbid.identify import select
from gbid.recording import Recording
from gbid.report.figures.canvas import GREY, RED, panels, series, styled
from gbid.report.figures.save import plain_label, symbol
from gbid.tables.numbers import shown_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SECTORS = 90  # of a revolution, for its mean


@dataclass(frozen=True, eq=False)
class Orbit(Brief):
    """Orbit of a shaft about its mean position.

    Attributes
    ----------
    xy : (n, 2) array
        Displacements less their means.
    mean : (n_sectors, 2) array
        Mean over the revolutions, from shaft angle 0 on; empty without an angle that turns.
    names : (str, str)
        Names of the two channels.
    unit : str
        Their unit.
    """

    xy: FloatArray
    mean: FloatArray
    names: tuple[str, str]
    unit: str


def orbit_data(
    recording: Recording, signal: str = "p", *, angle: str = "phi", from_s: float = 0.0, to_s: float | None = None
) -> Orbit:
    """Return the orbit of a shaft, for `plot_orbit`.

    Parameters
    ----------
    recording : Recording
        Recording with two displacements.
    signal : str
        Signal with two channels.
    angle : str
        Signal of the shaft angle [rad]. Without it, or when the shaft does not turn, there is no mean.
    from_s, to_s : float
        Time range [s]; to the end when left out.

    Returns
    -------
    Orbit

    Raises
    ------
    UsageError
        When the signal has not two channels, or the range holds no samples.
    """
    values, names, units = select(recording, (signal,))
    if len(names) != 2:
        raise UsageError(f"an orbit needs two channels; {signal!r} of recording {recording.name!r} has {len(names)}")
    first = round(from_s / recording.sample_time)
    last = recording.n_samples if to_s is None else round(to_s / recording.sample_time)
    xy = values[first:last]
    if not 0 <= first < last or len(xy) < 2:
        raise UsageError(f"from_s = {from_s:g} to to_s = {to_s}: no samples of recording {recording.name!r} in there")
    xy = xy - xy.mean(0)
    mean = np.zeros((0, 2))
    if angle in recording.signals:
        turned = recording.signal(angle)[first:last, 0]
        if np.ptp(np.unwrap(turned)) > 4 * np.pi:
            sector = (np.mod(turned, 2 * np.pi) / (2 * np.pi) * _SECTORS).astype(int) % _SECTORS
            counts = np.bincount(sector, minlength=_SECTORS)
            seen = counts > 0  # a clock in step with the shaft leaves sectors without a sample
            mean = np.column_stack([np.bincount(sector, column, _SECTORS)[seen] / counts[seen] for column in xy.T])
    return Orbit(xy, mean, (names[0], names[1]), units[0])


@styled
def plot_orbit(recording: Recording | Orbit, ax: Axes | None = None, *, signal: str = "p") -> Axes:
    """Draw the orbit of a shaft, with the mean over its revolutions and a dot at shaft angle zero.

    Parameters
    ----------
    recording : Recording or Orbit
        Recording with two displacements, or the result of `orbit_data`.
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.
    signal : str
        Signal with two channels.

    Returns
    -------
    matplotlib Axes
        The axes; ``axes.figure`` is the figure.

    Raises
    ------
    UsageError
        When the signal has not two channels.
    """
    data = recording if isinstance(recording, Orbit) else orbit_data(recording, signal)
    factor, unit = shown_unit(data.unit)
    _, (axes, *_) = panels(ax, size=(3.6, 3.6))
    axes.plot(*(factor * data.xy.T), color=GREY, linewidth=0.5)
    if len(data.mean):
        closed = factor * np.vstack([data.mean, data.mean[:1]])
        axes.plot(*closed.T, **series(0, marker=None))
        axes.plot(*closed[0], "o", color=RED, markersize=5)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"{symbol(data.names[0])} [{plain_label(unit or '-')}]")
    axes.set_ylabel(f"{symbol(data.names[1])} [{plain_label(unit or '-')}]")
    return axes
