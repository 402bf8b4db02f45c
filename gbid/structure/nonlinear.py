"""Nonlinear structures and models: differential equations of a user as functions of parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, Literal, NamedTuple

import casadi as ca
import numpy as np
import numpy.typing as npt
from annotated_types import Ge, Le

from gbid.core.arrays import FloatArray
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import NoValueAtStartError, UsageError
from gbid.core.hdf5 import NOT_STORED, Stored
from gbid.core.option_types import Allowed, Exact, OneText, check_options, checks_arguments
from gbid.discretise import Hold
from gbid.discretise.steps import IntegratorName, one_step, step_inputs
from gbid.structure.linear import as_names, in_one_line
from gbid.structure.models import LinearModel, SampledSignals, check_clock
from gbid.structure.parameter import Parameter, Values, as_vector, once, set_fields

MOST_STEPS = 256
"""Largest number of steps of an integrator in a sample."""
_Steps = Annotated[
    Annotated[int, Exact(), Ge(1), Le(MOST_STEPS)] | Literal["auto"],
    Allowed(f"a number from 1 to {MOST_STEPS} or 'auto'"),
]


@dataclass(frozen=True)
class NonlinearStructure:
    """Nonlinear model structure defined by a user: ``xd = f(x, u, p) + K e``, ``y = h(x, u, p) + e``.

    Parameters
    ----------
    name : str
        Name of the structure.
    parameters : sequence of Parameter
        Parameters, each with a start value.
    states : sequence of str
        Names of the states.
    dynamics : callable
        ``dynamics(x, u, p)`` returns the derivatives of the states: a CasADi vector, or a list of one expression for
        each state. ``x[i]`` and ``u[i]`` are CasADi symbols, ``p.name`` or ``p["name"]`` are the parameters.
    output : callable
        ``output(x, u, p)`` returns the outputs in the same way.
    inputs, outputs : str or sequence of str
        Channels of the recordings, one for each ``u[i]`` and each output: ``"u.x"`` is a channel of the signal ``"u"``.
        ``inputs=()`` for a structure that only decays.
    intersample : {"zoh", "foh"}
        Inter-sample behaviour of the inputs: held, or on a straight line.
    disturbance_gain : callable, optional
        ``disturbance_gain(p)`` returns the constant gain K, (n_states, n_outputs), of the prediction error e, which is
        held between samples (innovations form). Without it, prediction and simulation are the same.
    delay : callable, optional
        ``delay(p)`` returns the exact delay of each input [s]: ``u[i]`` is then the input at the time ``t - delay``. A
        zero is for an input without delay. Give the parameter of a delay ``lower=0.0``.
    x0 : callable, optional
        ``x0(p)`` returns the initial state of every recording as a function of the parameters. By default initial
        states are estimated.
    integrator : {"rk4", "implicit"}
        ``"rk4"`` is the explicit method of Runge and Kutta of fourth order. ``"implicit"`` is for stiff equations: a
        Rosenbrock method of third order with one Newton step for each of its four stages (L-stable).
    steps : int or "auto"
        Steps of the integrator in a sample. ``"auto"`` begins with as many as the fastest pole at the start values
        needs, and takes twice as many where the error of the integration moves an estimate by more than a tenth of its
        standard deviation.

    Raises
    ------
    UsageError
        When two parameters or states have the same name, there are no states or outputs, or an option is unknown.

    Examples
    --------
    >>> def spring(x, u, p):
    ...     return [x[1], u[0] - p.d * x[1] - p.k * x[0] - p.c * x[0] ** 3]
    >>> known = [Parameter("k", 1.0), Parameter("d", 0.1), Parameter("c", 0.5)]
    >>> NonlinearStructure("spring", known, ["x", "v"], spring, lambda x, u, p: x[0], "u", "y").states
    ('x', 'v')
    """

    name: str
    parameters: tuple[Parameter, ...]
    states: tuple[str, ...]
    dynamics: Callable[[Any, Any, Values], Any]
    output: Callable[[Any, Any, Values], Any]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    intersample: Hold = "zoh"
    disturbance_gain: Callable[[Values], Any] | None = None
    delay: Callable[[Values], Any] | None = None
    x0: Callable[[Values], Any] | None = None
    integrator: IntegratorName = "rk4"
    steps: _Steps = "auto"

    @checks_arguments
    def __init__(
        self,
        name: str,
        parameters: Sequence[Parameter],
        states: str | Sequence[str],
        dynamics: Callable[[Any, Any, Values], Any],
        output: Callable[[Any, Any, Values], Any],
        inputs: str | Sequence[str] = "u",
        outputs: str | Sequence[str] = "y",
        *,
        intersample: Hold = "zoh",
        disturbance_gain: Callable[[Values], Any] | None = None,
        delay: Callable[[Values], Any] | None = None,
        x0: Callable[[Values], Any] | None = None,
        integrator: IntegratorName = "rk4",
        steps: int | Literal["auto"] = "auto",
    ) -> None:
        where = f"structure {name!r}"
        names = {"states": as_names(states), "inputs": as_names(inputs), "outputs": as_names(outputs)}
        set_fields(self, {**locals(), **names, "parameters": tuple(parameters)})
        if twice := [state for state in self.states if self.states.count(state) > 1]:
            raise UsageError(f"{where}: state {min(twice)!r} is listed more than once")
        for what in ("states", "outputs"):
            if not names[what]:
                raise UsageError(f"{where}: no {what}")
        check_options(self, where)


_JUMPS = {
    ca.OP_LT: "<",
    ca.OP_LE: "<=",
    ca.OP_EQ: "==",
    ca.OP_NE: "!=",
    ca.OP_IF_ELSE_ZERO: "if_else",
    ca.OP_FLOOR: "floor",
    ca.OP_CEIL: "ceil",
    ca.OP_SIGN: "sign",
    ca.OP_FABS: "fabs",
    ca.OP_FMIN: "fmin",
    ca.OP_FMAX: "fmax",
    ca.OP_FMOD: "fmod",
}
"""Operations of CasADi that have a jump or a kink."""


class Equations(NamedTuple):
    """Equations of a nonlinear structure as casadi.SX expressions.

    Attributes
    ----------
    x, u, p : casadi.SX
        Symbols of states, inputs and parameters: (n, 1), (n_inputs, 1), (n_parameters, 1).
    dx, y : casadi.SX
        Derivatives of the states (n, 1), and outputs (n_outputs, 1).
    K : casadi.SX
        Disturbance gain, (n, n_outputs).
    x0 : casadi.SX
        Initial state, (n, 1); empty when the structure states none.
    delay : casadi.SX
        Exact delays of the inputs [s], (n_inputs, 1); without an entry for an input without delay.
    """

    x: ca.SX
    u: ca.SX
    p: ca.SX
    dx: ca.SX
    y: ca.SX
    K: ca.SX
    x0: ca.SX
    delay: ca.SX

    @property
    def delayed(self) -> tuple[int, ...]:
        """Inputs that have an exact delay."""
        return tuple(self.delay.sparsity().row())


@once
def symbolic_equations(structure: NonlinearStructure) -> Equations:
    """Return the equations of a structure as CasADi expressions, checked.

    Parameters
    ----------
    structure : NonlinearStructure
        The structure.

    Returns
    -------
    Equations
        Expressions of checked shape.

    Raises
    ------
    UsageError
        When a function of the structure fails, or returns what is no CasADi expression, or of wrong size.
    """
    x, u = _symbols(structure.states), _symbols(structure.inputs)
    p = _symbols([q.name for q in structure.parameters])
    known, n, n_y = Values.of(structure.parameters, p), len(structure.states), len(structure.outputs)

    def column(what: str, value: Callable[[], Any], rows: int, each: str) -> ca.SX:
        result = _expression(structure.name, what, value)
        if result.shape == (1, rows):
            result = result.T
        if result.shape != (rows, 1):
            raise UsageError(
                f"structure {structure.name!r}: {what} returns {result.numel()} expressions, one for each {each} is "
                f"needed: {rows}"
            )
        return ca.densify(result)

    dx = column("dynamics(x, u, p)", lambda: structure.dynamics(x, u, known), n, "state")
    y = column("output(x, u, p)", lambda: structure.output(x, u, known), n_y, "output")
    gain, initial, delays = structure.disturbance_gain, structure.x0, structure.delay
    K = ca.SX(n, n_y)
    if gain is not None:
        K = _expression(structure.name, "disturbance_gain(p)", lambda: gain(known))
        if K.shape != (n, n_y):
            raise UsageError(
                f"structure {structure.name!r}: disturbance_gain(p) has shape {K.shape}, expected {(n, n_y)}: a row "
                "for each state, a column for each output"
            )
    x0 = ca.SX(0, 1) if initial is None else column("x0(p)", lambda: initial(known), n, "state")
    n_u = len(structure.inputs)
    delay = ca.SX(n_u, 1) if delays is None else ca.sparsify(column("delay(p)", lambda: delays(known), n_u, "input"))
    parts = {"dynamics": dx, "output": y, "disturbance_gain": K, "x0": x0, "delay": delay}
    for what, expression in parts.items():
        symbols = [x, u, p] if what in ("dynamics", "output") else [p]
        function = ca.Function("e", symbols, [expression], {"allow_free": True})
        if foreign := [symbol.name() for symbol in function.free_sx()]:
            raise UsageError(f"structure {structure.name!r}: {what} contains unknown symbols: {', '.join(foreign)}")
        if any(np.isnan(c) for c in _constants(function)):
            raise UsageError(
                f"structure {structure.name!r}: {what} contains nan: a function that is not casadi's, such as "
                "math.sin or float, was applied to a symbol; use functions of casadi, such as casadi.sin"
            )
    equations = Equations(x, u, p, dx, y, K, x0, delay)
    if at_once := [structure.inputs[i] for i in equations.delayed if ca.depends_on(y, u[i])]:
        raise UsageError(
            f"structure {structure.name!r}: output contains the delayed input {', '.join(at_once)}; delayed inputs act "
            "on the derivatives of the states only"
        )
    return equations


def jumps_in(equations: Equations) -> tuple[str, ...]:
    """Return the names of operations with a jump or a kink in dynamics and output."""
    function = ca.Function("f", list(equations[:3]), [equations.dx, equations.y])
    met = {function.instruction_id(k) for k in range(function.n_instructions())}
    return tuple(name for operation, name in _JUMPS.items() if operation in met)


def _constants(function: ca.Function) -> list[float]:
    every = range(function.n_instructions())
    return [float(function.instruction_constant(k)) for k in every if function.instruction_id(k) == ca.OP_CONST]


def _symbols(names: Sequence[str]) -> ca.SX:
    return ca.vertcat(*(ca.SX.sym(name) for name in names)) if names else ca.SX(0, 1)


def _expression(name: str, what: str, value: Callable[[], Any]) -> ca.SX:
    try:
        returned = value()
    except UsageError:
        raise
    except Exception as error:
        raise UsageError(
            f"structure {name!r}: {what} failed: {in_one_line(error)}; write it with x[i], u[i], p.name and functions "
            "of casadi, such as casadi.sin"
        ) from error
    try:
        if isinstance(returned, ca.SX | ca.DM | float | int):
            return ca.SX(returned)
        rows = [row if isinstance(row, list | tuple) else [row] for row in list(returned)]
        return ca.vertcat(*(ca.horzcat(*(ca.SX(entry) for entry in row)) for row in rows))
    except Exception as error:
        raise UsageError(
            f"structure {name!r}: {what} returns {type(returned).__name__}, which is no CasADi expression (casadi.SX) "
            f"and no list of such: {in_one_line(error)}"
        ) from None


_RADIANS = 1.0  # that the fastest pole turns in a step of the explicit method, at the start


def first_steps(structure: NonlinearStructure, p: FloatArray, sample_time: float) -> int:
    """Return the initial number of integrator steps per sample: stated by the structure, or from the fastest pole.

    With ``steps="auto"`` the fastest pole at rest turns by a radian at most in one step.

    Parameters
    ----------
    structure : NonlinearStructure
        The structure.
    p : (n_parameters,) array
        Values of all parameters.
    sample_time : float
        Time between samples [s].

    Raises
    ------
    NoValueAtStartError
        When the pole is too fast for the explicit method.
    """
    if structure.steps != "auto":
        return structure.steps
    e = symbolic_equations(structure)
    slopes = ca.Function("slopes", [e.x, e.u, e.p], [ca.densify(ca.jacobian(e.dx, e.x))])
    A = np.asarray(slopes(np.zeros(e.x.numel()), np.zeros(e.u.numel()), p), float)
    if structure.integrator == "implicit" or not np.isfinite(A).all():
        return 1
    fastest = float(np.abs(np.linalg.eigvals(A)).max(initial=0.0)) * sample_time
    if fastest > MOST_STEPS:
        raise NoValueAtStartError(
            f"structure {structure.name!r}: the fastest pole at the start needs {fastest:.0f} steps in a sample: "
            "the equations are stiff; use integrator='implicit'"
        )
    return max(1, int(np.ceil(fastest / _RADIANS)))


def over_a_sample(
    method: IntegratorName,
    f: ca.Function,
    x: ca.SX,
    u: ca.SX,
    holds: Sequence[Hold],
    early: Sequence[Any | None],
    sample_time: ca.SX,
    steps: int,
) -> ca.SX:
    """Return the state after one sample in several integrator steps; arguments as for `one_step`, `step_inputs`."""
    at, a, b = (ca.SX.sym(name, n) for name, n in (("x", x.numel()), ("a", u.shape[0]), ("b", u.shape[0])))
    length = ca.SX.sym("h")
    sub = ca.Function("sub", [at, a, b, length], [one_step(method, f, at, (a, b), length)], {"allow_free": True})
    for i in range(steps):
        x = sub(x, *step_inputs(u, holds, early, i / steps, 1 / steps), sample_time / steps)
    return x


# ---- Nonlinear model with numeric parameters: simulation and linearisation.

_AT_ONCE = 4096  # samples of a simulation that CasADi holds at once


@dataclass(frozen=True, eq=False)
class NonlinearModel(SampledSignals, Brief):
    """Nonlinear model ``xd = f(x, u) + K e``, ``y = h(x, u) + e`` with numeric parameters.

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
    working_state, working_input : (n_states,) and (n_inputs,) array
        Working point of `linearise` when none is given: the means over the recordings of a fit, else zero.
    state_size : (n_states,) array
        Root mean square of the states over these recordings, else one.
    integrator : {"rk4", "implicit"}
        Integrator of simulations.
    steps : int
        Steps of the integrator in a sample.
    delay : (n_inputs,) array or None
        Exact delays of the inputs [s]; None without them.
    intersample : tuple of {"zoh", "foh"} or None
        Inter-sample behaviour of each input that simulations assume unless told otherwise: that of the fit.
    """

    name: str
    equations: str
    parameters: Annotated[FloatArray, Stored("SI", "values of the parameters")]
    K: Annotated[FloatArray, Stored("SI", "disturbance gain")]
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    working_state: Annotated[FloatArray, Stored("SI", "state of the working point")]
    working_input: Annotated[FloatArray, Stored("SI", "inputs of the working point")]
    state_size: Annotated[FloatArray, Stored("SI", "root mean square of the states")]
    integrator: IntegratorName = "rk4"
    steps: int = 1
    delay: Annotated[FloatArray | None, Stored("s", "delay of the model")] = None
    intersample: Annotated[tuple[Hold, ...] | None, NOT_STORED, OneText()] = None

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
        """``casadi.Function`` of ``(x, u, p)`` that returns state derivatives and outputs."""
        return ca.Function.deserialize(self.equations)

    def with_integrators(self, outputs: Sequence[int], gains: Sequence[float]) -> NonlinearModel:
        """Return a model with an integrator at some of its outputs; `outputs` are their numbers.

        Each integrator is one more state: an offset of its output, which the prediction error drives with its gain in
        `gains`.
        """
        n, added = self.n_states, len(outputs)
        sizes = (n + added, len(self.input_names), len(self.parameters))
        x, u, p = (ca.SX.sym("s", size) for size in sizes)
        dx, y = self.function(x[:n], u, p)
        integrator_input = np.zeros((len(self.output_names), added))
        integrator_input[list(outputs), np.arange(added)] = 1.0
        function = ca.Function(
            "equations", [x, u, p], [ca.vertcat(dx, ca.SX.zeros(added)), y + ca.DM(integrator_input) @ x[n:]]
        )
        return replace(
            self,
            equations=function.serialize(),
            K=np.vstack([self.K, np.asarray(gains)[:, None] * integrator_input.T]),
            state_names=(*self.state_names, *(f"offset_{self.output_names[output]}" for output in outputs)),
            working_state=np.concatenate([self.working_state, np.zeros(added)]),
            state_size=np.concatenate([self.state_size, np.ones(added)]),
        )

    def linearise(
        self,
        x0: npt.ArrayLike | None = None,
        u0: npt.ArrayLike | None = None,
        *,
        amplitude: npt.ArrayLike | None = None,
    ) -> LinearModel:
        """Return the linear model at a working point, for small deviations or for sines of an amplitude.

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
        delays = np.zeros(len(u)) if self.delay is None else self.delay
        return LinearModel(
            A,
            np.where(delays > 0, 0.0, B),
            C,
            D,
            self.K if self.K.any() else None,
            name=self.name,
            input_names=self.input_names,
            output_names=self.output_names,
            state_names=self.state_names,
            B_delayed=None if self.delay is None else np.where(delays > 0, B, 0.0),
            delay=self.delay,
            intersample=self.intersample,
        )

    def modes(self) -> list[tuple[float, float]]:
        """Return the modes of the linear model at the working point; see `LinearModel.modes`.

        There are none where the derivatives are not finite, as in a fit that diverged.
        """
        try:
            return self.linearise().modes()
        except UsageError:
            return []

    def static_gain(self) -> FloatArray:
        """Return the static gain of the linear model at the working point; see `LinearModel.static_gain`."""
        return self.linearise().static_gain()

    def _response(
        self,
        u: FloatArray,
        y: FloatArray | None,
        sample_time: npt.ArrayLike | None,
        initial_state: Any,
        holds: tuple[Hold, ...],
    ) -> FloatArray:
        """Return the outputs of `step_function`, computed in batches of samples to save memory."""
        (n, n_u), clock = u.shape, check_clock(self.name, sample_time, len(u))
        if isinstance(clock, np.ndarray) and self.delay is not None:
            raise UsageError(f"model {self.name!r} has exact delays, which irregular times do not take")
        h = np.append(np.diff(clock), 0.0) if isinstance(clock, np.ndarray) else np.full(n, clock)
        shift = np.zeros(n_u, int) if self.delay is None else np.floor(self.delay / h[0]).astype(int)
        rows = np.arange(n)[:, None, None] - shift[:, None] + [1, 0, -1]  # (n_samples, n_inputs, 3)
        around = u[np.clip(rows, 0, n - 1), np.arange(n_u)[:, None]]
        step = self._step(holds, feeds_back=y is not None)
        start = np.zeros(self.n_states) if initial_state is None else initial_state
        x = self._sized("initial_state", start, self.n_states)
        y = np.zeros((n, len(self.output_names))) if y is None else y
        length = min(n, _AT_ONCE)
        run = step.mapaccum(length) if length > 1 else step
        samples = []
        for first in range(0, n, length):
            rows = np.minimum(np.arange(first, first + length), n - 1)
            inputs = around[rows].transpose(1, 0, 2).reshape(n_u, 3 * length)
            states, outputs = run(x, inputs, y[rows].T, self.parameters, h[rows][None])
            x = np.asarray(states[:, -1], float).ravel()
            samples.append(np.array(outputs, float).T)
        return np.concatenate(samples)[:n]

    def _step(self, holds: tuple[Hold, ...], *, feeds_back: bool) -> ca.Function:
        if (holds, feeds_back) not in self._made:
            self._made[holds, feeds_back] = self.step_function(holds, feeds_back=feeds_back)
        return self._made[holds, feeds_back]

    @cached_property
    def _made(self) -> dict[tuple[tuple[Hold, ...], bool], ca.Function]:
        return {}

    def step_function(self, holds: Sequence[Hold], *, feeds_back: bool = False) -> ca.Function:
        """Return the model over one sample (discretised equations) as a ``casadi.Function``.

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
        x, y, p, h, a, b = _sx(n, n_y, len(self.parameters), 1, n, n_u)
        u, delay = ca.SX.sym("u", n_u, 3), np.zeros(n_u) if self.delay is None else self.delay
        output = self.function(x, u[:, 1], p)[1]
        error = y - output if feeds_back else ca.SX.zeros(n_y)
        f = ca.Function("f", [a, b], [self.function(a, b, p)[0] + ca.DM(self.K) @ error], {"allow_free": True})
        early = [each / h - ca.floor(each / h) if each > 0 else None for each in delay.tolist()]
        after = over_a_sample(self.integrator, f, x, u, holds, early, h, self.steps)
        return ca.Function("step", [x, u, y, p, h], [after, output])

    @cached_property
    def _slopes(self) -> ca.Function:
        x, u, p = _sx(self.n_states, len(self.input_names), len(self.parameters))
        outputs = self.function(x, u, p)
        return ca.Function("slopes", [x, u, p], [ca.densify(ca.jacobian(y, at)) for y in outputs for at in (x, u)])

    def _sized(self, what: str, value: Any, size: int) -> FloatArray:
        vector = np.asarray(value, float).ravel()
        if vector.shape != (size,) or not np.isfinite(vector).all():
            raise UsageError(f"model {self.name!r}: {what} = {value}; give {size} finite numbers")
        return vector


def _sx(*sizes: int) -> list[ca.SX]:
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
    e, p = symbolic_equations(structure), as_vector(structure, values)
    K = np.array(ca.Function("K", [e.p], [ca.densify(e.K)])(p), float)
    function = ca.Function("equations", [e.x, e.u, e.p], [e.dx, e.y])
    delay = np.array(ca.Function("delay", [e.p], [ca.densify(e.delay)])(p), float).ravel()
    return NonlinearModel(
        structure.name,
        function.serialize(),
        p,
        K.reshape(e.K.shape),
        structure.states,
        input_names or structure.inputs,
        output_names or structure.outputs,
        np.zeros(len(structure.states)),
        np.zeros(len(structure.inputs)),
        np.ones(len(structure.states)),
        structure.integrator,
        steps,
        delay if e.delayed else None,
    )
