"""Functions of one sample of a nonlinear predictor, with sensitivities and adjoint, as casadi.Function.

A sample is an output and several steps of the integrator. The functions of both are small, whatever the number of
steps: the kernels run the loops.

    output:    x, z            -> xe, yhat, e
    step:      x, z, e, t, w   -> x after a part w of the sample, from the part t on

``xe`` is the state with what an initial state adds at the first sample, ``e`` the error that the disturbance gain
feeds back. `theta` are the free parameters; `known` are all others and, last, the sample time.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import casadi as ca

from gbid.discretise import Hold, IntegratorName, one_step, step_inputs
from gbid.identify.disturbances.disturbances import Disturbances


class SampleEquations(NamedTuple):
    """Equations of a sample as casadi.SX.

    Attributes
    ----------
    x, theta, known : casadi.SX
        Symbols of the states with those of random walks, the free parameters, all others and the sample time.
    u : casadi.SX
        Symbols of the inputs.
    dx, y : casadi.SX
        Derivatives of the states of the structure, and its outputs, by these symbols.
    K : casadi.SX
        Disturbance gain for all states, (n, n_y); without entries where measured outputs are not fed back.
    x0 : casadi.SX
        Initial state of the released states, (n, 1); zero for all others.
    walking : tuple of int
        Outputs with a random walk, whose offsets are the last states.
    prompt, lead : tuple of int
        Inputs without delay among the regressors, and those of them whose next sample is there, too.
    delayed : tuple of int
        Inputs with an exact delay.
    early : casadi.SX
        What is left of the delays of these after whole samples, in samples.
    holds : tuple of {"zoh", "foh"}
        Hold of each input.
    disturbances : Disturbances
        Trends and hum.
    coefficients : casadi.SX
        Their coefficients.
    impulse : bool
        Whether an impulse is a regressor.
    integrator : {"rk4", "implicit"}
        The integrator.
    """

    x: ca.SX
    theta: ca.SX
    known: ca.SX
    u: ca.SX
    dx: ca.SX
    y: ca.SX
    K: ca.SX
    x0: ca.SX
    walking: tuple[int, ...]
    prompt: tuple[int, ...]
    lead: tuple[int, ...]
    delayed: tuple[int, ...]
    early: ca.SX
    holds: tuple[Hold, ...]
    disturbances: Disturbances
    coefficients: ca.SX
    impulse: bool
    integrator: IntegratorName


class SampleFunctions(NamedTuple):
    """Functions of a sample, with Jacobians that keep their zeros, and adjoints.

    Attributes
    ----------
    output : casadi.Function
        ``(x, z, theta, known) -> (xe, yhat, e)``.
    step : casadi.Function
        ``(x, z, e, theta, known, t, w) -> x``.
    output_jacobian : casadi.Function
        ``(x, z, theta, known) -> (xe, yhat, e, dxe/dtheta, dyhat/dxe, dyhat/dtheta at constant xe)``.
    step_jacobian : casadi.Function
        ``(x, z, e, theta, known, t, w) -> (x, dx/dx, dx/d[e, theta])``; without e where it is not fed back.
    output_back : casadi.Function
        ``(x, z, theta, known, a, v) -> `` derivatives of ``a' xe + v' yhat`` by x and theta.
    step_back : casadi.Function
        ``(x, z, e, theta, known, t, w, a) -> `` derivatives of ``a' x`` by the state before, e and theta.
    feeds_back : bool
        Whether the error acts on the state.
    """

    output: ca.Function
    step: ca.Function
    output_jacobian: ca.Function
    step_jacobian: ca.Function
    output_back: ca.Function
    step_back: ca.Function
    feeds_back: bool


def sample_functions(own: SampleEquations) -> SampleFunctions:
    """Return the functions of a sample; equal equations, as in a campaign, have the same ones."""
    return _functions(_ByContent(own))


class _ByContent:
    """Equations that are equal when their content is, since symbols of CasADi are equal only to themselves."""

    def __init__(self, own: SampleEquations) -> None:
        symbols, rest = [own.x, own.theta, own.known, own.u], own._asdict()
        values = [own.dx, own.y, own.K, own.x0, own.coefficients, own.early]
        written = ca.Function("equations", symbols, values).serialize()
        self.own = own
        options = ("walking", "prompt", "lead", "delayed", "holds", "disturbances", "impulse", "integrator")
        self._content = (written, *(rest[name] for name in options))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByContent) and self._content == other._content

    def __hash__(self) -> int:
        return hash(self._content)


@lru_cache(maxsize=32)
def _functions(equations: _ByContent) -> SampleFunctions:
    own = equations.own
    n, n_y = own.x.numel(), own.y.numel()
    feeds_back = own.K.nnz() > 0
    taps = [3 if own.holds[i] == "foh" else 2 for i in own.delayed]
    rest = [own.disturbances.n_columns, int(own.impulse), n_y * feeds_back]
    widths = [len(own.prompt), len(own.lead), sum(taps), *rest]
    z = ca.SX.sym("z", sum(widths))
    now, lead, late, trend, impulse, measured = _parts(z, widths)
    u = ca.SX(own.u.numel(), 3)  # see `step_inputs`
    early: list[ca.SX | None] = [None] * own.u.numel()
    for row, i in enumerate(own.prompt):
        u[i, 1] = now[row]
    for row, i in enumerate(own.lead):
        u[i, 0] = lead[row]
    for row, (i, mine) in enumerate(zip(own.delayed, _parts(late, taps), strict=True)):
        u[i, 3 - mine.numel() :], early[i] = mine.T, own.early[row]

    # Output of a sample, and its derivatives at the state that has begun there.
    at = own.x + own.x0 * impulse if own.impulse else own.x
    (y,) = ca.substitute([own.y], [own.u], [u[:, 1]])
    for walk, output in enumerate(own.walking):
        y[output] += own.x[n - len(own.walking) + walk]
    if own.disturbances.n_columns:
        gain = ca.SX(n_y, own.disturbances.n_columns)
        for row, column, coefficient in zip(*own.disturbances.places, ca.vertsplit(own.coefficients), strict=True):
            gain[int(row), int(column)] = coefficient
        y = y + gain @ trend
    both = ca.vertcat(own.x, own.theta)
    y, slopes = ca.substitute([ca.densify(y), ca.jacobian(y, both)], [own.x], [at])
    e_value = measured - y if feeds_back else ca.SX.zeros(n_y)

    # Step of the integrator.
    e, t, w = ca.SX.sym("e", n_y), ca.SX.sym("t"), ca.SX.sym("w")
    derivative = ca.vertcat(own.dx, ca.SX(len(own.walking), 1)) + own.K @ e
    f = ca.Function("f", [own.x, own.u], [ca.densify(derivative)], {"allow_free": True})
    ends = step_inputs(u, own.holds, early, t, w)
    after = one_step(own.integrator, f, own.x, ends, own.known[-1] * w)

    a, v = ca.SX.sym("a", n), ca.SX.sym("v", n_y)
    point, fixed = [own.x, z], [own.theta, own.known]
    every = ca.vertcat(own.x, e, own.theta)
    back = ca.jtimes(ca.vertcat(at, y), both, ca.vertcat(a, v), True)
    step_back = ca.jtimes(after, every, a, True)
    moving = [e, *fixed, t, w]
    by_every = ca.jacobian(after, every)
    of_output = [ca.jacobian(at, own.theta), slopes[:, :n], slopes[:, n:]]
    return SampleFunctions(
        _function("output", [*point, *fixed], [at, y, e_value]),
        _function("step", [*point, *moving], [after]),
        _function("output_jacobian", [*point, *fixed], [at, y, e_value], of_output),
        _function(
            "step_jacobian", [*point, *moving], [after], [by_every[:, :n], by_every[:, n + n_y * (not feeds_back) :]]
        ),
        _function("output_back", [*point, *fixed, a, v], [back[:n], back[n:]]),
        _function("step_back", [*point, *moving, a], [step_back[:n], step_back[n : n + n_y], step_back[n + n_y :]]),
        feeds_back,
    )


def _function(
    name: str, arguments: Sequence[ca.SX], results: Sequence[ca.SX], jacobians: Sequence[ca.SX] = ()
) -> ca.Function:
    dense = [ca.densify(result) for result in results]
    return ca.Function(name, list(arguments), [*dense, *(ca.sparsify(each) for each in jacobians)], {"cse": True})


def _parts(z: ca.SX, widths: Sequence[int]) -> list[ca.SX]:
    found, at = [], 0
    for width in widths:
        found.append(z[at : at + width])
        at += width
    return found
