"""Predictor of a nonlinear structure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray
from gbid.discretise import check_holds
from gbid.errors import UsageError
from gbid.identify.disturbances.disturbances import UNDISTURBED, Disturbances
from gbid.identify.kernel.general_predictor import GeneralPredictor
from gbid.identify.nonlinear.sample_functions import SampleEquations, SampleFunctions, sample_functions
from gbid.identify.predictor import Focus
from gbid.structure import Parameter
from gbid.structure.nonlinear.equations import jumps_in, symbolic_equations
from gbid.structure.nonlinear.first_steps import first_steps
from gbid.structure.nonlinear.nonlinear_structure import NonlinearStructure


class NonlinearValues(NamedTuple):
    """Nonlinear predictor at one parameter vector.

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
        """Return the predictor at values of the free parameters, shape (n_free,).

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

    def delay_slopes(self, theta: FloatArray) -> FloatArray:
        """Return the derivatives of the delays of all inputs by the free parameters, (n_free, n_inputs)."""
        slopes = np.zeros((len(self.free), self.n_inputs))
        slopes[:, list(self.delayed)] = np.asarray(self._delay(theta, self.known)[1], float).T
        return slopes

    def released_state(self, theta: FloatArray) -> FloatArray:
        """Return the initial state as a function of the parameters, (n_states,); zero where it is not."""
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
    horizon: int = 1,
    released: Sequence[bool] = (),
) -> NonlinearPredictor:
    """Return the predictor of a nonlinear structure for a fit; arguments as for `build_predictor`.

    `begin` are the start values, at which the number of steps of the integrator is chosen.

    Raises
    ------
    UsageError
        When no free parameter remains, or for a horizon beyond one.
    """
    if horizon > 1:
        raise UsageError(f"horizon = {horizon}: nonlinear structures predict one step ahead; leave it out")
    own = symbolic_equations(structure)
    n, n_y = own.x.numel(), own.y.numel()
    gains = disturbances.walk_gains(sample_time) if focus == "prediction" else ()
    K = own.K if focus == "prediction" else ca.SX(n, n_y)
    x0 = own.x0 if len(released) and own.x0.numel() else ca.SX(n, 1)
    x0 = ca.diag(ca.SX([float(each) for each in released] or [0.0] * n)) @ x0
    seen = names_in(ca.veccat(own.dx, own.y, K, x0, own.delay))
    nowhere = {q.name for q in structure.parameters} - seen - names_in(own.K) - names_in(own.x0) - set(fixed)
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
    symbols = dict(
        zip((q.name for q in structure.parameters), ca.vertsplit(own.p) if own.p.numel() else [], strict=True)
    )
    others = [q.name for q in structure.parameters if q not in free]
    theta = ca.vertcat(*(symbols[q.name] for q in free), gain_symbols, coefficients)
    h, shift = ca.SX.sym("sample_time"), ca.SX.sym("shift", len(own.delayed))
    known = ca.vertcat(*(symbols[name] for name in others), shift, h)
    walking = disturbances.walking
    onto = ca.SX(len(walking), n_y)
    for row, output in enumerate(walking):
        onto[row, output] = gain_symbols[row] if gains else 0
    holds = check_holds(intersample, own.u.numel())
    acting = names_in(ca.veccat(own.dx, own.y))
    acts = [i for i, symbol in enumerate(_each(own.u)) if symbol.name() in acting]
    prompt = tuple(i for i in acts if i not in own.delayed)
    late = own.delay[list(own.delayed), 0]
    full_K = ca.sparsify(ca.vertcat(K, onto))
    driven = acts or full_K.nnz() or disturbances.n_columns
    walks = tuple(range(len(free), len(free) + len(gains)))
    noise = _only_in(own.K, ca.veccat(own.dx, own.y, own.x0, own.delay))
    x_all = ca.vertcat(own.x, ca.SX.sym("walk", len(walking)))
    x0_all = ca.vertcat(x0, ca.SX(len(walking), 1))
    equations = SampleEquations(
        x=x_all,
        theta=theta,
        known=known,
        u=own.u,
        dx=own.dx,
        y=own.y,
        K=full_K,
        x0=x0_all,
        walking=walking,
        prompt=prompt,
        lead=tuple(i for i in prompt if holds[i] == "foh"),
        delayed=own.delayed,
        early=late / h - shift,
        holds=holds,
        disturbances=disturbances,
        coefficients=coefficients,
        impulse=any(released) or not driven,
        integrator=structure.integrator,
    )
    values = {**dict.fromkeys(unused, 0.0), **fixed}
    return NonlinearPredictor(
        free=(*free, *gains, *(Parameter("coefficient", 0.0).renamed(term.name) for term in disturbances.terms)),
        noise=(*(i for i, q in enumerate(free) if q.name in noise), *walks),
        unused=unused,
        n_states=x_all.numel(),
        n_inputs=own.u.numel(),
        n_outputs=n_y,
        holds=holds,
        prompt=prompt,
        delayed=own.delayed,
        feeds_back=full_K.nnz() > 0,
        disturbances=disturbances,
        walks=walks,
        horizon=1,
        sample_time=sample_time,
        released=any(released),
        functions=sample_functions(equations),
        known=np.array([*(values[name] for name in others), *[0.0] * len(own.delayed), sample_time]),
        steps=first_steps(structure, np.array([begin[q.name] for q in structure.parameters]), sample_time, own),
        adapts=structure.steps == "auto",
        jumps=jumps_in(own),
        _x0=ca.Function("x0", [theta, known], [ca.densify(x0_all)]),
        _delay=ca.Function("delay", [theta, known], [ca.densify(late), ca.densify(ca.jacobian(late, theta))]),
    )


def nonlinear_noise_names(structure: NonlinearStructure) -> frozenset[str]:
    """Return the names of the parameters on which only the disturbance gain depends."""
    own = symbolic_equations(structure)
    return _only_in(own.K, ca.veccat(own.dx, own.y, own.x0, own.delay))


def _only_in(one: ca.SX, others: ca.SX) -> frozenset[str]:
    return frozenset(names_in(one) - names_in(others))


def names_in(expression: ca.SX) -> set[str]:
    """Return the names of the symbols in an expression."""
    return {symbol.name() for symbol in ca.symvar(expression)}


def _each(column: ca.SX) -> list[ca.SX]:
    return ca.vertsplit(column) if column.numel() else []
