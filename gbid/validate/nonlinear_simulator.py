"""Simulation of a nonlinear model on recordings, from the initial state that is closest to the measured outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from gbid.arrays import BoolArray, FloatArray
from gbid.identify.disturbances.disturbances import UNDISTURBED, Disturbances
from gbid.structure import NonlinearModel
from gbid.validate.simulator import Explained, course

_ROUNDS = 30  # evaluations of a search
_SETTLED = 1e-10  # relative step, and fall of the squares, at which it ends
_FADED = 1e-4  # part of the influence of the initial state that is left in the second half of a stretch
_FIRST, _GROWTH = 16, 4  # samples of the first stretch, for each state, and by how much the next one is longer


@dataclass(frozen=True, eq=False)
class NonlinearSimulator:
    """Nonlinear model prepared for the simulation on recordings; see `Simulator`.

    The initial state is found by least squares, first on the first samples, and then on more and more: over a whole
    recording the squares have many minima. This ends where its influence has faded.

    Attributes
    ----------
    model : NonlinearModel
        The model.
    sample_time : float
        Time between samples [s].
    intersample : {"zoh", "foh"} or sequence of these
        Inter-sample behaviour of the inputs.
    disturbances : Disturbances
        Trends and hum of the outputs, estimated together with the initial state.
    name : str
        Recordings to which the model was fitted, for messages.
    predicts : bool
        Whether the initial state is that of the one-step predictor: a simulation of an unstable model overflows.
    """

    model: NonlinearModel
    sample_time: float
    intersample: str | Sequence[str] = "zoh"
    disturbances: Disturbances = UNDISTURBED
    name: str = "model"
    predicts: bool = False

    def explain(self, inputs: FloatArray, outputs: FloatArray, counted: BoolArray | None = None) -> Explained:
        """Return the initial state whose simulation is closest to the measured outputs; see `Simulator.explain`."""
        size, every = np.maximum(np.abs(self.model.working_state), self.model.state_size), inputs.shape[1]
        used = np.ones(every, bool) if counted is None else counted

        def rest(scaled: FloatArray, n: int) -> FloatArray:
            left = outputs[:, :n] - self._output(inputs[:, :n], outputs[:, :n], scaled * size)
            left = left if counted is None else left[:, counted[:n]]
            return left - course(self.disturbances, self.sample_time, left, n, None if counted is None else counted[:n])

        z = self.model.working_state / size
        for n in [*_lengths(used, len(z)), every]:
            if not np.isfinite(rest(z, n)).all():
                if n < every:
                    continue
                return Explained(np.full(len(z), np.nan), rest(z, n))
            unit = float(np.abs(rest(z, n)).max()) or 1.0
            tolerances = {"xtol": _SETTLED, "ftol": _SETTLED, "gtol": None}
            found = scipy.optimize.least_squares(
                lambda at, n=n, unit=unit: rest(at, n).ravel() / unit, z, max_nfev=_ROUNDS, **tolerances
            )
            z, slopes = found.x, found.jac.reshape(len(outputs), -1, len(z))
            late, largest = (np.linalg.norm(s, axis=(0, 1)).max() for s in (slopes[:, slopes.shape[1] // 2 :], slopes))
            if not self.disturbances.terms and late <= _FADED * largest:
                break  # more samples tell nothing more of the initial state
        return Explained(z * size, rest(z, every))

    def run(self, inputs: FloatArray, initial_state: FloatArray | None = None) -> FloatArray:
        """Return the simulated outputs without trend and hum, (n_outputs, n_samples)."""
        between = self.intersample
        with np.errstate(over="ignore", invalid="ignore"):
            return self.model.simulate(inputs.T, self.sample_time, initial_state=initial_state, intersample=between).T

    def _output(self, inputs: FloatArray, outputs: FloatArray, state: FloatArray) -> FloatArray:
        if not self.predicts:
            return self.run(inputs, state)
        with np.errstate(over="ignore", invalid="ignore"):
            arrays = inputs.T, outputs.T
            between = self.intersample
            return self.model.predict(*arrays, self.sample_time, initial_state=state, intersample=between).T

    def disturbed(self, error: FloatArray, counted: BoolArray | None = None) -> FloatArray:
        """Return the trend and hum that are closest to an error of the simulation; see `Simulator.disturbed`."""
        there = error if counted is None else error[:, counted]
        return course(self.disturbances, self.sample_time, there, error.shape[1], counted, everywhere=True)


def _lengths(counted: BoolArray, n_states: int) -> list[int]:
    """Return the lengths of the stretches before the whole recording, of samples that count enough."""
    found, n = [], _FIRST * n_states
    while n < len(counted):
        if counted[:n].sum() >= 2 * n_states:
            found.append(n)
        n *= _GROWTH
    return found
