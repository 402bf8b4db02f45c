"""Nonlinear model: equations at given parameters, with simulation and linearisation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.brief import Brief, Description, brief
from gbid.discretise import Hold, IntegratorName, check_holds
from gbid.errors import UsageError
from gbid.hdf5 import Stored
from gbid.structure.nonlinear.first_steps import over_a_sample
from gbid.structure.numeric.linear_model import LinearModel
from gbid.structure.numeric.sampled_run import channels, check_sample_time

_AT_ONCE = 4096  # samples of a simulation that CasADi holds at once


@dataclass(frozen=True, eq=False)
class NonlinearModel(Brief):
    """Nonlinear model ``xd = f(x, u) + K e``, ``y = h(x, u) + e`` with numbers for its parameters.

    Attributes
    ----------
    name : str
        Name of the structure.
    equations : str
        ``casadi.Function.serialize()`` of ``(x, u, p) -> (f, h)``.
    parameters : (n_parameters,) array
        Values of the parameters.
    K : (n_states, n_outputs) array
        Disturbance gain; zero without one.
    state_names, input_names, output_names : tuple of str
        Names of the states and channels.
    integrator : {"rk4", "implicit"}
        Integrator of simulations.
    steps : int
        Steps of the integrator in a sample.
    delay : (n_inputs,) array or None
        Exact delays of the inputs [s]; None without them.
    working_state, working_input : (n_states,) and (n_inputs,) array
        Working point of `linearise` when none is given: the means over the recordings of a fit.
    state_size : (n_states,) array
        Root mean square of the states over these recordings.
    """

    name: str
    equations: str
    parameters: Annotated[FloatArray, Stored("SI", "values of the parameters")]
    K: Annotated[FloatArray, Stored("SI", "disturbance gain")]
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    integrator: IntegratorName = "rk4"
    steps: int = 1
    delay: Annotated[FloatArray | None, Stored("s", "delay of the model")] = None
    working_state: Annotated[FloatArray, Stored("SI", "state of the working point")] = field(
        default_factory=lambda: np.zeros(0)
    )
    working_input: Annotated[FloatArray, Stored("SI", "inputs of the working point")] = field(
        default_factory=lambda: np.zeros(0)
    )
    state_size: Annotated[FloatArray, Stored("SI", "root mean square of the states")] = field(
        default_factory=lambda: np.zeros(0)
    )

    def __post_init__(self) -> None:
        if not len(self.working_state):
            object.__setattr__(self, "working_state", np.zeros(self.n_states))
            object.__setattr__(self, "working_input", np.zeros(len(self.input_names)))
            object.__setattr__(self, "state_size", np.ones(self.n_states))

    def _brief(self) -> Description:
        return brief(
            self,
            f"{self.name}, {self.n_states} states, nonlinear",
            state_names=self.state_names,
            input_names=self.input_names,
            output_names=self.output_names,
        )

    @property
    def n_states(self) -> int:
        """Number of states."""
        return len(self.state_names)

    @cached_property
    def function(self) -> ca.Function:
        """``casadi.Function`` of ``(x, u, p)`` with the derivatives of the states and the outputs."""
        return ca.Function.deserialize(self.equations)

    def linearise(
        self,
        x0: npt.ArrayLike | None = None,
        u0: npt.ArrayLike | None = None,
        *,
        amplitude: npt.ArrayLike | None = None,
    ) -> LinearModel:
        """Return the linear model of deviations from a working point: small ones, or those of an amplitude.

        Parameters
        ----------
        x0 : (n_states,) array, optional
            State; by default the mean state of the recordings of the fit.
        u0 : (n_inputs,) array, optional
            Inputs; by default their means.
        amplitude : (n_states,) array, optional
            Standard deviations of the states about `x0`. The derivatives are then their means over normal
            distributions (statistical linearisation), exact for equations of third degree: what a linear fit finds in
            motions of this amplitude.

        Returns
        -------
        LinearModel
            In continuous time, with the derivatives of dynamics and output as matrices.

        Raises
        ------
        UsageError
            When sizes do not fit, or when a derivative is not finite there.
        """
        x = self._sized("x0", self.working_state if x0 is None else x0, self.n_states)
        u = self._sized("u0", self.working_input if u0 is None else u0, len(self.input_names))
        points = [x]
        if amplitude is not None:  # cubature of third degree for the means
            sides = np.diag(np.sqrt(self.n_states) * self._sized("amplitude", amplitude, self.n_states))
            points = [x + side for side in (*sides, *-sides)]
        slopes = [[np.array(m, float) for m in self._slopes(point, u, self.parameters)] for point in points]
        A, B, C, D = (np.mean(each, axis=0) for each in zip(*slopes, strict=True))
        if not all(np.isfinite(m).all() for m in (A, B, C, D)):
            raise UsageError(f"model {self.name!r}: the derivatives at x0 = {x}, u0 = {u} are not finite; give another")
        late = np.zeros(len(u)) if self.delay is None else self.delay
        return LinearModel(
            A,
            np.where(late > 0, 0.0, B),
            C,
            D,
            self.K if self.K.any() else None,
            name=self.name,
            input_names=self.input_names,
            output_names=self.output_names,
            state_names=self.state_names,
            B_delayed=None if self.delay is None else np.where(late > 0, B, 0.0),
            delay=self.delay,
        )

    def modes(self) -> list[tuple[float, float]]:
        """Return the modes of the linear model at the working point; see `LinearModel.modes`."""
        return self.linearise().modes()

    def static_gain(self) -> FloatArray:
        """Return the static gain of the linear model at the working point; see `LinearModel.static_gain`."""
        return self.linearise().static_gain()

    def simulate(
        self,
        inputs: npt.ArrayLike,
        sample_time: float,
        *,
        initial_state: npt.ArrayLike | None = None,
        intersample: str | Sequence[str] = "zoh",
    ) -> FloatArray:
        """Return the response to sampled inputs.

        Parameters
        ----------
        inputs : (n_samples, n_inputs) array
            Input signals.
        sample_time : float
            Time between samples [s].
        initial_state : (n_states,) array, optional
            State at the first sample; zero when not given.
        intersample : {"zoh", "foh"} or sequence of these
            Inter-sample behaviour of the inputs.

        Returns
        -------
        (n_samples, n_outputs) array
            Output signals; not finite from where the model overflows.

        Raises
        ------
        UsageError
            When shapes do not fit, an input is not finite, or the sample time is not positive.
        """
        u, holds, x = self._run(inputs, sample_time, initial_state, intersample)
        none = np.zeros((len(u), len(self.output_names)))
        return self._over(self._step(holds, feeds_back=False), x, u, none, sample_time)

    def predict(
        self,
        inputs: npt.ArrayLike,
        outputs: npt.ArrayLike,
        sample_time: float,
        *,
        initial_state: npt.ArrayLike | None = None,
        intersample: str | Sequence[str] = "zoh",
    ) -> FloatArray:
        """Return one-step-ahead predictions of the outputs; without a disturbance gain this is the simulation.

        Parameters
        ----------
        inputs : (n_samples, n_inputs) array
            Input signals.
        outputs : (n_samples, n_outputs) array
            Measured outputs.
        sample_time : float
            Time between samples [s].
        initial_state : (n_states,) array, optional
            State at the first sample; zero when not given.
        intersample : {"zoh", "foh"} or sequence of these
            Inter-sample behaviour of the inputs.

        Returns
        -------
        (n_samples, n_outputs) array
            Predicted outputs.

        Raises
        ------
        UsageError
            As for `simulate`, or when the outputs do not fit.
        """
        u, holds, x = self._run(inputs, sample_time, initial_state, intersample)
        y = channels(self.name, "outputs", outputs, len(self.output_names), len(u))
        return self._over(self._step(holds, feeds_back=True), x, u, y, sample_time)

    def _run(
        self, inputs: npt.ArrayLike, sample_time: float, initial_state: Any, intersample: str | Sequence[str]
    ) -> tuple[FloatArray, tuple[Hold, ...], FloatArray]:
        """Return the inputs around each sample as `step_function` takes them, their holds, and the first state."""
        u = channels(self.name, "inputs", inputs, len(self.input_names))
        check_sample_time(self.name, sample_time)
        start = np.zeros(self.n_states) if initial_state is None else initial_state
        shift = np.zeros(u.shape[1], int) if self.delay is None else np.floor(self.delay / sample_time).astype(int)
        rows = np.arange(len(u))[:, None, None] - shift[:, None] + [1, 0, -1]  # (n_samples, n_inputs, 3)
        around = u[np.clip(rows, 0, len(u) - 1), np.arange(u.shape[1])[:, None]]
        holds = check_holds(intersample, u.shape[1])
        return around, holds, self._sized("initial_state", start, self.n_states)

    def _over(self, step: ca.Function, x: FloatArray, u: FloatArray, y: FloatArray, sample_time: float) -> FloatArray:
        """Return the outputs of all samples, (n_samples, n_outputs), some samples at a time: more would take memory."""
        n = len(u)
        length = min(n, _AT_ONCE)
        run = step.mapaccum(length) if length > 1 else step
        found = []
        for first in range(0, n, length):
            rows = np.minimum(np.arange(first, first + length), n - 1)
            around = u[rows].transpose(1, 0, 2).reshape(u.shape[1], -1)
            states, outputs = run(x, around, y[rows].T, self.parameters, sample_time)
            x = np.asarray(states[:, -1], float).ravel()
            found.append(np.array(outputs, float).T)
        return np.concatenate(found)[:n]

    def _step(self, holds: tuple[Hold, ...], *, feeds_back: bool) -> ca.Function:
        if (holds, feeds_back) not in self._made:
            self._made[holds, feeds_back] = self.step_function(holds, feeds_back=feeds_back)
        return self._made[holds, feeds_back]

    @cached_property
    def _made(self) -> dict[tuple[tuple[Hold, ...], bool], ca.Function]:
        return {}

    def step_function(self, holds: Sequence[Hold], *, feeds_back: bool = False) -> ca.Function:
        """Return the discretised equations as a ``casadi.Function``: the model over one sample.

        Parameters
        ----------
        holds : sequence of {"zoh", "foh"}
            Hold of each input.
        feeds_back : bool
            Whether the disturbance gain feeds the error of the measured outputs back: the one-step predictor.

        Returns
        -------
        casadi.Function
            ``(x, u, y, p, h)`` to the next state and the output: inputs (n_inputs, 3) at the samples k + 1, k and
            k - 1, earlier by the whole samples in the delay of each; measured outputs; parameters in the order of the
            structure; and the sample time [s].
        """
        n, n_u, n_y = self.n_states, len(self.input_names), len(self.output_names)
        x, y, p, h, a, b = _symbols(n, n_y, len(self.parameters), 1, n, n_u)
        u, delay = ca.SX.sym("u", n_u, 3), np.zeros(n_u) if self.delay is None else self.delay
        output = self.function(x, u[:, 1], p)[1]
        error = y - output if feeds_back else ca.SX.zeros(n_y)
        f = ca.Function("f", [a, b], [self.function(a, b, p)[0] + ca.DM(self.K) @ error], {"allow_free": True})
        early = [own / h - ca.floor(own / h) if own > 0 else None for own in delay.tolist()]
        after = over_a_sample(self.integrator, f, x, u, holds, early, h, self.steps)
        return ca.Function("step", [x, u, y, p, h], [after, output])

    @cached_property
    def _slopes(self) -> ca.Function:
        x, u, p = _symbols(self.n_states, len(self.input_names), len(self.parameters))
        outputs = self.function(x, u, p)
        return ca.Function("slopes", [x, u, p], [ca.densify(ca.jacobian(y, at)) for y in outputs for at in (x, u)])

    def _sized(self, what: str, value: Any, size: int) -> FloatArray:
        found = np.asarray(value, float).ravel()
        if found.shape != (size,) or not np.isfinite(found).all():
            raise UsageError(f"model {self.name!r}: {what} = {value}; give {size} finite numbers")
        return found


def _symbols(*sizes: int) -> list[ca.SX]:
    return [ca.SX.sym(f"s{i}", size) for i, size in enumerate(sizes)]
