"""Time stepping with a program in the loop: the program gets each sample, and its references act in the next."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.rig.machine.controller import LoopProgram
from gbid.rig.stepping.step_arrays import ROW, ROW_WIDTH, Chunk, StepArrays, StepState

StepRun = Callable[[StepArrays, StepState, Chunk], FloatArray]
"""Program that computes the motion over a chunk of samples."""


@dataclass(frozen=True, eq=False)
class ProgramLoop:
    """Program with what it sees beside the position.

    Attributes
    ----------
    program : LoopProgram
        The program.
    angle, speed_rpm : (n,) array
        Shaft angle that the encoder shows [rad], and speed [rpm], for each sample.
    pressure_bar : (n,) array
        Pressure for each sample [bar].
    """

    program: LoopProgram
    angle: FloatArray
    speed_rpm: FloatArray
    pressure_bar: FloatArray

    def part(self, rows: slice) -> ProgramLoop:
        """Return the loop for some of the samples."""
        return ProgramLoop(self.program, self.angle[rows], self.speed_rpm[rows], self.pressure_bar[rows])


def run_with_program(run: StepRun, arrays: StepArrays, state: StepState, chunk: Chunk, loop: ProgramLoop) -> FloatArray:
    """Return the motion over a chunk of samples with a program in the loop.

    Parameters
    ----------
    run : callable
        The time stepping.
    arrays, state, chunk
        Its constants, its state, and the inputs of the samples of `loop`.
    loop : ProgramLoop
        The program, with angle and speed of these samples.

    Returns
    -------
    (n_samples, ROW_WIDTH) array
        Columns as in `gbid.rig.stepping.step_arrays.ROW`.
    """
    n, steps = len(chunk.excitation), 2 * arrays.oversampling
    rows = np.empty((n, ROW_WIDTH))
    for k in range(n):
        r = np.clip(chunk.excitation[k] + state.command, -arrays.travel, arrays.travel)
        one = Chunk(
            r[None],
            chunk.base[k : k + 1],
            chunk.forces[k * steps : (k + 1) * steps + 1],
            chunk.sensor[k : k + 1],
            chunk.taken[k : k + 1],
        )
        rows[k] = run(arrays, state, one)[0]
        seen = rows[k, ROW.seen]
        state.command[:] = loop.program.references(seen, loop.angle[k], loop.pressure_bar[k], loop.speed_rpm[k])
    return rows
