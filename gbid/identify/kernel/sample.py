"""Nonlinear predictors: functions of one sample with sensitivities, as casadi.Function.

A sample is an output and several steps of the integrator. The functions of both are small, whatever the number of
steps: the kernels run the loops.

    output:    x, z            -> xe, yhat, e
    step:      x, z, e, t, w   -> x after a part w of the sample, from the part t on

``xe`` is the state with what an initial state adds at the first sample, ``e`` the error that the disturbance gain
feeds back. `theta` are the free parameters; `known` are all others and, last, the sample time.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import UsageError
from gbid.discretise import Hold
from gbid.discretise.exact import check_holds
from gbid.discretise.steps import IntegratorName, one_step, step_inputs
from gbid.identify.disturbances import UNDISTURBED, Disturbances
from gbid.identify.options import Focus
from gbid.identify.predictor import GeneralPredictor, refuse_irregular
from gbid.structure import Parameter
from gbid.structure.kinds import kind_of
from gbid.structure.nonlinear import NonlinearStructure, first_steps, jumps_in, symbolic_equations


class SampleEquations(NamedTuple):
    """Equations of one sample as casadi.SX.

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
    prompt : tuple of int
        Inputs without delay among the regressors.
    delayed : tuple of int
        Inputs with an exact delay.
    early : casadi.SX
        What is left of the delays of these after whole samples, in samples.
    holds : tuple of {"zoh", "foh"}
        Hold of each input.
    disturbances : Disturbances
        Trends and hum. The last states are the offsets of random walks.
    coefficients : casadi.SX
        Their coefficients.
    impulse : bool
        Whether an impulse is a regressor.
    integrator : {"rk4", "implicit"}
        The integrator.
    irregular : bool
        Whether the interval to the next sample is a regressor, the first one.
    """

    x: ca.SX
    theta: ca.SX
    known: ca.SX
    u: ca.SX
    dx: ca.SX
    y: ca.SX
    K: ca.SX
    x0: ca.SX
    prompt: tuple[int, ...]
    delayed: tuple[int, ...]
    early: ca.SX
    holds: tuple[Hold, ...]
    disturbances: Disturbances
    coefficients: ca.SX
    impulse: bool
    integrator: IntegratorName
    irregular: bool = False


class SampleFunctions(NamedTuple):
    """Functions of one sample, with sparse Jacobians.

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
    feeds_back : bool
        Whether the error acts on the state.
    """

    output: ca.Function
    step: ca.Function
    output_jacobian: ca.Function
    step_jacobian: ca.Function
    feeds_back: bool


class _ByContent:
    """Equations compared by content: CasADi compares symbols by identity."""

    def __init__(self, equations: SampleEquations) -> None:
        symbols, rest = [equations.x, equations.theta, equations.known, equations.u], equations._asdict()
        values = [equations.dx, equations.y, equations.K, equations.x0, equations.coefficients, equations.early]
        written = ca.Function("equations", symbols, values).serialize()
        self.equations = equations
        options = ("prompt", "delayed", "holds", "disturbances", "impulse", "integrator", "irregular")
        self._content = (written, *(rest[name] for name in options))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByContent) and self._content == other._content

    def __hash__(self) -> int:
        return hash(self._content)


@lru_cache(maxsize=32)
def _functions(equations: _ByContent) -> SampleFunctions:
    """Return the functions of one sample, cached for all fits of a campaign."""
    eq = equations.equations
    lead, walking = [i for i in eq.prompt if eq.holds[i] == "foh"], eq.disturbances.walking
    n, n_y = eq.x.numel(), eq.y.numel()
    feeds_back = eq.K.nnz() > 0
    taps = [3 if eq.holds[i] == "foh" else 2 for i in eq.delayed]
    rest = [eq.disturbances.n_columns, int(eq.impulse), n_y * feeds_back]
    widths = [int(eq.irregular), len(eq.prompt), len(lead), sum(taps), *rest]
    z = ca.SX.sym("z", sum(widths))
    interval, now, ahead, delayed, trend, impulse, measured = _parts(z, widths)
    u = ca.SX(eq.u.numel(), 3)  # see `step_inputs`
    early: list[ca.SX | None] = [None] * eq.u.numel()
    for row, i in enumerate(eq.prompt):
        u[i, 1] = now[row]
    for row, i in enumerate(lead):
        u[i, 0] = ahead[row]
    for row, (i, mine) in enumerate(zip(eq.delayed, _parts(delayed, taps), strict=True)):
        u[i, 3 - mine.numel() :], early[i] = mine.T, eq.early[row]

    # Output of a sample, and its derivatives at the state that has begun there.
    at = eq.x + eq.x0 * impulse if eq.impulse else eq.x
    (y,) = ca.substitute([eq.y], [eq.u], [u[:, 1]])
    for walk, output in enumerate(walking):
        y[output] += eq.x[n - len(walking) + walk]
    if eq.disturbances.n_columns:
        y = y + eq.disturbances.matrix(ca.vertsplit(eq.coefficients), n_y) @ trend
    both = ca.vertcat(eq.x, eq.theta)
    y, slopes = ca.substitute([ca.densify(y), ca.jacobian(y, both)], [eq.x], [at])
    e_value = measured - y if feeds_back else ca.SX.zeros(n_y)

    # Step of the integrator.
    e, t, w = ca.SX.sym("e", n_y), ca.SX.sym("t"), ca.SX.sym("w")
    derivative = ca.vertcat(eq.dx, ca.SX(len(walking), 1)) + eq.K @ e
    f = ca.Function("f", [eq.x, eq.u], [ca.densify(derivative)], {"allow_free": True})
    ends = step_inputs(u, eq.holds, early, t, w)
    after = one_step(eq.integrator, f, eq.x, ends, (interval if eq.irregular else eq.known[-1]) * w)

    every = ca.vertcat(eq.x, e, eq.theta)
    of_output, of_step = [eq.x, z, eq.theta, eq.known], [eq.x, z, e, eq.theta, eq.known, t, w]
    by_every = ca.jacobian(after, every)
    by_state, by_input = by_every[:, :n], by_every[:, n + n_y * (not feeds_back) :]
    jacobians = [ca.jacobian(at, eq.theta), slopes[:, :n], slopes[:, n:]]
    return SampleFunctions(
        _function("output", of_output, [at, y, e_value]),
        _function("step", of_step, [after]),
        _function("output_jacobian", of_output, [at, y, e_value], jacobians),
        _function("step_jacobian", of_step, [after], [by_state, by_input]),
        feeds_back,
    )


def _function(
    name: str, arguments: Sequence[ca.SX], results: Sequence[ca.SX], jacobians: Sequence[ca.SX] = ()
) -> ca.Function:
    dense = [ca.densify(result) for result in results]
    return ca.Function(name, list(arguments), [*dense, *(ca.sparsify(each) for each in jacobians)], {"cse": True})


def _parts(column: ca.SX, widths: Sequence[int]) -> list[ca.SX]:
    """Return a column split into parts of given numbers of rows, which may be zero."""
    ends = list(itertools.accumulate(widths, initial=0))
    return [column[a:b] for a, b in itertools.pairwise(ends)]


# ---- Predictor of a nonlinear structure.


class NonlinearValues(NamedTuple):
    """Nonlinear predictor at given parameter values.

    Attributes
    ----------
    theta : (n_p,) array
        Free parameters.
    known : (n_known,) array
        All other parameters, the whole samples in delays, and the sample time.
    steps : int
        Steps of the integrator in a sample.
    shift : tuple of int
        Whole samples in the delay of each delayed input; these determine the regressors.
    """

    theta: FloatArray
    known: FloatArray
    steps: int
    shift: tuple[int, ...] = ()

    @property
    def n_parameters(self) -> int:
        """Number of free parameters."""
        return len(self.theta)


@dataclass(frozen=True, eq=False)
class NonlinearPredictor(GeneralPredictor):
    """Predictor of a nonlinear structure; see `GeneralPredictor`.

    Attributes
    ----------
    functions : SampleFunctions
        Functions of one sample.
    known : (n_known,) array
        Parameters that are not free, the whole samples in delays, and the sample time.
    steps : int
        Steps of the integrator in a sample.
    adapts : bool
        Whether the number of steps was left to the fit.
    jumps : tuple of str
        Operations of the equations with a jump or a kink.
    """

    functions: SampleFunctions
    known: FloatArray
    steps: int
    adapts: bool
    jumps: tuple[str, ...]
    _x0: ca.Function
    _delay: ca.Function

    def at(self, theta: FloatArray) -> NonlinearValues:
        """Return the predictor at given values of the free parameters, shape (n_free,).

        Raises
        ------
        UsageError
            When a delay is negative.
        """
        theta = np.array(theta, float)
        if not self.delayed:
            return NonlinearValues(theta, self.known, self.steps)
        delays = np.asarray(self._delay(theta, self.known)[0], float).ravel()
        if (delays < 0).any():
            raise UsageError(f"delay = {delays.min():g} s; it must not be negative")
        known, shift = self.known.copy(), np.floor(delays / self.sample_time)
        known[-1 - len(shift) : -1] = shift
        return NonlinearValues(theta, known, self.steps, tuple(int(each) for each in shift))

    def _interval_column(self, time: FloatArray) -> FloatArray:
        """Return the sampling interval [s]; see `GeneralPredictor`."""
        return np.diff(time, append=time[-1])[:, None]

    def delay_slopes(self, theta: FloatArray) -> FloatArray:
        """Return derivatives of the delays with respect to the free parameters, (n_free, n_inputs)."""
        slopes = np.zeros((len(self.free), self.n_inputs))
        slopes[:, list(self.delayed)] = np.asarray(self._delay(theta, self.known)[1], float).T
        return slopes

    def released_state(self, theta: FloatArray) -> FloatArray:
        """Return the initial state given by parameters, (n_states,); zero for other states."""
        return np.asarray(self._x0(theta, self.known), float).ravel()


def build_nonlinear_predictor(
    structure: NonlinearStructure,
    fixed: Mapping[str, float],
    begin: Mapping[str, float],
    sample_time: float,
    intersample: str | Sequence[str],
    focus: Focus,
    *,
    disturbances: Disturbances = UNDISTURBED,
    released: Sequence[bool] = (),
    intervals: FloatArray | None = None,
) -> NonlinearPredictor:
    """Return the predictor of a nonlinear structure for a fit; arguments as for `build_predictor`.

    `begin` are the start values, at which the number of steps of the integrator is chosen.

    Raises
    ------
    UsageError
        When no free parameter remains, or for irregular times with an exact delay.
    """
    eq = symbolic_equations(structure)
    if intervals is not None and eq.delayed:
        refuse_irregular(structure.name, "exact delays")
    n, n_y = eq.x.numel(), eq.y.numel()
    gains = disturbances.walk_gains(sample_time) if focus == "prediction" else ()
    K = eq.K if focus == "prediction" else ca.SX(n, n_y)
    x0 = eq.x0 if len(released) and eq.x0.numel() else ca.SX(n, 1)
    x0 = ca.diag(ca.SX([float(each) for each in released] or [0.0] * n)) @ x0
    seen = names_in(ca.veccat(eq.dx, eq.y, K, x0, eq.delay))
    nowhere = {q.name for q in structure.parameters} - seen - names_in(eq.K) - names_in(eq.x0) - set(fixed)
    if nowhere:
        raise UsageError(
            f"structure {structure.name!r}: its equations do not contain the parameter {', '.join(sorted(nowhere))}; "
            "remove it, or fix it (fixed=...)"
        )
    unused = tuple(q.name for q in structure.parameters if q.name not in seen and q.name not in fixed)
    free = tuple(q for q in structure.parameters if q.name not in fixed and q.name in seen)
    if not free:
        raise UsageError(f"structure {structure.name!r}: no free parameter to estimate")
    coefficients = ca.vertcat(*(ca.SX.sym(term.name) for term in disturbances.terms))
    gain_symbols = ca.vertcat(*(ca.SX.sym(q.name) for q in gains))
    symbols = {q.name: eq.p[i] for i, q in enumerate(structure.parameters)}
    others = [q.name for q in structure.parameters if q not in free]
    theta = ca.vertcat(*(symbols[q.name] for q in free), gain_symbols, coefficients)
    h, shift = ca.SX.sym("sample_time"), ca.SX.sym("shift", len(eq.delayed))
    known = ca.vertcat(*(symbols[name] for name in others), shift, h)
    walking = disturbances.walking
    walk_feed = ca.SX(len(walking), n_y)
    for row, output in enumerate(walking):
        walk_feed[row, output] = gain_symbols[row] if gains else 0
    holds = check_holds(intersample, eq.u.numel())
    acting = names_in(ca.veccat(eq.dx, eq.y))
    acts = [i for i in range(eq.u.numel()) if eq.u[i].name() in acting]
    prompt = tuple(i for i in acts if i not in eq.delayed)
    delays = eq.delay[list(eq.delayed), 0]
    full_K = ca.sparsify(ca.vertcat(K, walk_feed))
    driven = acts or full_K.nnz() or disturbances.n_columns
    walks = tuple(range(len(free), len(free) + len(gains)))
    noise = kind_of(structure).anatomy().gain_only
    x_all = ca.vertcat(eq.x, ca.SX.sym("walk", len(walking)))
    x0_all = ca.vertcat(x0, ca.SX(len(walking), 1))
    equations = SampleEquations(
        x=x_all,
        theta=theta,
        known=known,
        u=eq.u,
        dx=eq.dx,
        y=eq.y,
        K=full_K,
        x0=x0_all,
        prompt=prompt,
        delayed=eq.delayed,
        early=delays / h - shift,
        holds=holds,
        disturbances=disturbances,
        coefficients=coefficients,
        impulse=any(released) or not driven,
        integrator=structure.integrator,
        irregular=intervals is not None,
    )
    longest = sample_time if intervals is None else float(intervals[-1])
    values = {**dict.fromkeys(unused, 0.0), **fixed}
    return NonlinearPredictor(
        free=(*free, *gains, *(Parameter("coefficient", 0.0).renamed(term.name) for term in disturbances.terms)),
        noise=(*(i for i, q in enumerate(free) if q.name in noise), *walks),
        unused=unused,
        n_states=x_all.numel(),
        n_inputs=eq.u.numel(),
        n_outputs=n_y,
        holds=holds,
        prompt=prompt,
        delayed=eq.delayed,
        feeds_back=full_K.nnz() > 0,
        disturbances=disturbances,
        walks=walks,
        sample_time=sample_time,
        released=any(released),
        functions=_functions(_ByContent(equations)),
        known=np.array([*(values[name] for name in others), *[0.0] * len(eq.delayed), sample_time]),
        steps=first_steps(structure, np.array([begin[q.name] for q in structure.parameters]), longest),
        adapts=structure.steps == "auto",
        jumps=jumps_in(eq),
        intervals=intervals,
        _x0=ca.Function("x0", [theta, known], [ca.densify(x0_all)]),
        _delay=ca.Function("delay", [theta, known], [ca.densify(delays), ca.densify(ca.jacobian(delays, theta))]),
    )


def names_in(expression: ca.SX) -> set[str]:
    """Return the names of the symbols in an expression."""
    return {symbol.name() for symbol in ca.symvar(expression)}
