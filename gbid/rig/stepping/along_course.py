"""Rotor and bearing along a course of pressure and speed, as constants of short pieces of the time stepping."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.rig.excitation.scheduled_run import Course
from gbid.rig.machine.machine import RotorBearingTruth
from gbid.rig.stepping.step_arrays import BEARING, DELAY, STEP, StepArrays

Surfaces = Callable[[FloatArray, FloatArray], Mapping[str, Any]]
"""True key parameters by name for arrays of pressures [bar] and speeds [rpm], as `gbid.LPVModel.key_parameters`."""

PIECE = 10
"""Samples with constant parameters of rotor and bearing, those in the middle."""


@dataclass(frozen=True, eq=False)
class AlongCourse:
    """Parameters of rotor and bearing in each piece of a run.

    Attributes
    ----------
    truths : tuple of RotorBearingTruth
        Parameters of each piece of `PIECE` samples.
    """

    truths: tuple[RotorBearingTruth, ...]

    @classmethod
    def of(
        cls, surfaces: Surfaces, course: Course, times: FloatArray, deviation: Mapping[str, float] | None = None
    ) -> AlongCourse:
        """Return the parameters at the middle of each piece of a run.

        Parameters
        ----------
        surfaces : callable
            True surfaces.
        course : Course
            Pressure and speed.
        times : (n,) array
            Times of the samples [s].
        deviation : dict of str to float, optional
            Deviation of this recording from the surfaces.

        Raises
        ------
        UsageError
            When the rotor is unstable or a delay is negative on the way.
        """
        step = times[1] - times[0]
        middles = np.array([times[i : i + PIECE].mean() + step / 2 for i in range(0, len(times), PIECE)])
        values = surfaces(*course.at(middles))
        columns = {k: np.broadcast_to(np.asarray(v, float), middles.shape) for k, v in values.items()}
        columns = {k: column + (deviation or {}).get(k, 0.0) for k, column in columns.items()}
        truths = tuple(
            RotorBearingTruth.from_parameters({k: column[i] for k, column in columns.items()})
            for i in range(len(middles))
        )
        for truth in truths[:: max(1, len(truths) // 200)]:
            truth.check_stable()
        return cls(truths)

    def longest(self, arrays: StepArrays) -> StepArrays:
        """Return the constants with the longest delay of each axis on the way."""
        rotor = arrays.rotor.copy()
        rotor[DELAY] = np.max([truth.delay for truth in self.truths], axis=0) / rotor[STEP]
        return replace(arrays, rotor=rotor)

    def arrays(self, arrays: StepArrays, sample: int) -> StepArrays:
        """Return the constants of the simulation in the piece that contains a sample."""
        truth, rotor = self.truths[sample // PIECE], arrays.rotor.copy()
        matrices = (truth.stiffness, truth.damping, truth.input_gain)
        rotor[BEARING] = np.concatenate([matrix.ravel() for matrix in matrices])
        rotor[DELAY] = truth.delay / rotor[STEP]
        return replace(arrays, rotor=rotor)
