"""Faults of the measuring chain put into recordings on purpose, to see that they are found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from gbid.errors import UsageError
from gbid.recording import Recording

TURN = 2 * np.pi


@dataclass(frozen=True)
class Faults:
    """What goes wrong when a recording is made; nothing by default.

    Parameters
    ----------
    swapped : tuple of str
        Signals whose channels x and y change places, e.g. ``("p",)``.
    dead : dict of str to float
        Channels (``"p.x"``) that stay at a value [unit of the signal].
    saturation : dict of str to float
        Channels (``"p.x"``) that end at plus and minus a value.
    spikes_per_s : float
        Single wrong samples of p, on average per second, at random in x or y.
    spike_size : float
        How far off they are [m], either way.
    sample_time_factor : float
        Sample time that the file states, over the true one.
    missing_index : bool
        The encoder never saw its index: phi starts from an angle of no meaning, another one in each recording.
    rub_clearance : float or None
        The disc touches already here [m], and the recording is kept.

    Raises
    ------
    UsageError
        For a channel not written as signal.x, or a value that makes no sense.
    """

    swapped: tuple[str, ...] = ()
    dead: Mapping[str, float] = field(default_factory=dict)
    saturation: Mapping[str, float] = field(default_factory=dict)
    spikes_per_s: float = 0.0
    spike_size: float = 20e-6
    sample_time_factor: float = 1.0
    missing_index: bool = False
    rub_clearance: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "swapped", tuple(self.swapped))
        for name in ("dead", "saturation"):
            object.__setattr__(self, name, dict(getattr(self, name)))
            for channel, value in getattr(self, name).items():
                if channel.count(".") != 1 or not np.isfinite(value):
                    raise UsageError(f"faults: {name} = {channel}: {value}; write signal.channel and a finite number")
        if not self.sample_time_factor > 0 or not self.spikes_per_s >= 0:
            raise UsageError("faults: sample_time_factor must be positive, spikes_per_s at least zero")
        if self.rub_clearance is not None and not self.rub_clearance > 0:
            raise UsageError(f"faults: rub_clearance = {self.rub_clearance} m; it must be positive")


def with_faults(recording: Recording, faults: Faults, random: np.random.Generator) -> Recording:
    """Put faults of sensors and logger into a recording; what was done is told in its provenance.

    Raises
    ------
    UsageError
        When the recording has no such signal or channel.
    """
    signals = {name: np.array(values) for name, values in recording.signals.items()}

    def column(channel: str) -> np.ndarray:
        name, _, which = channel.partition(".")
        if name not in signals or which not in recording.channels[name]:
            raise UsageError(f"faults: recording {recording.name!r} has no channel {channel}")
        return np.asarray(signals[name][:, recording.channels[name].index(which)])

    told = []
    for channel, limit in faults.saturation.items():
        column(channel)[:] = np.clip(column(channel), -abs(limit), abs(limit))
        told.append(f"{channel} saturated at {abs(limit):g}")
    if faults.spikes_per_s:
        p, dt = signals["p"], recording.sample_time
        hit = random.random(p.shape) < 0.5 * faults.spikes_per_s * dt
        p[hit] += faults.spike_size * random.choice([-1.0, 1.0], size=int(hit.sum()))
        told.append(f"{int(hit.sum())} spikes of {faults.spike_size:g} m in p")
    for channel, value in faults.dead.items():
        column(channel)[:] = value
        told.append(f"{channel} dead at {value:g}")
    if faults.missing_index and "phi" in signals:
        counts = random.integers(0, 4096)
        signals["phi"] = np.mod(signals["phi"] + counts * (TURN / 4096), TURN)
        told.append("encoder index missing")
    for name in faults.swapped:
        if name not in signals or signals[name].shape[1] != 2:
            raise UsageError(f"faults: recording {recording.name!r} has no signal {name} with two channels to swap")
        signals[name] = signals[name][:, ::-1]
        told.append(f"x and y of {name} swapped")
    if faults.sample_time_factor != 1.0:
        told.append(f"sample time stated {faults.sample_time_factor:g} times too long")
    if not told:
        return recording
    return replace(
        recording,
        signals=signals,
        sample_time=recording.sample_time * faults.sample_time_factor,
        provenance={**recording.provenance, "faults": "; ".join(told)},
    )
