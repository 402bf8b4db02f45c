"""Simulation of a nonlinear model on recordings, from the initial state that is closest to the measured outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gbid.arrays import BoolArray, FloatArray
from gbid.identify.disturbances.disturbances import UNDISTURBED, Disturbances
from gbid.structure import NonlinearModel
from gbid.validate.simulator import Explained, course

_ROUNDS = 30
_SETTLED = 1e-10  # relative fall of the squares at which the search ends
_STEP = 1e-6  # of a difference, as a part of the size of a state
_DAMPED = 1e-3  # first damping, as a part of the curvature


@dataclass(frozen=True, eq=False)
class NonlinearSimulator:
    """Nonlinear model prepared for the simulation on recordings; see `Simulator`.

    The initial state is found by Levenberg's and Marquardt's method, from the working point of the model.

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
    """

    model: NonlinearModel
    sample_time: float
    intersample: str | Sequence[str] = "zoh"
    disturbances: Disturbances = UNDISTURBED
    name: str = "model"

    def explain(self, inputs: FloatArray, outputs: FloatArray, counted: BoolArray | None = None) -> Explained:
        """Return the initial state whose simulation is closest to the measured outputs; see `Simulator.explain`."""
        size = np.maximum(np.abs(self.model.working_state), self.model.state_size)

        def rest(state: FloatArray) -> FloatArray:
            left = outputs - self.run(inputs, state)
            left = left if counted is None else left[:, counted]
            return left - course(self.disturbances, self.sample_time, left, inputs.shape[1], counted)

        x = self.model.working_state.copy()
        here, damping = rest(x), _DAMPED
        for _ in range(_ROUNDS):
            if not np.isfinite(here).all():
                return Explained(np.full(len(x), np.nan), here)
            slopes = np.stack([((rest(x + d) - here) / _STEP).ravel() for d in np.diag(_STEP * size)], axis=1)
            normal, onto = slopes.T @ slopes, slopes.T @ here.ravel()
            before = float((here**2).sum())
            for _ in range(_ROUNDS):
                ridge = damping * (np.diag(normal) + 1e-12 * np.trace(normal) + 1e-300)
                moved = x - size * np.linalg.solve(normal + np.diag(ridge), onto)
                there = rest(moved)
                if np.isfinite(there).all() and float((there**2).sum()) <= before:
                    break
                damping *= 10
            else:
                break
            x, here, damping = moved, there, damping / 10
            if before - float((here**2).sum()) <= _SETTLED * before:
                break
        return Explained(x, here)

    def run(self, inputs: FloatArray, initial_state: FloatArray | None = None) -> FloatArray:
        """Return the simulated outputs without trend and hum, (n_outputs, n_samples)."""
        between = self.intersample
        with np.errstate(over="ignore", invalid="ignore"):
            return self.model.simulate(inputs.T, self.sample_time, initial_state=initial_state, intersample=between).T

    def disturbed(self, error: FloatArray, counted: BoolArray | None = None) -> FloatArray:
        """Return the trend and hum that are closest to an error of the simulation; see `Simulator.disturbed`."""
        there = error if counted is None else error[:, counted]
        return course(self.disturbances, self.sample_time, there, error.shape[1], counted, everywhere=True)
