"""Faults of the measuring chain that are put into recordings on purpose, to test whether they are detected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from gbid.errors import UsageError
from gbid.recording import Recording

TURN = 2 * np.pi


@dataclass(frozen=True)
class Faults:
    """Faults of a recording; by default there are none.

    Parameters
    ----------
    swapped : tuple of str
        Signals whose channels x and y are exchanged, e.g. ``("p",)``.
    dead : dict of str to float
        Channels (``"p.x"``) that stay at a constant value [unit of the signal].
    saturation : dict of str to float
        Channels (``"p.x"``) that are limited to plus and minus a value [unit of the signal].
    spikes_per_s : float
        Mean number per second of single wrong samples of p, at random times in x or y.
    spike_size : float
        Deviation of these samples [m], with random sign.
    sample_time_factor : float
        Ratio of the sample time stated in the file to the true one.
    missing_index : bool
        Whether the encoder has lost its index. Then phi has a constant error, different in each recording.
    rub_clearance : float or None
        Smaller clearance at which the disc touches [m]. The recording is kept.

    Raises
    ------
    UsageError
        When a channel is not written as ``signal.channel``, or when a value is not allowed.
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
    """Return a recording with faults of sensors and logger; its provenance lists them.

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

    applied = []
    for channel, limit in faults.saturation.items():
        column(channel)[:] = np.clip(column(channel), -abs(limit), abs(limit))
        applied.append(f"{channel} saturated at {abs(limit):g}")
    if faults.spikes_per_s:
        p, dt = signals["p"], recording.sample_time
        hit = random.random(p.shape) < 0.5 * faults.spikes_per_s * dt
        p[hit] += faults.spike_size * random.choice([-1.0, 1.0], size=int(hit.sum()))
        applied.append(f"{int(hit.sum())} spikes of {faults.spike_size:g} m in p")
    for channel, value in faults.dead.items():
        column(channel)[:] = value
        applied.append(f"{channel} dead at {value:g}")
    if faults.missing_index and "phi" in signals:
        counts = random.integers(0, 4096)
        signals["phi"] = np.mod(signals["phi"] + counts * (TURN / 4096), TURN)
        applied.append("encoder index missing")
    for name in faults.swapped:
        if name not in signals or signals[name].shape[1] != 2:
            raise UsageError(f"faults: recording {recording.name!r} has no signal {name} with two channels to swap")
        signals[name] = signals[name][:, ::-1]
        applied.append(f"x and y of {name} swapped")
    if faults.sample_time_factor != 1.0:
        applied.append(f"sample time stated {faults.sample_time_factor:g} times too long")
    if not applied:
        return recording
    return replace(
        recording,
        signals=signals,
        sample_time=recording.sample_time * faults.sample_time_factor,
        provenance={**recording.provenance, "faults": "; ".join(applied)},
    )
