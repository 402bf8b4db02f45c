"""Staircase references: for a pair of piezos (paper, Sec. 3.1) and for one stack (Figs. A.28, A.29)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.rig.excitation.prbs import whole_samples
from gbid.rig.machine.rotor_effects import need_finite


def up_and_down(lowest: float, step: float, n_steps: int) -> FloatArray:
    """Return the levels of n steps up and n steps down, shape (2 n + 1,)."""
    up = lowest + step * np.arange(n_steps + 1)
    return np.concatenate([up, up[-2::-1]])


@dataclass(frozen=True)
class Staircase:
    """Staircase of one axis from -n steps to +n steps and back, with the other axis at zero (Sec. 3.1, Fig. 5).

    Parameters
    ----------
    axis : {"x", "y"}
        The axis that moves.
    step : float
        Height of a step [m].
    steps : int
        n, the number of steps from the middle to either end.
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
        """Levels in the order of time [m], shape (4 n + 1,)."""
        return up_and_down(-self.steps * self.step, self.step, 2 * self.steps)

    @property
    def duration_s(self) -> float:
        """Length of the recording [s]."""
        return len(self.levels) * self.hold_s

    def reference(
        self, n_samples: int, sample_time: float, random: np.random.Generator, n_settle: int = 0
    ) -> FloatArray:
        """Return the references r, shape (n_samples, 2) [m]; the first level holds before the logger starts."""
        del random
        r = np.zeros((n_samples, 2))
        r[:, "xy".index(self.axis)] = held_levels(self.levels, self.hold_s, sample_time, n_samples, n_settle)
        return r


@dataclass(frozen=True)
class StackStaircase:
    """Staircase of one stack over its whole range and back, with the other stacks at r_0 (Figs. A.28 and A.29).

    In open loop the voltage of the stack goes from zero to its limit. With the PD controller on, its reference goes
    from zero to its stroke. The machine must have `PiezoStacks`. The recording has the signals v, y_p and r_p.

    Parameters
    ----------
    stack : int
        Number of the stack, 1 to 4.
    controlled : bool
        Whether the PD controller of the stack is on.
    steps : int
        Number of steps from zero to the end. An even number has a level in the middle.
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
        """Return the references r of the pairs, all zero, shape (n_samples, 2) [m]."""
        del sample_time, random, n_settle
        return np.zeros((n_samples, 2))

    def command(self, top: float, n_samples: int, sample_time: float, n_settle: int) -> FloatArray:
        """Return the command of the stack, from zero to `top` and back, shape (n_samples,) [V or m].

        Parameters
        ----------
        top : float
            Highest level [V or m].
        n_samples : int
            Number of samples.
        sample_time : float
            Time between samples [s].
        n_settle : int
            Number of samples before the logger starts.
        """
        return held_levels(
            up_and_down(0.0, top / self.steps, self.steps), self.hold_s, sample_time, n_samples, n_settle
        )


def held_levels(levels: FloatArray, hold_s: float, sample_time: float, n_samples: int, n_settle: int) -> FloatArray:
    """Return levels over time, each held for `hold_s`, shape (n_samples,).

    The first level also holds before the logger starts, the last one until the end.

    Raises
    ------
    UsageError
        When `hold_s` is not a whole number of samples.
    """
    hold = whole_samples("staircase: hold_s", hold_s, sample_time)
    held = np.concatenate([np.full(n_settle, levels[0]), np.repeat(levels, hold)])
    return np.concatenate([held, np.full(max(n_samples - len(held), 0), levels[-1])])[:n_samples]
