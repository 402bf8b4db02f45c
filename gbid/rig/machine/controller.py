"""Sampled feedback controllers of the rig: state-space matrices, or a program."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gbid.arrays import FloatArray
from gbid.brief import Brief
from gbid.errors import UsageError

TURN = 2 * np.pi


@dataclass(frozen=True, eq=False)
class SampledController(Brief):
    r"""Discrete-time controller from the measured disc position to the references.

    .. math:: x_{k+1} = A x_k + B e_k, \quad w_k = C x_k + D e_k, \quad
              e_k = p_k - \mathcal F_r(\phi_k) - p_0

    The output w_k is added to the excitation one sample later, because the computation takes one sample. The sum is
    limited to the travel of the stacks. Positive gains mean positive feedback, as in the paper (Sec. 5).

    Parameters
    ----------
    A, B, C, D : (n, n), (n, 2), (2, n), (2, 2) array
        State-space matrices; n may be zero.
    sample_time : float
        Time between samples [s]; it must be that of the logger.
    runout : (n_bins, 2) array, optional
        F_r [m] at the shaft angles 2 pi i/n_bins of the encoder, with linear interpolation in between.
    offset : (2,) array
        p_0 [m].
    name : str
        Name of the controller.

    Raises
    ------
    UsageError
        When shapes do not fit, values are not finite, or the sample time is not positive.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    sample_time: float
    runout: FloatArray | None = None
    offset: FloatArray | tuple[float, float] = (0.0, 0.0)
    name: str = "controller"

    def __post_init__(self) -> None:
        n = np.shape(self.A)[0] if np.ndim(self.A) == 2 else -1
        shapes = {"A": (n, n), "B": (n, 2), "C": (2, n), "D": (2, 2), "offset": (2,)}
        if self.runout is not None:
            shapes["runout"] = (max(np.shape(self.runout)[0] if np.ndim(self.runout) else 0, 1), 2)
        for name, shape in shapes.items():
            value = np.array(getattr(self, name), dtype=float)
            if n < 0 or value.shape != shape or not np.isfinite(value).all():
                raise UsageError(
                    f"sampled controller: {name} has shape {value.shape}; give finite numbers, A (n, n), B (n, 2), "
                    "C (2, n), D (2, 2), offset (2,), runout (n_bins, 2)"
                )
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if not (np.isfinite(self.sample_time) and self.sample_time > 0):
            raise UsageError(f"sampled controller: sample_time = {self.sample_time} s; it must be positive")

    def subtracted(self, angle: FloatArray) -> FloatArray:
        """Return the correction that the controller subtracts from the measured position, shape (n, 2) [m].

        Parameters
        ----------
        angle : (n,) array
            Shaft angle that the encoder shows [rad].
        """
        if self.runout is None:
            return np.tile(np.asarray(self.offset), (len(angle), 1))
        nodes = np.arange(len(self.runout) + 1) * (TURN / len(self.runout))
        closed = np.vstack([self.runout, self.runout[:1]])
        wrapped = np.mod(angle, TURN)
        return np.column_stack([np.interp(wrapped, nodes, closed[:, j]) for j in range(2)]) + self.offset


class LoopProgram(Protocol):
    """Program that makes references from samples, as the compiled control chain of a target."""

    def references(self, position: FloatArray, angle: float, pressure_bar: float, speed_rpm: float) -> FloatArray:
        """Return r_x, r_y [m] for one sample: p_x, p_y as measured [m], shaft angle [rad], and operating point."""
        ...


@dataclass(frozen=True, eq=False)
class ProgramController:
    """Feedback by a program that gets each sample in turn; software in the loop.

    Its references act one sample later and are limited to the travel of the stacks, as those of `SampledController`.

    Parameters
    ----------
    program : LoopProgram
        The program.
    sample_time : float
        Time between samples [s]; it must be that of the logger.
    name : str
        Name of the controller.
    """

    program: LoopProgram
    sample_time: float
    name: str = "program"
