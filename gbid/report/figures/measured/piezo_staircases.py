"""Staircases and hysteresis of single piezos, with and without PD control (paper, Figs. A.28 and A.29)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from gbid.arrays import BoolArray, FloatArray, IntArray
from gbid.brief import Brief
from gbid.characterise import PiezoCurve
from gbid.errors import UsageError
from gbid.recording import Recording
from gbid.report.figures.canvas import (
    RED,
    TWO_COLUMNS,
    ink,
    legend_above,
    letter,
    panels,
    series,
    styled,
)
from gbid.report.figures.named import NamedFigure
from gbid.report.figures.save import plain_label
from gbid.report.reader import Results

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False)
class PiezoStaircase(Brief):
    """Staircase of one piezo.

    Attributes
    ----------
    label : str
        Label of the curves, as ``"open loop"`` or ``"PD control"``.
    time : (n,) array
        Time [s].
    command : (n,) array
        Voltage [V] or reference position [m].
    command_unit : {"V", "m"}
        Unit of the command.
    position : (n,) array
        Position [m].
    steps : (n_steps,) integer array
        Samples at which the command changes, in ascending order.
    """

    label: str
    time: FloatArray
    command: FloatArray
    command_unit: str
    position: FloatArray
    steps: IntArray

    def plateaus(self) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return command and position [m] as means over the last tenth of each step, and a mask of rising steps."""
        ends = [*self.steps[1:], len(self.time)]
        parts = [slice(max(b, e - max(1, (e - b) // 10)), e) for b, e in zip(self.steps, ends, strict=True)]
        command = np.array([self.command[part].mean() for part in parts])
        position = np.array([self.position[part].mean() for part in parts])
        return command, position, np.diff(command, prepend=self.command[max(self.steps[0] - 1, 0)]) > 0

    def single_steps(self) -> list[tuple[FloatArray, FloatArray]]:
        """Return time [s] and position [m] of each step, both from its start; falling steps are mirrored."""
        ends = [*self.steps[1:], len(self.time)]
        found = []
        for begin, end in zip(self.steps, ends, strict=True):
            before = self.position[max(begin - 1, 0)]
            sign = np.sign(self.command[begin] - self.command[max(begin - 1, 0)]) or 1.0
            found.append((self.time[begin:end] - self.time[begin], sign * (self.position[begin:end] - before)))
        return found


def piezo_staircase_data(
    label: str, time: npt.ArrayLike, command: npt.ArrayLike, position: npt.ArrayLike, command_unit: str = "V"
) -> PiezoStaircase:
    """Return a staircase with its steps, at which the command changes.

    Parameters
    ----------
    label : str
        Label of the curves.
    time, command, position : (n,) array
        Time [s], command [`command_unit`] and position [m].
    command_unit : {"V", "m"}
        Unit of the command.

    Returns
    -------
    PiezoStaircase
        The staircase.

    Raises
    ------
    UsageError
        When the command never changes, or when the lengths differ.
    """
    t, c, y = (np.asarray(values, float) for values in (time, command, position))
    if not t.shape == c.shape == y.shape or t.ndim != 1:
        raise UsageError(
            f"{label}: time, command and position have shapes {t.shape}, {c.shape}, {y.shape}; give one each"
        )
    steps = np.flatnonzero(np.diff(c)) + 1
    if not len(steps):
        raise UsageError(f"{label}: the command never changes, so there is no staircase")
    return PiezoStaircase(label, t, c, command_unit, y, steps)


@styled
def plot_piezo_hysteresis(data: Sequence[PiezoStaircase], ax: Sequence[Axes] | None = None) -> npt.NDArray[np.object_]:
    """Draw positions at rest over the rising and falling command, and the command over time (Fig. A.28).

    Parameters
    ----------
    data : sequence of PiezoStaircase
        Staircases; each unit of the commands has its own axes.
    ax : sequence of matplotlib Axes, optional
        Axes of the hysteresis for each unit, then axes of the commands; a new figure when left out.

    Returns
    -------
    (n_units + 1,) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.
    """
    units = list(dict.fromkeys(staircase.command_unit for staircase in data))
    _figure, axes = panels(ax, 1, len(units) + 1, size=(TWO_COLUMNS, 2.6))
    for k, staircase in enumerate(data):
        panel = axes[units.index(staircase.command_unit)]
        scale, unit = _shown(staircase.command_unit)
        command, position, rising = staircase.plateaus()
        line = series(k, marker=None, linewidth=0.9)
        panel.plot(scale * command, 1e6 * position, label=plain_label(staircase.label), **line)
        for there, marker in ((rising, "^"), (~rising, "v")):
            look = series(k, linestyle="none", marker=marker, markersize=3.5, markerfacecolor="none")
            panel.plot(scale * command[there], 1e6 * position[there], **look)
        panel.set_xlabel(f"command [{plain_label(unit)}]")
        panel.set_ylabel("piezo position [µm]")
        panel.legend(loc="upper left", fontsize=7.5)
        panel.set_title("△ rising  ▽ falling", loc="right", pad=4, fontsize=7.5)
        axes[-1].plot(staircase.time, _share(staircase.command), label=plain_label(staircase.label), **line)
    axes[-1].set_xlabel("time [s]")
    axes[-1].set_ylabel("command [share of its range]")
    letter(axes)
    return np.array(axes, dtype=object)


@styled
def plot_piezo_staircase(data: Sequence[PiezoStaircase], ax: Sequence[Axes] | None = None) -> npt.NDArray[np.object_]:
    """Draw single steps from their starts, and whole staircases (Fig. A.29).

    Parameters
    ----------
    data : sequence of PiezoStaircase
        Staircases, for example open loop and PD control. Falling steps are mirrored and dashed.
    ax : sequence of two matplotlib Axes, optional
        Axes to draw into; a new figure when left out.

    Returns
    -------
    (2,) array of matplotlib Axes
        The axes; ``axes.flat[0].figure`` is the figure.
    """
    figure, axes = panels(ax, 1, 2, size=(TWO_COLUMNS, 2.7))
    for k, staircase in enumerate(data):
        rising = staircase.plateaus()[2]
        color = (ink(), RED)[k] if k < 2 else series(k)["color"]
        labelled: set[bool] = set()
        for (time, position), up in zip(staircase.single_steps(), rising, strict=True):
            word = None if bool(up) in labelled else f"{plain_label(staircase.label)}, {'up' if up else 'down'}"
            labelled.add(bool(up))
            style = {"linewidth": 0.9, "linestyle": "-" if up else (0, (3, 1.5)), "alpha": 1.0 if k else 0.8}
            axes[0].plot(1e3 * time, 1e6 * position, color=color, label=word, **style)  # type: ignore[arg-type]
        axes[1].plot(staircase.time, 1e6 * staircase.position, color=color)
    axes[0].set_xlabel("time from the step [ms]")
    axes[0].set_ylabel("step of the position [µm]")
    axes[1].set_xlabel("time [s]")
    axes[1].set_ylabel("piezo position [µm]")
    letter(axes)
    legend_above(figure, axes[0], columns=4)
    return np.array(axes[:2], dtype=object)


def _shown(unit: str) -> tuple[float, str]:
    return (1e6, "µm") if unit == "m" else (1.0, unit)


def _share(command: FloatArray) -> FloatArray:
    span = np.ptp(command)
    return np.asarray((command - command.min()) / (span if span else 1.0))


def piezo_data(
    curve: PiezoCurve, recording: Recording, command: str, command_channel: str | None = None
) -> PiezoStaircase:
    """Return the staircase of a piezo for Figs. A.28 and A.29.

    Parameters
    ----------
    curve : PiezoCurve
        Characterisation of the piezo.
    recording : Recording
        Recording of the staircase.
    command : str
        Name of the signal with the voltage or the reference position.
    command_channel : str, optional
        Channel of the command; that of the position when left out.

    Returns
    -------
    PiezoStaircase
        The staircase.
    """
    position, _, channel = curve.channel.rpartition("_")
    source = recording.channels[command].index(command_channel or channel)
    y = recording.signal(position)[:, recording.channels[position].index(channel)]
    label = "open loop" if curve.units[0] == "V" else "PD control"
    x = recording.signal(command)[:, source]
    return piezo_staircase_data(label, recording.time, x, y, curve.units[0])


def _staircases(results: Results) -> list[PiezoStaircase]:
    return [piezo_data(*found) for found in results.piezos]


FIGURES = (
    NamedFigure("figA28_piezo_hysteresis", _staircases, plot_piezo_hysteresis),
    NamedFigure("figA29_piezo_staircase", _staircases, plot_piezo_staircase),
)
