"""Staircases up and down: of a pair of piezos (paper, Sec. 3.1) and of one stack (Figs. A.28, A.29)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.rig.excitation.prbs import whole_samples
from gbid.rig.machine.effects import need_finite


def up_and_down(lowest: float, step: float, n_steps: int) -> FloatArray:
    """Levels of a staircase of n steps up and as many down, shape (2 n + 1,)."""
    up = lowest + step * np.arange(n_steps + 1)
    return np.concatenate([up, up[-2::-1]])


@dataclass(frozen=True)
class Staircase:
    """Reference of one axis stepwise from -n steps to +n steps and back, the other at zero (Sec. 3.1, Fig. 5).

    Parameters
    ----------
    axis : {"x", "y"}
    step : float
        Height of a step [m].
    steps : int
        n, steps from the middle to either end.
    hold_s : float
        Time on each level [s], a whole number of samples.
    """

    axis: Literal["x", "y"] = "x"
    step: float = 2.25e-6
    steps: int = 6
    hold_s: float = 0.5

    def __post_init__(self) -> None:
        need_finite("staircase", self, ("step", "steps", "hold_s"))
        if self.axis not in ("x", "y"):
            raise UsageError(f"staircase: axis = {self.axis!r}; choose 'x' or 'y'")

    @property
    def levels(self) -> FloatArray:
        """Levels in order [m], shape (4 n + 1,)."""
        return up_and_down(-self.steps * self.step, self.step, 2 * self.steps)

    @property
    def duration_s(self) -> float:
        """Length of the recording [s]."""
        return len(self.levels) * self.hold_s

    def reference(
        self, n_samples: int, sample_time: float, random: np.random.Generator, n_settle: int = 0
    ) -> FloatArray:
        """Give the references r, at the first level before the logger starts, shape (n_samples, 2) [m]."""
        del random
        r = np.zeros((n_samples, 2))
        r[:, "xy".index(self.axis)] = held_levels(self.levels, self.hold_s, sample_time, n_samples, n_settle)
        return r


@dataclass(frozen=True)
class StackStaircase:
    """One stack stepwise over its whole range and back, the others at r_0 (Figs. A.28 and A.29).

    Open loop its voltage goes from zero to its limit, controlled its reference from zero to its stroke. Needs a
    machine with `PiezoStacks`; stacks are recorded (v, y_p, r_p).

    Parameters
    ----------
    stack : int
        1 to 4.
    controlled : bool
        Whether its PD controller is on.
    steps : int
        Steps from zero to the end; an even number has a level in the middle.
    hold_s : float
        Time on each level [s], a whole number of samples.
    """

    stack: int = 4
    controlled: bool = False
    steps: int = 10
    hold_s: float = 1.0

    def __post_init__(self) -> None:
        need_finite("stack staircase", self, ("steps", "hold_s"))
        if self.stack not in (1, 2, 3, 4):
            raise UsageError(f"stack staircase: stack = {self.stack}; choose 1 to 4")

    @property
    def duration_s(self) -> float:
        """Length of the recording [s]."""
        return (2 * self.steps + 1) * self.hold_s

    def reference(
        self, n_samples: int, sample_time: float, random: np.random.Generator, n_settle: int = 0
    ) -> FloatArray:
        """Give the pairs' references r, all zero, shape (n_samples, 2) [m]."""
        del sample_time, random, n_settle
        return np.zeros((n_samples, 2))

    def command(self, top: float, n_samples: int, sample_time: float, n_settle: int) -> FloatArray:
        """Give what the stack is told, from zero to `top` and back, shape (n_samples,) [V or m].

        Parameters
        ----------
        top : float
            Highest level [V or m].
        n_samples : int
        sample_time : float
            [s].
        n_settle : int
            Samples before the logger starts.
        """
        return held_levels(
            up_and_down(0.0, top / self.steps, self.steps), self.hold_s, sample_time, n_samples, n_settle
        )


def held_levels(levels: FloatArray, hold_s: float, sample_time: float, n_samples: int, n_settle: int) -> FloatArray:
    """Hold each level for a time, the first one also before the logger starts.

    Raises
    ------
    UsageError
        When the time is not a whole number of samples.
    """
    hold = whole_samples("staircase: hold_s", hold_s, sample_time)
    held = np.concatenate([np.full(n_settle, levels[0]), np.repeat(levels, hold)])
    return np.concatenate([held, np.full(max(n_samples - len(held), 0), levels[-1])])[:n_samples]
