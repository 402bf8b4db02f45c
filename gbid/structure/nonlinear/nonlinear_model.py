"""Nonlinear model: equations at given parameters, with simulation and linearisation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from gbid.arrays import FloatArray
from gbid.brief import Brief, Description, brief
from gbid.discretise import IntegratorName, check_holds
from gbid.errors import UsageError
from gbid.hdf5 import Stored
from gbid.structure.nonlinear.equations import symbolic_equations
from gbid.structure.nonlinear.first_steps import over_a_sample
from gbid.structure.nonlinear.nonlinear_structure import NonlinearStructure
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
        return LinearModel(
            A,
            B,
            C,
            D,
            self.K if self.K.any() else None,
            name=self.name,
            input_names=self.input_names,
            output_names=self.output_names,
            state_names=self.state_names,
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
        u, following, x = self._run(inputs, sample_time, initial_state, intersample)
        none = np.zeros((len(u), len(self.output_names)))
        return self._over(self._step_without, x, (u, following, none), sample_time)

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
        u, following, x = self._run(inputs, sample_time, initial_state, intersample)
        y = channels(self.name, "outputs", outputs, len(self.output_names), len(u))
        return self._over(self._step_with, x, (u, following, y), sample_time)

    def _run(
        self, inputs: npt.ArrayLike, sample_time: float, initial_state: Any, intersample: str | Sequence[str]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return checked inputs, those at the end of each sample, and the first state."""
        u = channels(self.name, "inputs", inputs, len(self.input_names))
        check_sample_time(self.name, sample_time)
        start = np.zeros(self.n_states) if initial_state is None else initial_state
        held = np.array([hold == "zoh" for hold in check_holds(intersample, u.shape[1])], bool)
        return u, np.where(held, u, np.vstack([u[1:], u[-1:]])), self._sized("initial_state", start, self.n_states)

    def _over(
        self, step: ca.Function, x: FloatArray, signals: tuple[FloatArray, FloatArray, FloatArray], sample_time: float
    ) -> FloatArray:
        """Return the outputs of all samples, (n_samples, n_outputs), some samples at a time: more would take memory."""
        n = len(signals[0])
        length = min(n, _AT_ONCE)
        run = step.mapaccum(length) if length > 1 else step
        found = []
        for first in range(0, n, length):
            rows = np.minimum(np.arange(first, first + length), n - 1)
            states, outputs = run(x, *(signal[rows].T for signal in signals), self.parameters, sample_time)
            x = np.asarray(states[:, -1], float).ravel()
            found.append(np.array(outputs, float).T)
        return np.concatenate(found)[:n]

    @cached_property
    def _step_without(self) -> ca.Function:
        return self.step_function()

    @cached_property
    def _step_with(self) -> ca.Function:
        return self.step_function(feeds_back=True)

    def step_function(self, *, feeds_back: bool = False) -> ca.Function:
        """Return the discretised equations as a ``casadi.Function``: the model over one sample.

        Parameters
        ----------
        feeds_back : bool
            Whether the disturbance gain feeds the error of the measured outputs back: the one-step predictor.

        Returns
        -------
        casadi.Function
            ``(x, u, u_next, y, p, h)`` to the next state and the output: inputs at both ends of the sample, measured
            outputs, parameters in the order of the structure, and the sample time [s].
        """
        n, n_u, n_y = self.n_states, len(self.input_names), len(self.output_names)
        x, u, last, y, p, h, a, b = _symbols(n, n_u, n_u, n_y, len(self.parameters), 1, n, n_u)
        output = self.function(x, u, p)[1]
        error = y - output if feeds_back else ca.SX.zeros(n_y)
        f = ca.Function("f", [a, b], [self.function(a, b, p)[0] + ca.DM(self.K) @ error], {"allow_free": True})
        after = over_a_sample(self.integrator, f, x, (u, last), h, self.steps)
        return ca.Function("step", [x, u, last, y, p, h], [after, output])

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


def nonlinear_model(
    structure: NonlinearStructure,
    values: Mapping[str, float],
    input_names: tuple[str, ...] = (),
    output_names: tuple[str, ...] = (),
    *,
    steps: int = 1,
) -> NonlinearModel:
    """Return the model of a nonlinear structure for given parameter values.

    Parameters
    ----------
    structure : NonlinearStructure
        The structure.
    values : dict of str to float
        A value for every parameter.
    input_names, output_names : tuple of str, optional
        Names of the channels; by default those of the structure.
    steps : int
        Steps of the integrator in a sample.

    Raises
    ------
    UsageError
        When a value is missing.
    """
    if missing := [q.name for q in structure.parameters if q.name not in values]:
        raise UsageError(f"structure {structure.name!r}: no value for {', '.join(missing)}")
    e = symbolic_equations(structure)
    p = np.array([float(values[q.name]) for q in structure.parameters])
    K = np.array(ca.Function("K", [e.p], [ca.densify(e.K)])(p), float)
    function = ca.Function("equations", [e.x, e.u, e.p], [e.dx, e.y])
    return NonlinearModel(
        structure.name,
        function.serialize(),
        p,
        K.reshape(e.K.shape),
        structure.states,
        input_names or structure.inputs,
        output_names or structure.outputs,
        structure.integrator,
        steps,
    )
