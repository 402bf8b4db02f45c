"""Further effects of the rig: forces on the rotor, and errors of the sensors.

An effect is a subclass of `gbid.rig.machine.RigEffect` in this file. The default of its field `name` is the name in the
YAML, its other fields are the keys there. Nothing else has to know it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from types import MappingProxyType
from typing import Any

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import UsageError
from gbid.core.option_types import Finite, NotNegative, Positive
from gbid.rig.machine import RigEffect, RigRun


@cache
def rig_effects() -> Mapping[str, type[RigEffect]]:
    """Return the effects of this file by name."""
    kinds = [value for value in globals().values() if isinstance(value, type) and issubclass(value, RigEffect)]
    return MappingProxyType({kind.name: kind for kind in sorted(kinds, key=lambda kind: kind.name) if kind.name})


def rig_effect(name: str, **options: Any) -> RigEffect:
    """Return an effect of the rig by name.

    Parameters
    ----------
    name : str
        Name of an effect.
    **options
        Its fields.

    Returns
    -------
    RigEffect

    Raises
    ------
    UsageError
        When there is no such effect or field, or when a value is not allowed.
    """
    known = rig_effects()
    if name not in known:
        raise UsageError(f"no effect {name!r}; choose from {', '.join(known)}")
    kind = known[name]
    fields = [key for key in kind.__dataclass_fields__ if key != "name"]
    unknown = [key for key in options if key not in fields]
    if unknown:
        raise UsageError(f"effect {name!r}: unknown option {', '.join(unknown)}; choose from {', '.join(fields)}")
    return kind(**options)


@dataclass(frozen=True)
class FloorVibration(RigEffect):
    """Sinusoidal acceleration of the frame in one direction, for example by a nearby motor; its phase is random.

    The motion of the disc is measured relative to the frame. So an acceleration of the frame acts like the opposite
    force per moving mass.

    Parameters
    ----------
    frequency_hz : float
        Frequency [Hz].
    acceleration : float
        Amplitude of the acceleration [m/s^2].
    direction_deg : float
        Direction from x towards y [degrees].

    Raises
    ------
    UsageError
        When a value is not finite, or when frequency or acceleration is negative.
    """

    frequency_hz: Positive = 25.0
    acceleration: NotNegative = 0.05
    direction_deg: Finite = 90.0
    name: str = field(default="floor_vibration", init=False)

    def force(self, run: RigRun) -> FloatArray:
        """Return the force per moving mass, opposite to the acceleration of the frame, (n + 1, 2) [m/s^2]."""
        turn, first = np.radians(self.direction_deg), run.random.uniform(0.0, 2 * np.pi)
        sine = self.acceleration * np.sin(2 * np.pi * self.frequency_hz * run.time + first)
        return -np.outer(sine, [np.cos(turn), np.sin(turn)])


@dataclass(frozen=True)
class MainsHum(RigEffect):
    """Sine at the mains frequency in the readings of both probes, as by a ground loop; the phase is random.

    Parameters
    ----------
    frequency_hz : float
        Frequency of the mains [Hz].
    amplitude_m : float
        Amplitude [m].
    """

    frequency_hz: Positive = 50.0
    amplitude_m: NotNegative = 0.2e-6
    name: str = field(default="mains_hum", init=False)

    def reading(self, run: RigRun) -> FloatArray:
        """Return a sine at the mains frequency, equal in x and y, (n + 1, 2) [m]."""
        sine = np.sin(2 * np.pi * self.frequency_hz * run.time + run.random.uniform(0.0, 2 * np.pi))
        return np.asarray(self.amplitude_m * np.column_stack([sine, sine]))


@dataclass(frozen=True)
class ProbeDrift(RigEffect):
    """Readings of the probes that change linearly with time, from zero at the start of the logger.

    Parameters
    ----------
    x_m_per_s, y_m_per_s : float
        Rates of the two probes [m/s].
    """

    x_m_per_s: Finite = 0.1e-6
    y_m_per_s: Finite = 0.05e-6
    name: str = field(default="probe_drift", init=False)

    def reading(self, run: RigRun) -> FloatArray:
        """Return the linear drift of both probes, (n + 1, 2) [m]."""
        return np.outer(run.time, [self.x_m_per_s, self.y_m_per_s])
