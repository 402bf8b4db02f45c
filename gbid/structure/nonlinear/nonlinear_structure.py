"""Nonlinear model structure: differential equations of a user, as functions of named parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

from gbid.discretise import Hold, IntegratorName
from gbid.errors import UsageError
from gbid.structure.linear import as_names
from gbid.structure.parameter import Parameter, Values

MOST_STEPS = 256
"""Largest number of steps of an integrator in a sample."""


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
    steps: int | Literal["auto"] = "auto"

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
        given: Mapping[str, Any] = {
            "name": name,
            "parameters": tuple(parameters),
            "states": as_names(states),
            "dynamics": dynamics,
            "output": output,
            "inputs": as_names(inputs),
            "outputs": as_names(outputs),
            "intersample": intersample,
            "disturbance_gain": disturbance_gain,
            "delay": delay,
            "x0": x0,
            "integrator": integrator,
            "steps": steps,
        }
        for key, value in given.items():
            object.__setattr__(self, key, value)
        self._check()

    def _check(self) -> None:
        where = f"structure {self.name!r}"
        for what, names in (("parameter", [q.name for q in self.parameters]), ("state", list(self.states))):
            if twice := sorted({name for name in names if names.count(name) > 1}):
                raise UsageError(f"{where}: {what} {twice[0]!r} is listed more than once")
        for what in ("states", "outputs"):
            if not getattr(self, what):
                raise UsageError(f"{where}: no {what}")
        optional = ("disturbance_gain", "delay", "x0")
        for what in ("dynamics", "output", *optional):
            function = getattr(self, what)
            if not (callable(function) or (function is None and what in optional)):
                raise UsageError(f"{where}: {what} = {function!r} is no function; give one that returns expressions")
        if self.integrator not in get_args(IntegratorName):
            raise UsageError(f"{where}: integrator = {self.integrator!r}; choose 'rk4' or 'implicit'")
        if self.steps != "auto" and not (isinstance(self.steps, int) and 1 <= self.steps <= MOST_STEPS):
            raise UsageError(f"{where}: steps = {self.steps!r}; give 'auto' or a number from 1 to {MOST_STEPS}")
