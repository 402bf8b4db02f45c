"""What every predictor has, linear or not: free parameters, sizes, and regressors from the samples of a record."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.discretise import Hold
from gbid.identify.disturbances.disturbances import Disturbances
from gbid.structure import Parameter


@dataclass(frozen=True, eq=False)
class GeneralPredictor(ABC):
    """Predictor of a structure for one set of free parameters, sample time, hold and focus.

    Attributes
    ----------
    free : tuple of Parameter
        Parameters to estimate, in order.
    noise : tuple of int
        Positions of the free parameters on which only the disturbance gain depends.
    unused : tuple of str
        Parameters without effect for this focus (the disturbance gain in simulation focus).
    n_states, n_inputs, n_outputs : int
        Numbers of states (with those of random walks), inputs and outputs.
    holds : tuple of {"zoh", "foh"}
        Behaviour of each input between samples.
    prompt, delayed : tuple of int
        Inputs without delay, and inputs with an exact delay.
    feeds_back : bool
        Whether measured outputs are regressors.
    disturbances : Disturbances
        Disturbances of the outputs. Their coefficients are the last free parameters.
    walks : tuple of int
        Positions of the free parameters that are gains of random walks. The last states are their offsets.
    horizon : int
        Number of steps of the prediction.
    sample_time : float
        Time between samples [s].
    released : bool
        Whether initial states are functions of the parameters. They act like an impulse at the first sample.
    spare : int
        Number of states, the last ones, that are zero and without effect; see `with_spare_states`.
    """

    free: tuple[Parameter, ...]
    noise: tuple[int, ...]
    unused: tuple[str, ...]
    n_states: int
    n_inputs: int
    n_outputs: int
    holds: tuple[Hold, ...]
    prompt: tuple[int, ...]
    delayed: tuple[int, ...]
    feeds_back: bool
    disturbances: Disturbances
    walks: tuple[int, ...]
    horizon: int
    sample_time: float
    released: bool
    spare: int = field(default=0, kw_only=True)

    @property
    def _lead(self) -> list[int]:
        """Prompt inputs whose next sample is also a regressor."""
        return [i for i in self.prompt if self.holds[i] == "foh"]

    @property
    def _has_impulse(self) -> bool:
        """Whether an impulse is a regressor: for released states, and with zeros as its columns for a free decay."""
        driven = self.prompt or self.delayed or self.feeds_back or self.disturbances.n_columns
        return self.released or not driven

    def regressors(self, inputs: FloatArray, outputs: FloatArray, shift: tuple[int, ...]) -> FloatArray:
        """Return the regressors ``z`` of one record, shape (n_samples - horizon + 1, n_z).

        Row k contains, in this order: prompt inputs ``u[k]``; ``u[k+1]`` of those under first-order hold; for each
        delayed input its samples around ``k - shift``; those of trends and hum; an impulse at the first sample;
        ``y[k]`` if the disturbance gain is used; and all but the last again for a longer horizon. Before the record an
        input is constant at its first sample. After it the input is constant at its last sample, without effect.
        """
        n = len(inputs)

        def lagged(channels: Sequence[int], lag: int) -> FloatArray:
            rows = np.clip(np.arange(n) - lag, 0, n - 1)
            return np.asarray(inputs[np.ix_(rows, np.array(channels, int))])

        parts = [inputs[:, list(self.prompt)]]
        if self._lead:
            parts.append(lagged(self._lead, -1))
        for i, d in zip(self.delayed, shift, strict=True):
            first = d - 1 if self.holds[i] == "foh" else d
            parts += [lagged([i], lag) for lag in range(first, d + 2)]
        if self.disturbances.n_columns:
            parts.append(self.disturbances.regressors(n, self.sample_time))
        if self._has_impulse:
            parts.append(np.eye(n, 1))
        now = np.hstack(parts)
        z = [now, outputs] if self.feeds_back else [now]
        rows = n - self.horizon + 1
        return np.hstack([part[:rows] for part in z] + [now[i : i + rows] for i in range(1, self.horizon)])

    def targets(self, outputs: FloatArray) -> FloatArray:
        """Return the outputs that the rows of `regressors` predict, shape (n_samples - horizon + 1, n_outputs)."""
        return outputs[self.horizon - 1 :]

    @abstractmethod
    def at(self, theta: FloatArray) -> Any:
        """Return the predictor at values of the free parameters, shape (n_free,), as its kernel needs it."""

    def at_each(self, points: FloatArray) -> list[Any]:
        """Return the predictors at several points that are close to each other, shape (n_points, n_free).

        Those of a linear structure have the regressors of the first point: the same whole samples in their delays.
        """
        return [self.at(point) for point in points]

    @abstractmethod
    def released_state(self, theta: FloatArray) -> FloatArray:
        """Return the initial state as a function of the parameters, (n_states,); zero where it is not."""
