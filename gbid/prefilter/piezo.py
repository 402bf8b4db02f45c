"""Piezo staircases (paper, Appendix A, Figs. A.28 and A.29): hysteresis, creep and uniformity of the steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import h5py
import numpy as np

from gbid.core import hdf5
from gbid.core.arrays import BoolArray, FloatArray, IntArray
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import DataError, UsageError
from gbid.core.figures import Figure, Pictured
from gbid.core.hdf5 import Stored
from gbid.core.notes import DataNote
from gbid.core.option_types import Share
from gbid.core.tables import Column, Row, Table, finite_or_none, formatted, in_unit
from gbid.prefilter.staircase import (
    MIN_SAMPLES,
    REMEDY,
    Plateaus,
    branch_difference,
    find_plateaus,
    steady_means,
    steady_parts,
    stored_units,
)
from gbid.recording import Recording

_SMALL_STEP = 0.6  # of the median step gain: a smaller step towards the end of the travel is saturated
_NEAR_LIMIT = 0.01  # of the range


@dataclass(frozen=True, eq=False)
class PiezoCurve(Brief, Pictured, hdf5.InFile):
    """Static piezo position over voltage or reference, and step responses.

    Attributes
    ----------
    command, position, position_std : (n_plateaus,) array
        Level of the command, steady mean of the position and its standard error, in `units`.
    time : (n_plateaus,) array
        Start of each plateau [s].
    direction : (n_plateaus,) array
        1 when the last step was up, -1 when it was down, 0 before the first step.
    hysteresis, hysteresis_std, hysteresis_at : float
        Largest difference of position between up and down branch at the same command, its standard error, and the
        command at which it occurs (Fig. A.28).
    hysteresis_share : float
        Hysteresis over the range of positions.
    step : (n_steps,) array
        Commanded steps.
    step_gain : (n_steps,) array
        Change of the steady position over each commanded step.
    creep : (n_steps,) array
        Change of the position from shortly after the step to the end of the plateau, over the change of position by
        the step; 0.03 is a creep of 3 %.
    saturated : (n_steps,) array of bool
        Steps to or from a position at the end of the travel.
    uniformity : float
        Standard deviation over mean of the step gains, without saturated steps; 0 for uniform steps.
    response_time : (n_samples,) array
        Time since the step [s].
    responses : (n_samples, n_steps) array
        Position since each step minus the position before it (Fig. A.29 a), over the shortest plateau.
    name, channel : str
        Name of the recording, and channel of the position.
    units : tuple of str
        Units of command and position.
    notes : tuple of str
        Remarks about saturation and missing branches.
    """

    command: Annotated[FloatArray, Stored("in", "level of the command", "plateaus")]
    position: Annotated[FloatArray, Stored("out", "stationary position", "plateaus")]
    position_std: Annotated[FloatArray, Stored("out", "standard error of the stationary position", "plateaus")]
    time: Annotated[FloatArray, Stored("s", "begin of the plateau", "plateaus")]
    direction: Annotated[IntArray, Stored("1", "way of the last step", "plateaus")]
    hysteresis: Annotated[float, Stored("out", "largest difference between up and down branch")]
    hysteresis_std: Annotated[float, Stored("out", "standard error of the hysteresis")]
    hysteresis_at: Annotated[float, Stored("in", "command at which it occurs")]
    hysteresis_share: Annotated[float, Stored("1", "hysteresis over the range of positions")]
    step: Annotated[FloatArray, Stored("in", "commanded steps", "steps")]
    step_gain: Annotated[FloatArray, Stored("gain", "change of position over commanded step", "steps")]
    creep: Annotated[FloatArray, Stored("1", "creep over the plateau relative to the step", "steps")]
    saturated: Annotated[BoolArray, Stored("1", "steps at the end of the travel", "steps")]
    uniformity: Annotated[float, Stored("1", "standard deviation over mean of the step gains")]
    response_time: Annotated[FloatArray, Stored("s", "time since the step", "samples")]
    responses: Annotated[FloatArray, Stored("out", "position since each step less that before it", "samples steps")]
    name: str
    channel: str
    units: tuple[str, str]
    notes: tuple[str, ...] = ()
    FILE: ClassVar[hdf5.FileKind] = hdf5.FileKind("piezo_curve", REMEDY)

    def to_hdf5(self, group: h5py.Group) -> None:
        """Write this curve to a `group`, in the units of its signals."""
        hdf5.write_fields(group, self, stored_units(self.units))

    def _brief(self) -> Description:
        unit, share = self.units[1], 100 * self.hysteresis_share
        hysteresis = f"{self.hysteresis:.4g} +- {self.hysteresis_std:.2g} {unit}, {share:.3g} % of the range"
        return brief(
            self,
            f"{self.name}, {self.channel}, {len(self.command)} plateaus",
            command=self.command,
            position=self.position,
            hysteresis=hysteresis,
            creep=self.creep,
            uniformity=self.uniformity,
            notes=self.notes,
        )

    def document(self) -> Row:
        """Return hysteresis, creep and uniformity as plain values, for JSON."""
        steps = ~self.saturated
        figures = ("hysteresis", "hysteresis_std", "hysteresis_at", "hysteresis_share", "uniformity")
        return {
            "kind": "piezo",
            "recordings": [self.name],
            "channel": self.channel,
            "units": list(self.units),
            **{name: finite_or_none(getattr(self, name)) for name in figures},
            "range": [float(self.position.min()), float(self.position.max())],
            "step_gain": finite_or_none(float(np.mean(self.step_gain[steps]))) if steps.any() else None,
            "creep": finite_or_none(float(np.mean(self.creep[steps]))) if steps.any() else None,
            "steps": len(self.step),
            "saturated_steps": [int(i) + 1 for i in np.flatnonzero(self.saturated)],
            "notes": list(self.notes),
        }

    def tables(self) -> list[Table]:
        """Return the table of hysteresis, creep and uniformity."""
        (source, output), values = self.units, self.document()
        shown = (
            ("hysteresis", "hysteresis", 1.0, output),
            ("  its standard error", "hysteresis_std", 1.0, output),
            ("  over the range", "hysteresis_share", 100.0, "%"),
            ("creep per step", "creep", 100.0, "%"),
            ("gain per step", "step_gain", 1.0, f"{output}/{source}"),
            ("non-uniformity of the steps", "uniformity", 100.0, "%"),
        )
        rows = [
            [heading, formatted(None if values[key] is None else factor * values[key], 3, unit)]
            for heading, key, factor, unit in shown
        ]
        return [Table(self.name, [Column(self.channel), Column("value", format=3)], rows, self.notes)]

    def figures(self) -> list[Figure]:
        """Return the figures of hysteresis over the command, and of the steps."""
        how = "in open loop" if self.units[0] == "V" else "with its controller"
        caption = f"Hysteresis of the piezo: {in_unit(self.hysteresis, self.units[1])} {how}"
        return [Figure("plot_piezo_hysteresis", caption, ([self],)), Figure("plot_piezo_staircase", "steps", ([self],))]

    def rows(self) -> list[dict[str, Any]]:
        """Return rows for CSV, one for each plateau; units are in brackets behind the names."""
        source, output = self.units
        creep = np.concatenate([[np.nan], self.creep])
        saturated = np.concatenate([[False], self.saturated])
        return [
            {
                "recording": self.name,
                "plateau": k + 1,
                "direction": int(self.direction[k]),
                f"command [{source}]": float(self.command[k]),
                f"{self.channel} [{output}]": float(self.position[k]),
                f"{self.channel}_std [{output}]": float(self.position_std[k]),
                "creep": float(creep[k]),
                "saturated": bool(saturated[k]),
            }
            for k in range(len(self.command))
        ]


def characterise_piezo(
    recording: Recording,
    *,
    command: str = "r",
    position: str = "u",
    channel: str | None = None,
    command_channel: str | None = None,
    keep: Share = 0.2,
    settle_s: float = 0.02,
    limits: tuple[float, float] | None = None,
) -> PiezoCurve:
    """Return hysteresis, creep and step responses of a piezo stack or pair, from a staircase up and down.

    Parameters
    ----------
    recording : Recording
        Recording with the command (voltage or reference) and the position. One channel has a staircase; others may
        rest.
    command, position : str
        Names of these signals.
    channel : str, optional
        Channel of the position; by default the channel of the command that moves.
    command_channel : str, optional
        Channel of the command; by default that of the position.
    keep : float
        Share of each plateau, from its end, that counts as stationary.
    settle_s : float
        Time after a step at which the fast response is over and creep starts to count [s]. The slowest pole of the
        actuators in the paper (Table 2) has decayed by e^-49 after 20 ms.
    limits : (float, float), optional
        Ends of the travel, in the unit of the position. Positions within 1 % of the range of them are saturated.
        Without `limits`, a step towards an end of the recorded travel is saturated when it is smaller than 0.6 of the
        median step.

    Returns
    -------
    PiezoCurve

    Raises
    ------
    UsageError
        When an argument is wrong.
    DataError
        When signals or channels are missing, when the command has no steps, or when plateaus are too short.
    """
    channel, command_channel = _channels(recording, command, position, channel, command_channel)
    x = recording.signal(command)[:, [recording.channels[command].index(command_channel)]]
    y = recording.signal(position)[:, recording.channels[position].index(channel)]
    stack_signals = Recording({command: x}, recording.sample_time, name=recording.name, units=recording.units)
    plateaus = find_plateaus(stack_signals, command)
    steady = steady_means(y[:, None], steady_parts(stack_signals, plateaus, keep))
    level, at = plateaus.level[:, 0], steady.mean[:, 0]
    if np.ptp(at) == 0:
        raise DataError(
            f"recording {recording.name!r}: {position}_{channel} does not respond to {command}_{command_channel}"
        )
    hysteresis, std, place = branch_difference(level, at, steady.std_error[:, 0])
    step = np.diff(level)
    gain = np.divide(np.diff(at), step, out=np.full(len(step), np.nan), where=step != 0)
    saturated = _saturated(level, at, gain, limits)
    usual = gain[~saturated & np.isfinite(gain)]
    notes = []
    if saturated.any():
        where = ", ".join(f"{i + 1}" for i in np.flatnonzero(saturated))
        text = f"saturated: step {where} of {len(step)} (position {at.min():.4g} to {at.max():.4g})"
        notes.append(DataNote.SATURATED(text))
    if np.isnan(hysteresis):
        notes.append(DataNote.ONE_DIRECTION("the staircase goes in one direction only, so the hysteresis is not known"))
    time, responses = _responses(y, plateaus, recording.sample_time)
    return PiezoCurve(
        command=level,
        position=at,
        position_std=steady.std_error[:, 0],
        time=plateaus.start * recording.sample_time,
        direction=np.sign(np.diff(level, prepend=level[:1])).astype(int),
        hysteresis=hysteresis,
        hysteresis_std=std,
        hysteresis_at=place,
        hysteresis_share=hysteresis / float(np.ptp(at)),
        step=step,
        step_gain=gain,
        creep=_creep(recording, y, plateaus, keep, settle_s),
        saturated=saturated,
        uniformity=float(usual.std() / abs(usual.mean())) if usual.size else float("nan"),
        response_time=time,
        responses=responses,
        name=recording.name,
        channel=f"{position}_{channel}",
        units=(recording.units[command], recording.units[position]),
        notes=tuple(notes),
    )


def _channels(
    rec: Recording, command: str, position: str, channel: str | None, command_channel: str | None
) -> tuple[str, str]:
    """Return the channel of the position and the channel of the command."""
    for name in (command, position):
        if name not in rec.signals:
            raise DataError(f"recording {rec.name!r} has no signal {name!r}; it has {', '.join(rec.signals)}")
    if channel is None:
        moving = rec.channels[command][int(np.ptp(rec.signal(command), axis=0).argmax())]
        channel = command_channel or moving
    command_channel = command_channel or channel
    for name, wanted in ((position, channel), (command, command_channel)):
        if wanted not in rec.channels[name]:
            raise UsageError(
                f"recording {rec.name!r}: signal {name!r} has no channel {wanted!r}, "
                f"only {', '.join(rec.channels[name])}"
            )
    return channel, command_channel


def _saturated(level: FloatArray, at: FloatArray, gain: FloatArray, limits: tuple[float, float] | None) -> BoolArray:
    """Mark the steps to or from an end of the travel."""
    if limits is not None:
        low, high = limits
        if not low < high:
            raise UsageError(f"limits = {limits}; give the lower end first")
        near = _NEAR_LIMIT * (high - low)
        ended = (at <= low + near) | (at >= high - near)
        return np.asarray(ended[:-1] | ended[1:])
    usual = float(np.nanmedian(gain))
    small = gain * np.sign(usual) < _SMALL_STEP * abs(usual)
    ends = (level == level.min()) | (level == level.max())
    # Hysteresis also makes the first step after a reversal small. On the way to an end only saturation does.
    towards = small & ends[1:]
    away = np.concatenate([[False], towards[:-1]]) & small
    return np.asarray(towards | away)


def _creep(rec: Recording, y: FloatArray, plateaus: Plateaus, keep: float, settle_s: float) -> FloatArray:
    settle, sizes = round(settle_s / rec.sample_time), plateaus.stop - plateaus.start
    if settle < 0 or sizes[1:].min() - settle < 2 * MIN_SAMPLES:
        raise UsageError(
            f"settle_s = {settle_s} s leaves too little of the shortest plateau ({sizes.min() * rec.sample_time:g} s)"
        )
    creep = []
    for k in range(1, len(plateaus)):
        a, b, earlier = int(plateaus.start[k]), int(plateaus.stop[k]), int(plateaus.stop[k - 1])
        width = max(MIN_SAMPLES, round(min(keep, 0.1) * (b - a - settle)))
        before = y[max(int(plateaus.start[k - 1]), earlier - width) : earlier].mean()
        early = y[a + settle : a + settle + width].mean()
        change = early - before
        creep.append((y[b - width : b].mean() - early) / change if change else np.nan)
    return np.array(creep)


def _responses(y: FloatArray, plateaus: Plateaus, sample_time: float) -> tuple[FloatArray, FloatArray]:
    """Return the step responses, shifted to start at time zero and position zero."""
    length = int((plateaus.stop - plateaus.start)[1:].min())
    columns = []
    for k in range(1, len(plateaus)):
        a = int(plateaus.start[k])
        before = y[max(a - MIN_SAMPLES, int(plateaus.start[k - 1])) : a].mean()
        columns.append(y[a : a + length] - before)
    return np.asarray(np.arange(length) * sample_time, dtype=float), np.column_stack(columns)
