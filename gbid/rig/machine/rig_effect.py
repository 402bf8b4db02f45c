"""Effect of the rig that a recording can be made with: additional forces on the rotor, or deviations of the sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from gbid.arrays import FloatArray
from gbid.brief import Brief


@dataclass(frozen=True, eq=False)
class RigRun(Brief):
    """Run of the rig, as an effect sees it: n samples from the start of the settling time, and one more.

    Attributes
    ----------
    time : (n + 1,) array
        Time from the start of the logger [s]; negative while the rig settles.
    angle, speed : (n + 1,) array
        Angle of the shaft [rad] and its speed [rad/s].
    conditions : dict of str to float
        The operating point.
    random : numpy.random.Generator
        Random numbers of this effect in this recording.
    """

    time: FloatArray
    angle: FloatArray
    speed: FloatArray
    conditions: Mapping[str, float]
    random: np.random.Generator


@dataclass(frozen=True)
class RigEffect:
    """Base of the effects in ``gbid/rig/effects``; a subclass overrides one of its methods or several.

    Attributes
    ----------
    name : str
        Name in the YAML, under ``rig: effects:``.
    """

    name: str = field(default="", init=False)

    def force(self, run: RigRun) -> FloatArray | None:  # noqa: ARG002  # for subclasses
        """Return an additional force per moving mass at the samples of `run`, (n + 1, 2) [m/s^2]."""
        return None

    def reading(self, run: RigRun) -> FloatArray | None:  # noqa: ARG002
        """Return what is added to the readings of p at the samples of `run`, (n + 1, 2) [m].

        A controller sees it, too.
        """
        return None
